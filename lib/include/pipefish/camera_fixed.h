/* The camera in integers: the whole model of camera.h, symmetric or not, for targets without fast doubles and for
 * results that are the same bits on all of them. A fixed camera is built once from a checked pf_camera (in IEEE
 * doubles, with + - * / only: the same bits too); using it is integers only.
 *
 * Formats: pixels Q16.16, rays Q1.30, angles Q32, the plane of r(theta) as fine as 32 bits allow (Q3.28 where r_max is
 * 4 to 8). r(theta), and with asymmetric terms each harmonic of phi, is a table of cubics: value and slope at 129 to
 * 2049 knots, as many as the lens needs (ordinary ones: 129, 1 KB symmetric, 13 KB with all harmonics).
 *
 * Worst errors, against the model in long double (tests/unit/test_camera_fixed.c asserts them for all radial functions
 * to 110 degrees and beyond, narrow lenses, strong asymmetry, tilt and pupil shift, and for random cameras from all
 * over the legal ranges; docs/camera.md has figures):
 *
 * - projection: 2.2e-5 px + 1e-9 of the way from the principal point + 3.5e-10 rad of the local magnification in pixels
 *   per radian, and with asymmetric terms or tilt 3e-9 / d of the farthest projection's way, d the tilt's least
 *   denominator: 2.3e-5 px for a symmetric fisheye of f = 300, 1e-4 px at most
 * - back-projection: 2e-9 rad + (1e-8 + 2.5e-9 r_max) / r', r_max the farthest point of the plane (with asymmetric
 *   terms, tilt or skew 5e-9 (1 + |skew| / f_u) r_max), r' the least magnification of theta on the plane, before the
 *   tilt or behind it: 2e-7 rad where r' >= 0.18 and r_max <= 5 without skew. For the pixel as it stands: that it was
 *   rounded to Q16.16 moves its ray by 1.1e-5 px / (f r') besides
 * - table of rays: 1e-5 rad, wherever the camera is defined
 *
 * What cannot keep them is refused when the camera is built, never computed wrongly.
 */
#ifndef PIPEFISH_CAMERA_FIXED_H
#define PIPEFISH_CAMERA_FIXED_H

#include "pipefish/camera.h"
#include "pipefish/image.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Opaque; lives in the caller's workspace, read-only once built: any number of threads may use it. */
typedef struct pf_camera_fixed pf_camera_fixed;

#define PF_CAMERA_FIXED_WORKSPACE_MAX 214000u

/* Bytes of workspace for this checked camera; 0 where it cannot be built, see below. 2 KB for ordinary symmetric
 * lenses, PF_CAMERA_FIXED_WORKSPACE_MAX at most. */
size_t pf_camera_fixed_workspace_size(const pf_camera *camera);

/* Builds the tables: some 500 evaluations of r(theta). `camera` is not kept. Returns PF_OK and *fixed (inside
 * `workspace`), or with *fixed untouched
 *   PF_ERR_SPACE        size < pf_camera_fixed_workspace_size
 *   PF_ERR_UNSUPPORTED  some projection lies farther than 32768 px from the principal point (or the image circle's
 *                       radius is more); 2048 intervals do not reach 1e-5 px (r nearly singular); the tilted sensor
 *                       magnifies by more than 8 */
pf_status pf_camera_fixed_init(const pf_camera_fixed **fixed, const pf_camera *camera, void *workspace, size_t size);

/* Projects a ray of any length but 0.
 * Returns PF_OK, or with *pixel untouched PF_ERR_DOMAIN: theta > theta_max (by more than 2e-9 rad: what unproject
 * returns at the rim projects again), no direction, or a pixel beyond Q16.16. With a pupil shift this is the image of
 * what lies on the ray of that direction which enters the lens: the inverse of unproject. */
pf_status pf_camera_fixed_project(const pf_camera_fixed *fixed, pf_ray_q30 ray, pf_point_q16 *pixel);

/* Projects a point whose coordinates have `metre_bits` fractional bits (0..30; a central camera does not care).
 * Returns PF_OK or PF_ERR_DOMAIN as pf_camera_project does (near points of a shifted pupil included), and where the
 * pixel lies beyond Q16.16; PF_ERR_ARGUMENT: metre_bits > 30. */
pf_status pf_camera_fixed_project_point(const pf_camera_fixed *fixed, const int32_t xyz[3], uint32_t metre_bits,
                                        pf_point_q16 *pixel);

/* Back-projects a pixel: the exact inverse of the table by safeguarded Newton. *ray is a unit vector within 2e-9;
 * *origin_z_q27 (may be NULL) gets where it starts on the axis, Q4.27 metres, 0 for a central camera.
 * Returns PF_OK, or with the outputs untouched PF_ERR_DOMAIN: outside the image of theta <= theta_max by more than
 * projection and Q16.16 explain: what project returns comes back, at the rim too, wherever r' >= 1e-3. */
pf_status pf_camera_fixed_unproject(const pf_camera_fixed *fixed, pf_point_q16 pixel, pf_ray_q30 *ray,
                                    int32_t *origin_z_q27);

/* As pf_camera_in_image; the circle rounded to Q16.16. */
bool pf_camera_fixed_in_image(const pf_camera_fixed *fixed, pf_point_q16 pixel);

/* --- A table of rays over the image ---------------------------------------------------------------------------------
 * For whoever needs the rays of many pixels, the tracker first: a grid of square cells, each with a quadratic in both
 * directions for the ray's coordinates, 64 bytes a cell. A cell in which the quadratic is off by more than 8e-6 rad, or
 * through which the rim of the model's domain runs, is computed exactly instead; through a cell on the rim of the image
 * circle or of the sensor the rim is exact to the last bit. Ray origins of a shifted pupil are not tabulated. */
typedef struct pf_camera_rays pf_camera_rays;

/* The largest step (cell side, 4..64 pixels) at which the quadratics suffice in 15 of 16 cells tried: about f / 20. */
uint32_t pf_camera_rays_step(const pf_camera_fixed *fixed);

/* Bytes of workspace: 64 a cell; 1280x800 at step 16: 265 KB. 0 unless step is a power of two, 4..64. */
size_t pf_camera_rays_workspace_size(const pf_camera_fixed *fixed, uint32_t step);

/* Fits the cells (34 back-projections each). `fixed` is borrowed for as long as the table is used. Returns PF_OK and
 * *rays (inside `workspace`), PF_ERR_ARGUMENT (step), PF_ERR_SPACE. */
pf_status pf_camera_rays_init(const pf_camera_rays **rays, const pf_camera_fixed *fixed, uint32_t step, void *workspace,
                              size_t size);

typedef struct pf_camera_rays_stats {
    uint32_t cells;   /* in all */
    uint32_t outside; /* nothing of them on the sensor and in the image circle */
    uint32_t rim;     /* tabulated, with the image's rim through them */
    uint32_t exact;   /* not tabulated: computed exactly at each look-up */
} pf_camera_rays_stats;
pf_camera_rays_stats pf_camera_rays_count(const pf_camera_rays *rays);

/* The ray of a pixel; (0, 0, 0) outside the sensor, the image circle or the domain. */
pf_ray_q30 pf_camera_rays_at(const pf_camera_rays *rays, pf_point_q16 pixel);

/* The same for n pixels, the same bits, with vectors where the target has them. */
void pf_camera_rays_lookup(const pf_camera_rays *rays, size_t n, const pf_point_q16 *pixels, pf_ray_q30 *out);

/* --- Remap tables ---------------------------------------------------------------------------------------------------
 * For each pixel of a view, where in the source image it comes from: the pixel to the upper left and the way to the
 * next in 1/256. 6 bytes a pixel. */
typedef struct pf_remap_q8 {
    int16_t x, y; /* x = PF_REMAP_OUTSIDE: nothing there */
    uint8_t x_q8, y_q8;
} pf_remap_q8;
#define PF_REMAP_OUTSIDE INT16_MIN

/* Entries for n source pixels; those outside the sensor or the image circle become PF_REMAP_OUTSIDE. Up to half a pixel
 * outside the outermost pixel centres the nearest is taken. */
void pf_remap_from_pixels(const pf_camera_fixed *fixed, size_t n, const pf_point_q16 *pixels, pf_remap_q8 *map);

/* Entries for n viewing rays, projected first; those beyond theta_max become PF_REMAP_OUTSIDE too. */
void pf_remap_from_rays(const pf_camera_fixed *fixed, size_t n, const pf_ray_q30 *rays, pf_remap_q8 *map);

/* Draws n pixels of a view by bilinear interpolation, rounded half up: out[i * channels + c]. The source has `channels`
 * bytes a pixel (1..4, interleaved); its width counts pixels, its stride bytes. Outside gets `fill`.
 * Returns PF_OK, or with nothing written PF_ERR_ARGUMENT: channels, stride < width * channels, an entry of the map
 * outside the source. */
pf_status pf_remap_apply(const pf_image *source, uint32_t channels, size_t n, const pf_remap_q8 *map, uint8_t fill,
                         uint8_t *out);

#ifdef __cplusplus
}
#endif
#endif
