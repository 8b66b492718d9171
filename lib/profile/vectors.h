/* Self-test vectors: what the camera of a profile must compute, stored with it. Layout: SPEC.md. */
#ifndef PIPEFISH_PROFILE_VECTORS_H
#define PIPEFISH_PROFILE_VECTORS_H

#include "pipefish/profile.h"

#define PF_VECTOR_BYTES 64u /* xyz[3], uv[2], ray[3] */

/* The i-th vector of a checked camera, i < PF_PROFILE_VECTORS, as its eight numbers. PF_ERR_DOMAIN: the camera cannot
 * do what its check promised. */
pf_status pf_vectors_at(const pf_camera *camera, uint32_t i, double value[8]);

/* Writes PF_PROFILE_VECTORS vectors, spread over the domain of a checked camera. Errors as pf_vectors_at. */
pf_status pf_vectors_write(const pf_camera *camera, uint8_t *out);

/* Recomputes `count` vectors. PF_OK; PF_ERR_FORMAT (not finite), PF_ERR_SELF_TEST (the camera disagrees). */
pf_status pf_vectors_check(const pf_camera *camera, const uint8_t *bytes, uint32_t count, const char **why);

#endif
