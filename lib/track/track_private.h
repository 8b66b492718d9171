/* What the files of the tracker share. Not for users.
 *
 * Fixed point inside: pixels of a patch are Q4 less 2040 (a signed 16-bit number that centres 0..255; its rounding adds
 * 0.0003 grey^2, noise of sigma 2 has 4), positions are Q16.16, bilinear weights Q15. Every sum is exact, so its order
 * cannot matter and vector code may choose: kernels.h.
 */
#ifndef PIPEFISH_TRACK_PRIVATE_H
#define PIPEFISH_TRACK_PRIVATE_H

#include "kernels.h"
#include "pipefish/image.h"
#include "pipefish/track.h"

#define EDGE_ROW  48             /* row stride of a copy at the image's edge: 5 groups and a pixel */
#define GAIN_ONE  16384          /* gains are Q14 */
#define GAIN_MIN  (GAIN_ONE / 8) /* outside [1/8, 8] two patches are not the same thing in another light */
#define GAIN_MAX  (GAIN_ONE * 8)
#define WARP_MOST (4 << 16) /* no entry of a warp is larger */

#define PF_COUNTS_MOST (1 << 24) /* encoder counts a frame: more is no reading */

/* Parameters and scratch of the aligners; one a tracker. Patches are window rows of PATCH_ROW. */
typedef struct pf_klt {
    pf_track_lens lens;
    int32_t window, half;
    int32_t groups; /* of 8 columns, that hold the window; the surplus columns are masked */
    int32_t iterations;
    int32_t min_eigen;    /* grey^2, mean over the window; below this a patch is flat */
    int32_t noise_var_q8; /* variance of the image's noise, grey^2 */
    pf_point_q16 circle;
    int32_t radius_q16;       /* 0 = no circle */
    const int16_t *counted;   /* the mask in use: `whole` or `mask` */
    int16_t whole[PATCH_MAX]; /* -1 where a pixel counts, 0 where not; here: all of the window */
    int16_t mask[PATCH_MAX];
    int16_t raw[PATCH_MAX]; /* reference patch with its border */
    int16_t t[PATCH_MAX], gx[PATCH_MAX], gy[PATCH_MAX];
    int16_t xgx[PATCH_MAX], xgy[PATCH_MAX];
    int16_t c[PATCH_MAX];
    int32_t sum[PATCH_MAX]; /* of relief.c */
    uint8_t edge[(WINDOW_MAX + 3) * EDGE_ROW];
} pf_klt;

/* Outcome of an alignment. */
typedef struct pf_fit {
    pf_track_reason reason;
    int32_t zncc_q15;
    int32_t gain_q14;
} pf_fit;

/* The patch of a track as it was when it was first seen or last renewed: whole pixels, nothing interpolated. The
 * warp takes template coordinates x (relative to the centre pixel) to `centre + a x` in the current frame. */
typedef struct pf_anchor {
    int32_t x, y;        /* the template's centre pixel, in its own picture */
    pf_point_q16 offset; /* of the track's point from the template's centre pixel, |.| <= 1/2 */
    int32_t a[4];        /* Q16.16, row-major */
    int32_t inverse[21]; /* Q12.20, of the scaled 6x6 normal matrix, lower triangle; order dx dy, the warp by rows */
    int32_t scale[6];    /* log2 of each parameter's scale */
    int32_t sum_j[6][3]; /* sums of the steepest-descent images times 1, x, y */
    int32_t excess_q8;   /* of the last fit: what was left over what noise leaves, at least 1, at most 16 */
    int32_t relief_sum[3],
        relief_j[6];       /* of the companion (relief.c): times 1, x, y; times the images, off the plane */
    int32_t relief_square; /* its square, off the plane; 0: there is none */
    int64_t carried[3];    /* covariance (xx, xy, yy) with which it was put there, Q20 px^2: zero at first sight */
} pf_anchor;

uint32_t pf_isqrt64(uint64_t n);

/* floor(n / d) for d > 0. */
static inline int64_t pf_floor_div(int64_t n, int64_t d)
{
    return n / d - (n % d < 0);
}

static inline int32_t pf_clamp_i64(int64_t v, int32_t limit)
{
    return v > limit ? limit : v < -limit ? -limit : (int32_t)v;
}

/* Q0.15 correlation of two patches from their sums of centred products (Q8, below 2^37). */
int32_t pf_zncc(int64_t cov, int64_t var_a, int64_t var_b);

/* The same less what noise takes from it: noise adds to the variances of both patches (of `count` pixels), and a small
 * mark on a bare wall is found as surely as brick though most of its window is noise. At least an eighth of each must
 * be more. */
int32_t pf_likeness(const pf_klt *klt, int64_t cov, int64_t var_a, int64_t var_b, int64_t count);

/* Sets the parameters but the circle, which is the caller's. `noise_q8`: sigma. */
void pf_klt_init(pf_klt *klt, uint32_t window, uint32_t iterations, uint32_t min_eigen, uint32_t noise_q8);

/* Where in a template's bytes its companion begins: rows of whole groups of 8. Vectors read 8 pixels at a time. */
static inline uint32_t pf_relief_at(uint32_t window)
{
    return (window + 2u) * (window + 2u) + 8u;
}

/* Bytes of a template's pixels and of its companion. */
static inline uint32_t pf_anchor_bytes(uint32_t window)
{
    return pf_relief_at(window) + window * ((window + 7u) / 8u * 8u);
}

/* Whether the window around `at`, with one pixel of border, lies inside the image and the circle. */
bool pf_klt_inside(const pf_klt *klt, const pf_image *image, pf_point_q16 at);

/* Finds in `to` what lies at `from_pos` in `from`, coarse to fine from level `top` to level `last`; *to_pos is the
 * start guess in and the result out. Translation, gain and bias. The outcome is that of the last level; where a level
 * fails, its start stands. */
pf_fit pf_klt_track(pf_klt *klt, const pf_pyramid *from, const pf_pyramid *to, pf_point_q16 from_pos,
                    pf_point_q16 *to_pos, uint32_t top, uint32_t last);

/* Takes the template of a track at `at` (pf_klt_inside) into `pixels`, pf_anchor_bytes. */
void pf_anchor_take(pf_klt *klt, const pf_image *image, pf_point_q16 at, pf_anchor *anchor, uint8_t *pixels);

/* Aligns the template with `image` by an affine warp, gain and bias, starting at *at and the anchor's last warp;
 * updates both. */
pf_fit pf_anchor_fit(pf_klt *klt, const pf_image *image, pf_anchor *anchor, const uint8_t *pixels, pf_point_q16 *at);

/* Where around `at`, within 4 px, the template, warped as the anchor says, looks most like the image. */
pf_point_q16 pf_anchor_search(pf_klt *klt, const pf_image *image, const pf_anchor *anchor, const uint8_t *pixels,
                              pf_point_q16 at);

/* What a template taken where this one was last fitted carries: what this one does and the noise of its own picture.
 * That of the picture in which they meet is in the new one's; it would count twice. */
void pf_anchor_carry(const pf_anchor *anchor, uint32_t noise_q8, int64_t carried[3]);

/* Covariance of the position, what the template carries included, along the picture's axes; gain as the fit gave it.
 * Fills the three fields of `track`. */
void pf_anchor_covariance(const pf_anchor *anchor, uint32_t noise_q8, int32_t gain_q14, pf_track *track);

/* --- the wall (bow.c) --- */

/* How a patch of a tube's wall bends beyond its affine warp: its pixel x lies at `centre + a (x + bow (x))` with bow =
 * (c[0] xx + c[1] xy + c[2] yy, c[3] xx + c[4] xy + c[5] yy), Q24 per pixel; displacements stay below a pixel. */
typedef struct pf_bow {
    int32_t c[6];
    int32_t warp[4]; /* the affine part a itself, Q16.16, row-major */
    /* How far the light has turned, Q8, at most 2: the fall of the cotangent over its square. Slopes shine with the
     * cotangent; by the fall over it they fade, and what has not faded is that much more than they were, once more over
     * it. */
    int32_t turned_q8;
} pf_bow;

/* The bow of the patch around the whole pixel (x, y) once it is seen around `to`, the tube along the optical axis, the
 * camera driven along it or turned about it. False, and no bow, where the lens does not tell. */
bool pf_bow_between(const pf_track_lens *lens, int32_t half, int32_t x, int32_t y, pf_point_q16 to, pf_bow *bow);

/* --- the tube (wall.c) --- */

#define PF_TUBE_FARTHEST ((1 << 24) * 6 / 10) /* off the axis: no camera stands nearer to the wall */

/* A round tube of radius 1 whose axis runs through (o0, o1) + z (o2, o3) in the camera's frame, at most 0.6 off it. All
 * Q24. Distance from the camera's z axis of the wall in the direction (c, s) at z; */
int64_t pf_tube_reach(int64_t c, int64_t s, int64_t z, const int64_t o[4]);

/* and where a ray of that direction and cotangent meets it; *z gets how far along, from -1 to 4. */
int64_t pf_tube_wall(int64_t c, int64_t s, int64_t cot, const int64_t o[4], int64_t *z);

/* --- relief (relief.c) --- */

/* The companion of the template in klt (.t, its gradients and `plane`, its sums times 1, x, y) around (x, y): what
 * comes up under a pattern of slopes as the light comes to stand square on them. Fills `relief` and the anchor's fields
 * of that name; `sum_j` are set, .c and .sum are scratch. Zero without a lens and a circle. */
void pf_relief_make(pf_klt *klt, pf_anchor *anchor, const int64_t plane[3], int8_t *relief);

/* --- bearings (rotation.c) --- */

#define PF_ROTATION_LEAST 8u /* fewer pairs of bearings say nothing */

static inline bool pf_ray_valid(const pf_ray_q30 *ray)
{
    return ray->x != 0 || ray->y != 0 || ray->z != 0;
}

/* Sine of the polar angle, Q30. */
static inline int64_t pf_ray_sine(const pf_ray_q30 *ray)
{
    return pf_isqrt64((uint64_t)((int64_t)ray->x * ray->x + (int64_t)ray->y * ray->y));
}

/* Row-major Q30 rotation times a ray, each coordinate within 1 LSB. */
void pf_ray_rotate(const int32_t r[9], const pf_ray_q30 *v, pf_ray_q30 *out);

/* Squared chord between two unit rays, Q2.30, at most 3 LSB too low, saturating just below 4. */
uint32_t pf_ray_chord2(const pf_ray_q30 *a, const pf_ray_q30 *b);

/* r <- C(w) r with Cayley's map of the small rotation w, Q30 rad: for |w| << 1 the rotation by w. */
void pf_rotation_turn(const int32_t w[3], int32_t r[9]);

/* The rotation (row-major, Q30) that takes the rays a[n] to b[n], n <= 2048, with Cauchy weights of 0.05 rad: what
 * moved with the others counts, near walls that did not count little. From 30 degrees apart and less it converges.
 * Invalid rays (0, 0, 0) are left out. Returns the pairs used; with fewer than PF_ROTATION_LEAST, or where they do not
 * determine a rotation, r is what was found so far (first the identity). Exact data: within 1e-7 rad. */
uint32_t pf_rotation_fit(const pf_ray_q30 *a, const pf_ray_q30 *b, uint32_t n, int32_t r[9]);

/* Value of rank k (0 = least, k < n) by bisection over the bits: the array stays, no order of ties matters. */
uint32_t pf_value_of_rank(const uint32_t *value, uint32_t n, uint32_t k);

/* --- detection (corners.c) --- */

/* From the border: a corner is placed within 2 px, by a tensor over 5 x 5 of 3 x 3 gradients. */
#define CORNER_REACH 6

typedef struct pf_corner {
    int32_t x, y;
    int32_t strength; /* twice the smaller eigenvalue of the summed tensor of doubled gradients */
} pf_corner;

typedef struct pf_corner_scratch {
    pf_tensor_row row[3], sum;
} pf_corner_scratch;

/* Says whether a corner may be put at (x, y). */
typedef bool (*pf_corner_allowed)(const void *context, int32_t x, int32_t y);

/* The strongest corner of each quarter of the rectangle x0 <= x < x1, y0 <= y < y1 (at most CELL_MAX a side) with
 * strength > `least`, at even coordinates where there is a half resolution. The rectangle keeps CORNER_REACH pixels
 * from the border. Returns how many of the four there are. */
uint32_t pf_corner_scan(pf_corner_scratch *scratch, const pf_pyramid *pyramid, const int32_t box[4], int32_t least,
                        pf_corner_allowed allowed, const void *context, pf_corner best[4]);

/* The place of a corner at full resolution, to a fraction of a pixel, at most 2.5 px from where it was found. */
pf_point_q16 pf_corner_place(const pf_image *image, const pf_corner *corner);

/* `min_eigen` of the configuration in the unit of pf_corner.strength. */
int32_t pf_corner_least(uint32_t min_eigen);

#endif
