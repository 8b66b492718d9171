/* What the camera driver (camera.c) needs of a system's cameras, as pointers to functions: V4L2 and libcamera offer it,
 * and so does a camera made up by a test. The driver decides, a session does. All calls come from one thread. */
#ifndef PIPEFISH_CAMERA_SESSION_H
#define PIPEFISH_CAMERA_SESSION_H

#include "camera_common/convert.h"
#include "camera_common/exposure.h"
#include "pipefish/drivers/camera.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_SESSION_BUFFERS_MIN 2u /* one is copied from while the other is filled */
#define PF_SESSION_BUFFERS_MAX 32u

#define PF_SESSION_AS_IS INT64_MIN /* of a control: as whoever set it before */

typedef struct pf_session_wish {
    const char *device;     /* V4L2: its path; libcamera: a part of the camera's id, "" = the first */
    uint32_t width, height; /* 0 = as the camera is set */
    uint32_t buffers;
    double frame_rate;             /* 0 = the camera's own */
    const pf_pixel_format *format; /* NULL = the best it has */
} pf_session_wish;

/* What an opened camera gives. */
typedef struct pf_session_info {
    char id[256];
    uint32_t width, height, stride, buffers;
    double frame_rate; /* 0 = unknown */
    const pf_pixel_format *format;
    bool has_time, has_gain;      /* controls that can be set */
    pf_exposure_range time, gain; /* in the control's own units */
    int64_t time_now, gain_now;   /* as they are set, or a start that a few steps correct */
    double time_unit_us;          /* microseconds of a unit; 0 = unknown */
    double gain_unit;             /* what telemetry and settings count as 1, in units */
} pf_session_info;

typedef struct pf_session_frame {
    uint32_t buffer, sequence;
    uint8_t *pixels;
    size_t n;            /* bytes filled */
    uint64_t stamp_ns;   /* 0 = none */
    bool is_stamp_first; /* of the start of the exposure; else of its end */
    bool is_damaged;
    uint32_t exposure_us; /* as the frame says; 0 = it does not */
    double gain;          /* likewise */
} pf_session_frame;

typedef struct pf_session_io {
    void *self;
    uint64_t (*now)(void *self);
    void (*sleep)(void *self, uint32_t ms);

    /* Finds, configures and maps a camera. PF_OK; PF_ERR_AGAIN (not there now); PF_ERR_UNSUPPORTED; PF_ERR_IO. */
    pf_status (*open)(void *self, const pf_session_wish *wish, pf_session_info *info, pf_failure *failure);

    /* Begins to fill all buffers that are not held. */
    pf_status (*start)(void *self, pf_failure *failure);
    void (*stop)(void *self);

    /* The oldest filled buffer; it is held from now on. PF_OK; PF_ERR_AGAIN; PF_ERR_CLOSED (unplugged); PF_ERR_IO (the
     * queue has failed). */
    pf_status (*take)(void *self, uint32_t timeout_ms, pf_session_frame *frame, pf_failure *failure);

    /* Gives a held buffer back to be filled. */
    void (*give)(void *self, uint32_t buffer);

    /* Goes with the next frames to be begun. Whatever is not has_ in the info, or PF_SESSION_AS_IS, is left alone;
     * is_automatic: the camera is to do it itself. */
    void (*set)(void *self, bool is_automatic, int64_t time, int64_t gain);

    /* Before close(): a held buffer's memory stays, as our own, until it is dropped. */
    void (*keep)(void *self, uint32_t buffer);
    void (*drop)(void *self, uint8_t *pixels);

    void (*close)(void *self); /* of the camera; another open() may follow */
    void (*end)(void *self);   /* frees everything, self included */
} pf_session_io;

/* A camera driver on any session, which is the driver's from now on, also when this fails; `kind` ("v4l2") begins its
 * name. Otherwise as pf_v4l2_open. */
pf_status pf_camera_open(pf_camera_source *source, const pf_camera_config *config, const pf_session_io *io,
                         const char *kind, char *error, size_t n);

#ifdef __cplusplus
}
#endif

#endif
