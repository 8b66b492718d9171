/* The integer self-test of a profile: what the fixed-point camera must compute, bit for bit. A room of its own, for it
 * needs that camera and memory to build it in.
 *
 * Workspace: pf_camera_fixed_workspace_size(&profile->camera) bytes, at most PF_CAMERA_FIXED_WORKSPACE_MAX, 16-byte
 * aligned; its contents are undefined afterwards. */
#ifndef PIPEFISH_PROFILE_INTEGERS_H
#define PIPEFISH_PROFILE_INTEGERS_H

#include "pipefish/camera_fixed.h"
#include "pipefish/profile.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Sets the integer vectors of a profile whose camera pf_camera_check accepts: the pixels of the other self-test
 * vectors, those that Q16.16 can hold. Returns PF_OK, or with integers_count = 0 PF_ERR_UNSUPPORTED (a lens beyond the
 * range of fixed point: the profile has no integer self-test), PF_ERR_SPACE. */
pf_status pf_profile_integers_make(pf_profile *profile, void *workspace, size_t size);

/* Recomputes the integer vectors of a profile that pf_profile_decode gave.
 * Returns PF_OK (also where there are none); PF_ERR_SELF_TEST (this device computes something else than the profile
 * says); PF_ERR_UNSUPPORTED (this device cannot build the camera in fixed point); PF_ERR_SPACE. `why` (may be NULL): as
 * of decode. */
pf_status pf_profile_integers_check(const pf_profile *profile, void *workspace, size_t size, const char **why);

#ifdef __cplusplus
}
#endif
#endif
