/* The inner loops of the aligners, each twice: portable C (pf_c_*, the reference, and what runs where there are no
 * vectors) and vectors (pf_neon_*). Both give the same bits: every sum is exact. tests/unit/test_kernels compares them.
 *
 * Patches are rows of PATCH_ROW 16-bit numbers, of which `groups` groups of 8 are filled. Pixels are Q4 less 2040,
 * gradients and bounds as said. The largest sums of 31 columns in 4 groups decide where 32 bits suffice.
 */
#ifndef PIPEFISH_TRACK_KERNELS_H
#define PIPEFISH_TRACK_KERNELS_H

#include <stddef.h>
#include <stdint.h>

#define WINDOW_MAX 31
#define PATCH_ROW  40 /* row stride of a patch: window + 2 border columns, padded to whole groups of 8 */
#define PATCH_MAX  ((WINDOW_MAX + 2) * PATCH_ROW)
#define PIXEL_ONE  16   /* a grey level in a patch */
#define PIXEL_MID  2040 /* what a patch is less than 16 times the grey level */

/* A bilinear patch of `rows` rows whose top-left sample lies (fx, fy) (Q15) right of and below the pixel p. Reads
 * rows + 1 rows of 8 groups + 1 pixels. */
typedef struct pf_spot {
    const uint8_t *p;
    size_t stride;
    int16_t fx, fy;
} pf_spot;

/* Sums over a template: of itself, of its squares, of its doubled gradients (Q4, |.| <= 4080), and of products. */
typedef struct pf_template_sums {
    int64_t t, tt, x, y, xx, xy, yy, xt, yt;
} pf_template_sums;

/* Sums over a sampled patch c, its squares, and its products with the template and the template's gradients. */
typedef struct pf_step_sums {
    int64_t c, cc, ct, cx, cy;
} pf_step_sums;

/* Sums over a warped patch c: times 1, x, y (from the centre); its squares, its products with the template and with the
 * steepest-descent images gx, gy, x gx, y gx, x gy, y gy. */
typedef struct pf_affine_sums {
    int64_t c[3], cc, ct, b[6];
} pf_affine_sums;

/* An affine window: sample (x, y) of the window, from its centre, lies at centre + a (x, y); Q16.16. */
typedef struct pf_warp {
    const uint8_t *data;
    size_t stride;
    uint32_t width, height;
    int32_t x, y, a[4];
} pf_warp;

/* Of a template kept as pixels: the patch, smoothed as sampling smooths (`smooth`: a half f (1 - f) along x and y, Q15,
 * f the fraction of a pixel; at most 1/8); gradients, Q3, |.| <= 1020, Sobel; and x times them. */
typedef struct pf_gradients {
    int16_t *t, *gx, *gy, *xgx, *xgy;
    int16_t smooth[2];
} pf_gradients;

/* Sums over a template for the normal equations, j the six steepest-descent images: j j', j times 1, x, y; the template
 * times these; j times the template; the template's square. Of h the upper triangle. */
typedef struct pf_normal_sums {
    int64_t h[6][6], j[6][3], t[3], jt[6], tt;
} pf_normal_sums;

/* What a row adds to them: products of t, gx, gy, px = x gx, py = x gy. */
enum pf_row_sum {
    ROW_T,
    ROW_XT,
    ROW_TT,
    ROW_GX,
    ROW_GY,
    ROW_PX,
    ROW_PY,
    ROW_XPX,
    ROW_XPY,
    ROW_GX_T,
    ROW_GY_T,
    ROW_PX_T,
    ROW_PY_T,
    ROW_GX_GX,
    ROW_GX_GY,
    ROW_GY_GY,
    ROW_GX_PX,
    ROW_GX_PY,
    ROW_GY_PY,
    ROW_PX_PX,
    ROW_PX_PY,
    ROW_PY_PY,
    ROW_SUMS
};

/* Adds the row at height y: the images are gx, gy, px, y gx, py, y gy. */
static inline void pf_normal_add(pf_normal_sums *s, const int64_t v[ROW_SUMS], int64_t y)
{
    const int64_t h[21] = {v[ROW_GX_GX],        v[ROW_GX_GY],         v[ROW_GX_PX],     y * v[ROW_GX_GX],
                           v[ROW_GX_PY],        y * v[ROW_GX_GY],     v[ROW_GY_GY],     v[ROW_GX_PY],
                           y * v[ROW_GX_GY],    v[ROW_GY_PY],         y * v[ROW_GY_GY], v[ROW_PX_PX],
                           y * v[ROW_GX_PX],    v[ROW_PX_PY],         y * v[ROW_GX_PY], y * y * v[ROW_GX_GX],
                           y * v[ROW_GX_PY],    y * y * v[ROW_GX_GY], v[ROW_PY_PY],     y * v[ROW_GY_PY],
                           y * y * v[ROW_GY_GY]};
    const int64_t j[6][3] = {{v[ROW_GX], v[ROW_PX], y * v[ROW_GX]},  {v[ROW_GY], v[ROW_PY], y * v[ROW_GY]},
                             {v[ROW_PX], v[ROW_XPX], y * v[ROW_PX]}, {y * v[ROW_GX], y * v[ROW_PX], y * y * v[ROW_GX]},
                             {v[ROW_PY], v[ROW_XPY], y * v[ROW_PY]}, {y * v[ROW_GY], y * v[ROW_PY], y * y * v[ROW_GY]}};
    const int64_t jt[6] = {v[ROW_GX_T], v[ROW_GY_T], v[ROW_PX_T], y * v[ROW_GX_T], v[ROW_PY_T], y * v[ROW_GY_T]};
    const int64_t t[3] = {v[ROW_T], v[ROW_XT], y * v[ROW_T]};
    for (int32_t a = 0, k = 0; a < 6; a++) {
        for (int32_t b = a; b < 6; b++)
            s->h[a][b] += h[k++];
        for (int32_t b = 0; b < 3; b++)
            s->j[a][b] += j[a][b];
        s->jt[a] += jt[a];
    }
    for (int32_t b = 0; b < 3; b++)
        s->t[b] += t[b];
    s->tt += v[ROW_TT];
}

#define CELL_MAX   256
#define CORNER_ROW (CELL_MAX + 24) /* a cell, a border column on either side, and whole groups of 8 */

/* A row of structure tensors: trace, difference of the diagonal, twice the other term. */
typedef struct pf_tensor_row {
    int32_t k[3][CORNER_ROW];
} pf_tensor_row;

#define PF_DECLARE_KERNELS(set)                                                                                        \
    /* The patch at `spot`, unmasked. */                                                                               \
    void set##_sample(const pf_spot *spot, int32_t rows, int32_t groups, int16_t *out);                                \
    /* Template and doubled gradients, masked, of a raw patch with a border of one sample all around. */               \
    void set##_template(const int16_t *raw, const int16_t *mask, int32_t rows, int32_t groups, int16_t *t,             \
                        int16_t *gx, int16_t *gy, pf_template_sums *sums);                                             \
    /* Samples at `spot`, masked, and sums against the template. */                                                    \
    void set##_step(const pf_spot *spot, const int16_t *mask, int32_t rows, int32_t groups, const int16_t *t,          \
                    const int16_t *gx, const int16_t *gy, pf_step_sums *sums);                                         \
    /* A template's pixels, (window + 2)^2 bytes and 8 readable ones behind, to patch and gradients. */                \
    void set##_unpack(const uint8_t *pixels, const int16_t *mask, int32_t window, int32_t groups,                      \
                      const pf_gradients *out);                                                                        \
    /* Bends such a template by `bow`, Q24 per pixel (pf_bow): what lies at x comes from x - bow(x), to the first      \
     * order. Displacements are below a pixel; the template stays within +-PIXEL_MID. */                               \
    void set##_bend(const int32_t bow[6], int32_t window, int32_t groups, const pf_gradients *g);                      \
    /* Samples the warped window, which lies inside the image with a pixel to spare. */                                \
    void set##_warp(const pf_warp *warp, const int16_t *mask, int32_t window, int32_t groups, int16_t *out);           \
    void set##_affine(const int16_t *c, const pf_gradients *g, int32_t window, int32_t groups, pf_affine_sums *sums);  \
    void set##_normal(const pf_gradients *g, int32_t window, int32_t groups, pf_normal_sums *sums);                    \
    /* The sum of a patch times a companion, |.| <= 127, in rows of whole groups. */                                   \
    int64_t set##_relief(const int8_t *relief, const int16_t *c, int32_t window, int32_t groups);                      \
    /* Of the doubled gradients at p[0..n), n rounded up to whole groups of 8. */                                      \
    void set##_tensor(const uint8_t *p, size_t stride, int32_t n, pf_tensor_row *out);                                 \
    /* Sums over 3 x 3 of three rows of such: sum[k][i] over row[j][k][i .. i + 2], i < n. Returns a bound of twice    \
     * the smaller eigenvalue of all of them, at most 9 % of the trace above the largest. */                           \
    int32_t set##_corners(const pf_tensor_row *const row[3], int32_t n, pf_tensor_row *sum);

PF_DECLARE_KERNELS(pf_c)
PF_DECLARE_KERNELS(pf_neon)

#if PF_SIMD
#define PF_KERNEL(name) pf_neon_##name
#else
#define PF_KERNEL(name) pf_c_##name
#endif

#endif
