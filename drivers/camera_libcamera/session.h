/* What the libcamera driver needs of libcamera, as pointers to functions: the library is C++ and wants a real camera,
 * the driver's decisions are C and are tested with one made up. All calls come from one thread. */
#ifndef PIPEFISH_LIBCAMERA_SESSION_H
#define PIPEFISH_LIBCAMERA_SESSION_H

#include "camera_common/convert.h"
#include "camera_common/exposure.h"
#include "pipefish/drivers/camera.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_SESSION_BUFFERS_MAX 32u
#define PF_SESSION_GAIN_UNIT   64 /* gains in the ranges below count in 64ths */

typedef struct pf_session_wish {
    const char *device; /* a part of the camera's id; "" = the first */
    uint32_t width, height, buffers;
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
    pf_exposure_range time, gain; /* microseconds; 64ths */
} pf_session_info;

typedef struct pf_session_frame {
    uint32_t buffer, sequence;
    uint8_t *pixels;
    size_t n;          /* bytes filled */
    uint64_t stamp_ns; /* 0 = none */
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

    /* The oldest filled buffer; it is held from now on. PF_OK; PF_ERR_AGAIN; PF_ERR_CLOSED (unplugged). */
    pf_status (*take)(void *self, uint32_t timeout_ms, pf_session_frame *frame, pf_failure *failure);

    /* Gives a held buffer back to be filled. */
    void (*give)(void *self, uint32_t buffer);

    /* Goes with the next frames to be begun. Whatever is not has_ in the info is left alone. */
    void (*set)(void *self, bool is_automatic, int64_t time, int64_t gain);

    /* Before close(): a held buffer's memory stays, as our own, until it is dropped. */
    void (*keep)(void *self, uint32_t buffer);
    void (*drop)(void *self, uint8_t *pixels);

    void (*close)(void *self); /* of the camera; another open() may follow */
    void (*end)(void *self);   /* frees everything, self included */
} pf_session_io;

/* libcamera itself. PF_OK, PF_ERR_IO. */
pf_status pf_session_libcamera(pf_session_io *io, pf_failure *failure);

/* As pf_libcamera_open, on any session; it is the driver's from now on, also when this fails. */
pf_status pf_libcamera_open_with(pf_camera_source *source, const pf_camera_config *config, const pf_session_io *io,
                                 char *error, size_t n);

#ifdef __cplusplus
}
#endif

#endif
