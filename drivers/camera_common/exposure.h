/* Auto-exposure for a camera that carries its own light, without a device. In a pipe the wall beside the lens is bright
 * and the depth black whatever one does, so neither mean nor median say anything; what counts is that the bright wall
 * keeps its texture. A high percentile of the image circle is therefore led to a target below white. Exposure comes
 * first, for gain brings noise, up to a limit that keeps motion blur small; then gain.
 */
#ifndef PIPEFISH_CAMERA_EXPOSURE_H
#define PIPEFISH_CAMERA_EXPOSURE_H

#include "pipefish/image.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_EXPOSURE_PERCENTILE 95u
#define PF_EXPOSURE_TARGET     190u /* grey level of that percentile */
#define PF_EXPOSURE_BAND       12u  /* nothing changes within target +- this: a lamp flickers more */
#define PF_EXPOSURE_WHITE      250u /* from here on a pixel counts as saturated */
#define PF_EXPOSURE_DELAY      3u   /* frames until a change of the controls is seen for sure */
#define PF_EXPOSURE_STEADY     10u  /* judged frames within the band until it counts as settled */

/* A control of the camera: value = min, min + step, ... max. max = min: it has none. */
typedef struct pf_exposure_range {
    int64_t min, max, step;
} pf_exposure_range;

typedef struct pf_exposure {
    /* parameters */
    pf_exposure_range time, gain;               /* in the camera's own units, both proportional to brightness */
    uint32_t circle_u, circle_v, circle_radius; /* pixels; radius 0 = the whole picture */
    bool holds;                                 /* once settled it stays as it is: for calibration */
    /* what is set now */
    int64_t time_now, gain_now;
    /* statistics */
    uint32_t percentile;       /* of the last frame judged, grey level */
    uint32_t saturated_ppm;    /* of the circle's pixels */
    bool is_settled, at_limit; /* at_limit: it would be brighter or darker if it could */
    /* private */
    uint32_t wait, steady;
    int last_way; /* of the last change that was a single step */
} pf_exposure;

/* Starts from the values that the camera has. */
void pf_exposure_init(pf_exposure *exposure, int64_t time, int64_t gain);

/* Judges a frame; true: time_now or gain_now have changed and are to be set. Looks at every 4th pixel of every 4th row,
 * of one frame in PF_EXPOSURE_DELAY while it changes anything. */
bool pf_exposure_judge(pf_exposure *exposure, const pf_image *image);

#ifdef __cplusplus
}
#endif

#endif
