/* A calibration profile: one camera, what is known about it and how well. Stored on the device as the versioned,
 * checksummed binary that lib/profile/SPEC.md describes byte by byte; as JSON for people (docs/profile.md).
 */
#ifndef PIPEFISH_PROFILE_H
#define PIPEFISH_PROFILE_H

#include "pipefish/camera.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_PROFILE_FORMAT     2u    /* version of the binary format that encode writes; decode reads 1 too */
#define PF_PROFILE_NAME_MAX   64u   /* bytes including the terminating zero */
#define PF_PROFILE_TOOL_MAX   32u   /* likewise */
#define PF_PROFILE_FREE_MAX   40u   /* most parameters with a covariance */
#define PF_PROFILE_BINARY_MAX 8192u /* most bytes an encoded profile can take */
#define PF_PROFILE_VECTORS    8u    /* self-test vectors that encode writes, and the most that decode takes */
#define PF_PROFILE_INTEGERS   8u    /* most integer self-test vectors */

typedef enum pf_profile_source {
    PF_SOURCE_UNKNOWN = 0,
    PF_SOURCE_TARGET = 1,    /* calibrated from target images */
    PF_SOURCE_SELFCAL = 2,   /* self-calibrated from a scene */
    PF_SOURCE_IMPORTED = 3,  /* converted from another tool's file */
    PF_SOURCE_SIMULATED = 4, /* fitted to a simulator's lens */
} pf_profile_source;

/* What the fixed-point camera must compute, exactly: the ray of a pixel, and the pixel that this ray projects to. */
typedef struct pf_profile_integers {
    pf_point_q16 pixel;
    pf_ray_q30 ray;
    pf_point_q16 back;
} pf_profile_integers;

typedef struct pf_profile {
    pf_camera camera;
    char name[PF_PROFILE_NAME_MAX];   /* of the camera; all texts: UTF-8 without control characters */
    char serial[PF_PROFILE_NAME_MAX]; /* of the unit; "" = unknown, as for the texts below */
    char lens[PF_PROFILE_NAME_MAX];   /* maker, type and focus */
    uint32_t source;                  /* pf_profile_source */
    int64_t created_unix_s;           /* 0 = unknown; up to the end of the year 9999 */
    double rms_px;                    /* residual of the calibration, >= 0; NaN = unknown */
    double held_out_rms_px;           /* of views that the calibration did not see, >= 0; NaN = unknown */
    double theta_covered;             /* largest theta that data covered, radians, below pi; 0 = unknown */
    char tool[PF_PROFILE_TOOL_MAX];   /* what made it: program, its version, how it chose the model */
    char tool_version[PF_PROFILE_TOOL_MAX];
    char model_choice[PF_PROFILE_NAME_MAX];
    uint32_t views, points, held_out_views;  /* that went into rms_px, and into held_out_rms_px; 0 = unknown */
    uint32_t free_count;                     /* 0 = no covariance */
    uint8_t free_param[PF_PROFILE_FREE_MAX]; /* pf_camera_param, increasing */
    double covariance[PF_PROFILE_FREE_MAX * (PF_PROFILE_FREE_MAX + 1) / 2]; /* lower triangle by rows */
    uint32_t integers_count; /* 0 = no integer self-test; pipefish/profile_integers.h makes and checks it */
    pf_profile_integers integers[PF_PROFILE_INTEGERS];
} pf_profile;

/* Encodes into out[capacity], with self-test vectors as this build computes them (the integer ones are the profile's),
 * and checks as decode does: what this writes, decode reads. *n gets the bytes written.
 * Returns PF_OK or, with out[] undefined, PF_ERR_SPACE, PF_ERR_ARGUMENT (a value, string or count out of range),
 * PF_ERR_DOMAIN, PF_ERR_UNSUPPORTED (the camera; see pf_camera_check). `why` (may be NULL): as of decode. */
pf_status pf_profile_encode(const pf_profile *profile, uint8_t *out, size_t capacity, size_t *n, const char **why);

/* Decodes and checks everything: length, checksum, version, strings, ranges, finiteness, pf_camera_check, variances not
 * negative, correlations within -1..1, and the self-test: each vector is recomputed, and must agree within 1e-9 px and
 * 1e-12 of a unit ray. Integer vectors are only read: this room does not know the fixed-point camera, see
 * pf_profile_integers_check. Reads exactly one profile: bytes left over are PF_ERR_FORMAT.
 * Returns PF_OK or, with *profile untouched:
 *      PF_ERR_TRUNCATED, PF_ERR_CHECKSUM, PF_ERR_VERSION, PF_ERR_FORMAT (not a profile, or a value out of range),
 *      PF_ERR_DOMAIN, PF_ERR_UNSUPPORTED (the camera; see pf_camera_check),
 *      PF_ERR_SELF_TEST (this device computes something else than the profile says)
 * `why` (may be NULL) gets a static text, "field: reason" ("ok" for PF_OK).
 * Cost: for each vector some 35 back-projections (the rim is searched) beside the proof of pf_camera_check.
 * Stack: 8.5 kB, of which 7.5 kB are the factor of a covariance of 40 parameters. */
pf_status pf_profile_decode(const uint8_t *bytes, size_t n, pf_profile *profile, const char **why);

#ifdef __cplusplus
}
#endif
#endif
