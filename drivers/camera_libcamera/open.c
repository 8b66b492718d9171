#include "camera_libcamera/libcamera.h"

pf_status pf_libcamera_open(pf_camera_source *source, const pf_camera_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_session_io io;
    pf_status status = pf_session_libcamera(&io, &failure);
    if (status != PF_OK)
        return pf_failure_copy(&failure, status, error, n);
    return pf_camera_open(source, config, &io, "libcamera", error, n);
}
