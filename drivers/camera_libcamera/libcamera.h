/* libcamera as a session. */
#ifndef PIPEFISH_LIBCAMERA_H
#define PIPEFISH_LIBCAMERA_H

#include "camera_common/session.h"

#ifdef __cplusplus
extern "C" {
#endif

/* PF_OK, PF_ERR_SPACE; PF_ERR_UNSUPPORTED where this was built without it. */
pf_status pf_session_libcamera(pf_session_io *io, pf_failure *failure);

#ifdef __cplusplus
}
#endif

#endif
