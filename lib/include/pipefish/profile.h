/* A calibration profile: one camera, what is known about it and how well. Stored on the device as the versioned,
 * checksummed binary that docs/profile.md describes byte by byte; as JSON for people (host_tools).
 */
#ifndef PIPEFISH_PROFILE_H
#define PIPEFISH_PROFILE_H

#include "pipefish/camera.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_PROFILE_FORMAT     1u    /* version of the binary format */
#define PF_PROFILE_NAME_MAX   64u   /* bytes including the terminating zero */
#define PF_PROFILE_FREE_MAX   40u   /* most parameters with a covariance */
#define PF_PROFILE_BINARY_MAX 8192u /* most bytes an encoded profile can take */

typedef enum pf_profile_source {
    PF_SOURCE_UNKNOWN = 0,
    PF_SOURCE_TARGET = 1,    /* calibrated from target images */
    PF_SOURCE_SELFCAL = 2,   /* self-calibrated from a scene */
    PF_SOURCE_IMPORTED = 3,  /* converted from another tool's file */
    PF_SOURCE_SIMULATED = 4, /* fitted to a simulator's lens */
} pf_profile_source;

/* Parameters that may be free, as numbers in the file: 0 f_u, 1 f_v, 2 skew, 3 c_u, 4 c_v, 5..8 k2..k5 (so far as
 * pf_camera_param), 9 asym_radial_theta[3], 12 asym_radial_phi[4], 16 asym_tangential_theta[3],
 * 19 asym_tangential_phi[4], 23 tilt[2], 25 mirror, 26 pupil_e1, 27 cpoly[14]. */
#define PF_PROFILE_PARAMS 41u

typedef struct pf_profile {
    pf_camera camera;
    char name[PF_PROFILE_NAME_MAX];          /* model and lens, UTF-8 without control characters */
    char serial[PF_PROFILE_NAME_MAX];        /* of the camera; "" = unknown */
    uint32_t source;                         /* pf_profile_source */
    int64_t created_unix_s;                  /* 0 = unknown; up to the end of the year 9999 */
    double rms_px;                           /* residual of the calibration, >= 0; NaN = unknown */
    double theta_covered;                    /* largest theta that data covered, radians, below pi; 0 = unknown */
    uint32_t free_count;                     /* 0 = no covariance */
    uint8_t free_param[PF_PROFILE_FREE_MAX]; /* numbers as above, increasing */
    double covariance[PF_PROFILE_FREE_MAX * (PF_PROFILE_FREE_MAX + 1) / 2]; /* lower triangle by rows */
} pf_profile;

/* Encodes into out[capacity], and checks as decode does: what this writes, decode reads. *n gets the bytes written.
 * Returns PF_OK or, with out[] undefined, PF_ERR_SPACE, PF_ERR_ARGUMENT (a value, string or count out of range),
 * PF_ERR_DOMAIN, PF_ERR_UNSUPPORTED (the camera; see pf_camera_check). `why` (may be NULL): as of decode. */
pf_status pf_profile_encode(const pf_profile *profile, uint8_t *out, size_t capacity, size_t *n, const char **why);

/* Decodes and checks everything: length, checksum, version, strings, ranges, finiteness, pf_camera_check, variances not
 * negative and correlations within -1..1. Reads exactly one profile: bytes left over are PF_ERR_FORMAT.
 * Returns PF_OK or, with *profile untouched:
 *      PF_ERR_TRUNCATED, PF_ERR_CHECKSUM, PF_ERR_VERSION, PF_ERR_FORMAT (not a profile, or a value out of range),
 *      PF_ERR_DOMAIN, PF_ERR_UNSUPPORTED (the camera; see pf_camera_check)
 * `why` (may be NULL) gets a static text, "field: reason" ("ok" for PF_OK). */
pf_status pf_profile_decode(const uint8_t *bytes, size_t n, pf_profile *profile, const char **why);

#ifdef __cplusplus
}
#endif
#endif
