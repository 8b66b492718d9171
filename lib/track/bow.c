/* How patches of a tube's wall bend. The cotangent of a wall point's polar angle falls by the same amount for all of a
 * patch when the camera drives on, but pixels do not move alike: what was a straight line of wall is drawn into a bow,
 * and what was evenly spaced along the radius is so no more. The best affine warp of a bent patch does not map its
 * centre to where it is: by 0.02 px for every fifth that a patch grows beyond 45 degrees, inwards, for every track. */
#include "track_private.h"

#define STEEP ((int64_t)1 << 26) /* sine of the polar angle, Q30, below which the cotangent says nothing */
#define UNIT  ((int64_t)1 << 30)
#define LEAP  ((int64_t)16 << 24) /* of the cotangent */
#define LEAN  (1 << 14)           /* Q16: a warp that shrinks an area to a quarter has no inverse of use */
#define BLUNT ((int64_t)1 << 21)  /* of the cotangent: an eighth, nearer to square light does not turn much */
#define TURN  512
#define FAR   8 /* half windows: a place of the patch is never farther from its middle */

/* What takes the patch's rays on: `turn` about the axis (cosine and sine, Q30) and a fall of the cotangent, Q24; and
 * what pf_bow.turned_q8 is. */
typedef struct pf_way {
    int64_t cosine, sine, fall, turned;
} pf_way;

static bool way_between(const pf_ray_q30 *a, const pf_ray_q30 *b, pf_way *way)
{
    const int64_t ra = pf_ray_sine(a), rb = pf_ray_sine(b);
    if (ra < STEEP || rb < STEEP)
        return false;
    const int64_t cot = a->z * ((int64_t)1 << 24) / ra, size = cot < 0 ? -cot : cot, base = size > BLUNT ? size : BLUNT;
    way->fall = cot - b->z * ((int64_t)1 << 24) / rb;
    way->turned = (way->fall < 0 ? -way->fall : way->fall) * 256 / (base * base >> 24);
    way->cosine = ((int64_t)a->x * b->x + (int64_t)a->y * b->y) / ra * UNIT / rb;
    way->sine = ((int64_t)a->x * b->y - (int64_t)a->y * b->x) / ra * UNIT / rb;
    return way->fall < LEAP && way->fall > -LEAP;
}

/* The ray's pixel at the end of the way. The new ray is a sixteenth as long: the length does not matter to the lens. */
static bool follow_ray(const pf_track_lens *lens, const pf_way *way, const pf_ray_q30 *ray, pf_point_q16 *at)
{
    const int64_t rho = pf_ray_sine(ray), z = ray->z - ((rho * way->fall) >> 24);
    const pf_ray_q30 moved = {(int32_t)((((ray->x * way->cosine) >> 30) - ((ray->y * way->sine) >> 30)) >> 4),
                              (int32_t)((((ray->x * way->sine) >> 30) + ((ray->y * way->cosine) >> 30)) >> 4),
                              (int32_t)(z >> 4)};
    return rho >= STEEP && lens->project(lens->camera, &moved, at);
}

/* The places at which a patch is looked at, from its middle, in half windows: by symmetric differences of seven a
 * quadratic is known. */
enum { MIDDLE, RIGHT, LEFT, BELOW, ABOVE, RIGHT_BELOW, LEFT_ABOVE, PLACES };
static const int32_t place[PLACES][2] = {{0, 0}, {1, 0}, {-1, 0}, {0, 1}, {0, -1}, {1, 1}, {-1, -1}};

/* The bow of a patch of which these places came to p: second differences, half^2 times Q16, through the inverse of the
 * warp. False where that is of no use, or a place has run away. */
static bool bend_of(const pf_point_q16 p[PLACES], int32_t half, pf_bow *bow)
{
    const int64_t far = ((int64_t)FAR * half) << 16, least = (int64_t)LEAN * 4 * half * half;
    int64_t d[2][PLACES], a[2][2], bend[3][2];
    for (int32_t k = 0; k < PLACES; k++) {
        d[0][k] = (int64_t)p[k].x - p[MIDDLE].x;
        d[1][k] = (int64_t)p[k].y - p[MIDDLE].y;
        if (d[0][k] > far || d[0][k] < -far || d[1][k] > far || d[1][k] < -far)
            return false;
    }
    for (int32_t k = 0; k < 2; k++) {
        const int64_t *v = d[k];
        a[k][0] = v[RIGHT] - v[LEFT]; /* the warp, 2 half times Q16 */
        a[k][1] = v[BELOW] - v[ABOVE];
        bend[0][k] = v[RIGHT] + v[LEFT]; /* twice the coefficients */
        bend[2][k] = v[BELOW] + v[ABOVE];
        bend[1][k] = v[RIGHT_BELOW] + v[LEFT_ABOVE] - bend[0][k] - bend[2][k];
    }
    const int64_t det = (a[0][0] * a[1][1] - a[0][1] * a[1][0]) >> 16;
    const int32_t most = ((1 << 24) - (1 << 12)) / (3 * half * half);
    if (det < least)
        return false;
    for (int32_t k = 0; k < 4; k++)
        bow->warp[k] = pf_clamp_i64(a[k / 2][k % 2] / (2 * half), WARP_MOST);
    for (int32_t k = 0; k < 3; k++) { /* 2^57 at most */
        bow->c[k] = pf_clamp_i64((a[1][1] * bend[k][0] - a[0][1] * bend[k][1]) * 256 / det / half, most);
        bow->c[3 + k] = pf_clamp_i64((a[0][0] * bend[k][1] - a[1][0] * bend[k][0]) * 256 / det / half, most);
    }
    return true;
}

bool pf_bow_between(const pf_track_lens *lens, int32_t half, int32_t x, int32_t y, pf_point_q16 to, pf_bow *bow)
{
    const pf_ray_q30 there = lens->ray(lens->rays, to);
    pf_point_q16 p[PLACES];
    pf_way way = {0, 0, 0, 0};
    for (int32_t k = 0; k < PLACES; k++) {
        const pf_point_q16 pixel = {(x + place[k][0] * half) * 65536, (y + place[k][1] * half) * 65536};
        const pf_ray_q30 ray = lens->ray(lens->rays, pixel);
        if (!pf_ray_valid(&ray) || (k == MIDDLE && (!pf_ray_valid(&there) || !way_between(&ray, &there, &way))) ||
            !follow_ray(lens, &way, &ray, &p[k]))
            return false;
    }
    bow->turned_q8 = way.turned > TURN ? TURN : (int32_t)way.turned;
    return bend_of(p, half, bow);
}
