/* How patches of a tube's wall bend. The cotangent of a wall point's polar angle falls by the same amount for all of a
 * patch when the camera drives on, but pixels do not move alike: what was a straight line of wall is drawn into a bow,
 * and what was evenly spaced along the radius is so no more. The best affine warp of a bent patch does not map its
 * centre to where it is: by 0.02 px for every fifth that a patch grows beyond 45 degrees, inwards, for every track. */
#include "track_private.h"

#define STEEP ((int64_t)1 << 26) /* sine of the polar angle, Q30, below which the cotangent says nothing */
#define UNIT  ((int64_t)1 << 30)
#define LEAP  ((int64_t)16 << 24) /* of the cotangent */
#define LEAN  (1 << 14)           /* Q16: a warp that shrinks an area to a quarter has no inverse of use */
#define FAR   8                   /* half windows: a place of the patch is never farther from its middle */

static int64_t sine_of(const pf_ray_q30 *v)
{
    return pf_isqrt64((uint64_t)((int64_t)v->x * v->x + (int64_t)v->y * v->y));
}

/* What takes the patch's rays on: `turn` about the axis (cosine and sine, Q30) and a fall of the cotangent, Q24. */
typedef struct pf_way {
    int64_t cosine, sine, fall;
} pf_way;

static bool way_between(const pf_ray_q30 *a, const pf_ray_q30 *b, pf_way *way)
{
    const int64_t ra = sine_of(a), rb = sine_of(b);
    if (ra < STEEP || rb < STEEP)
        return false;
    way->fall = a->z * ((int64_t)1 << 24) / ra - b->z * ((int64_t)1 << 24) / rb;
    way->cosine = ((int64_t)a->x * b->x + (int64_t)a->y * b->y) / ra * UNIT / rb;
    way->sine = ((int64_t)a->x * b->y - (int64_t)a->y * b->x) / ra * UNIT / rb;
    return way->fall < LEAP && way->fall > -LEAP;
}

/* The ray's pixel at the end of the way. The new ray is a sixteenth as long: the length does not matter to the lens. */
static bool follow_ray(const pf_track_lens *lens, const pf_way *way, const pf_ray_q30 *ray, pf_point_q16 *at)
{
    const int64_t rho = sine_of(ray), z = ray->z - ((rho * way->fall) >> 24);
    const pf_ray_q30 moved = {(int32_t)((((ray->x * way->cosine) >> 30) - ((ray->y * way->sine) >> 30)) >> 4),
                              (int32_t)((((ray->x * way->sine) >> 30) + ((ray->y * way->cosine) >> 30)) >> 4),
                              (int32_t)(z >> 4)};
    return rho >= STEEP && lens->project(lens->camera, &moved, at);
}

/* Second differences of the nine places, 2 half^2 times the derivatives by xx, xy, yy (Q16), through the inverse of the
 * warp; false where there is none of use, or a place has run away. */
static bool bend_of(const pf_point_q16 p[9], int32_t half, pf_bow *bow)
{
    const int64_t far = ((int64_t)FAR * half) << 16, least = (int64_t)LEAN * 4 * half * half;
    int64_t x[9], y[9];
    for (int32_t k = 0; k < 9; k++) {
        x[k] = (int64_t)p[k].x - p[4].x;
        y[k] = (int64_t)p[k].y - p[4].y;
        if (x[k] > far || x[k] < -far || y[k] > far || y[k] < -far)
            return false;
    }
    const int64_t a[4] = {x[5] - x[3], x[7] - x[1], y[5] - y[3], y[7] - y[1]}; /* the warp, 2 half times Q16 */
    const int64_t det = (a[0] * a[3] - a[1] * a[2]) >> 16;
    const int64_t bx[3] = {x[5] + x[3], (x[8] - x[6] - x[2] + x[0]) / 2, x[7] + x[1]},
                  by[3] = {y[5] + y[3], (y[8] - y[6] - y[2] + y[0]) / 2, y[7] + y[1]};
    const int64_t most = ((int64_t)1 << 24) / (3 * half * half);
    if (det < least)
        return false;
    for (int32_t k = 0; k < 3; k++) { /* 2^57 at most */
        bow->c[k] = pf_clamp_i64((a[3] * bx[k] - a[1] * by[k]) * 256 / det / half, (int32_t)most);
        bow->c[3 + k] = pf_clamp_i64((a[0] * by[k] - a[2] * bx[k]) * 256 / det / half, (int32_t)most);
    }
    return true;
}

bool pf_bow_between(const pf_track_lens *lens, int32_t half, int32_t x, int32_t y, pf_point_q16 to, pf_bow *bow)
{
    const pf_ray_q30 from = lens->ray(lens->rays, (pf_point_q16){x * 65536, y * 65536}),
                     there = lens->ray(lens->rays, to);
    pf_point_q16 p[9];
    pf_way way;
    if (!pf_ray_valid(&from) || !pf_ray_valid(&there) || !way_between(&from, &there, &way))
        return false;
    for (int32_t k = 0; k < 9; k++) {
        const pf_point_q16 pixel = {(x + (k % 3 - 1) * half) * 65536, (y + (k / 3 - 1) * half) * 65536};
        const pf_ray_q30 ray = lens->ray(lens->rays, pixel);
        if (!pf_ray_valid(&ray) || !follow_ray(lens, &way, &ray, &p[k]))
            return false;
    }
    return bend_of(p, half, bow);
}
