/* In place of session.cpp where there was no libcamera to build with. */
#include "camera_libcamera/libcamera.h"

pf_status pf_session_libcamera(pf_session_io *io, pf_failure *failure)
{
    (void)io;
    return pf_fail(failure, PF_ERR_UNSUPPORTED,
                   "libcamera: this program was built without it (install libcamera-dev, build again)");
}
