/* The V4L2 driver's parts. */
#ifndef PIPEFISH_V4L2_H
#define PIPEFISH_V4L2_H

#include "camera_common/convert.h"
#include "camera_common/exposure.h"
#include "camera_common/timing.h"
#include "common/failure.h"
#include "pipefish/drivers/camera.h"

#include <linux/videodev2.h>

/* The system calls, so that tests can be a kernel that fails. */
typedef struct pf_v4l2_io {
    void *self;
    int (*open)(void *self, const char *path); /* non-blocking; -1 and errno */
    void (*close)(void *self, int fd);
    int (*ioctl)(void *self, int fd, unsigned long request, void *argument); /* not interrupted; -1 and errno */
    void *(*map)(void *self, int fd, size_t n, int64_t offset);              /* NULL and errno */
    void (*unmap)(void *self, void *memory, size_t n);
    bool (*keep)(void *self, void *memory, size_t n);     /* pf_mapping_keep */
    int (*wait)(void *self, int fd, uint32_t timeout_ms); /* 1 a frame is there; 0 none; -1 the queue has failed */
    uint64_t (*now)(void *self);
    void (*sleep)(void *self, uint32_t ms);
} pf_v4l2_io;

extern const pf_v4l2_io pf_v4l2_kernel;

/* As pf_v4l2_open, with other system calls; they are copied. */
pf_status pf_v4l2_open_with(pf_camera_source *source, const pf_camera_config *config, const pf_v4l2_io *io, char *error,
                            size_t n);

#define PF_V4L2_BUFFERS_MIN (PF_CAMERA_HELD_MAX + 1) /* with fewer nothing would be left to fill */
#define PF_V4L2_BUFFERS_MAX 32u
#define PF_V4L2_STREAMS     (PF_CAMERA_HELD_MAX + 1) /* a live one, and old ones of which frames are held still */

typedef struct pf_v4l2_buffer {
    struct pf_v4l2_stream *stream;
    uint8_t *memory;
    size_t size;
    bool is_queued, is_held;
} pf_v4l2_buffer;

/* The buffers of one opening of the device: their memory outlives it for as long as frames are held. */
typedef struct pf_v4l2_stream {
    uint32_t n, held;
    bool is_live;
    pf_v4l2_buffer buffer[PF_V4L2_BUFFERS_MAX];
} pf_v4l2_stream;

/* Grey pixels of a format that has to be converted. */
typedef struct pf_v4l2_scratch {
    uint8_t *pixels;
    bool is_held;
} pf_v4l2_scratch;

typedef struct pf_v4l2_control {
    bool is_there;
    uint32_t id;
} pf_v4l2_control;

typedef struct pf_v4l2 {
    pf_camera_info info;
    pf_v4l2_io io;
    char *device;
    const pf_pixel_format *wanted; /* NULL = any */
    uint32_t width, height;        /* configured; 0 = as the device is set */
    uint32_t buffers;
    double frame_rate;
    pf_exposure_mode mode;
    uint32_t exposure_us, exposure_max_us;
    double gain;
    int fd; /* -1 = not there */
    bool is_started, is_streaming;
    uint32_t type; /* V4L2_BUF_TYPE_VIDEO_CAPTURE or its _MPLANE */
    const pf_pixel_format *format;
    uint32_t stride;
    pf_v4l2_stream stream[PF_V4L2_STREAMS], *live;
    pf_v4l2_scratch scratch[PF_CAMERA_HELD_MAX];
    uint32_t held;
    void *turbo;
    pf_v4l2_control time_control, gain_control;
    double time_unit_us; /* 0 = unknown */
    pf_exposure exposure;
    bool has_exposure; /* values were set before: a camera that comes back gets them again */
    pf_numbering numbering;
    pf_recovery recovery;
    uint64_t damaged;
    uint64_t left_ns; /* when next() returned last */
    pf_failure failure;
} pf_v4l2;

/* ioctl with the device's name in the failure. */
pf_status pf_v4l2_call(pf_v4l2 *c, unsigned long request, void *argument, const char *what);

/* negotiate.c: size, format, rate of an open device. Fills format, stride, type and info, or says why not. */
pf_status pf_v4l2_negotiate(pf_v4l2 *c);

/* controls.c: finds the controls of an open device and sets them as configured. */
pf_status pf_v4l2_controls_open(pf_v4l2 *c);
void pf_v4l2_controls_judge(pf_v4l2 *c, const pf_image *image);
void pf_v4l2_controls_report(const pf_v4l2 *c, pf_telemetry *telemetry);

/* stream.c: the buffers of an open, negotiated device. */
pf_status pf_v4l2_stream_begin(pf_v4l2 *c);
pf_status pf_v4l2_stream_restart(pf_v4l2 *c);
void pf_v4l2_stream_end(pf_v4l2 *c);
void pf_v4l2_stream_queue(pf_v4l2 *c); /* gives the kernel all buffers that nobody holds */
void pf_v4l2_stream_release(pf_v4l2 *c, pf_v4l2_buffer *buffer);

/* Takes the oldest filled buffer. PF_OK; PF_ERR_AGAIN (none); PF_ERR_CHECKSUM (one with an error: it is queued again);
 * PF_ERR_CLOSED (unplugged); PF_ERR_IO (the queue has failed). */
pf_status pf_v4l2_stream_take(pf_v4l2 *c, pf_v4l2_buffer **buffer, struct v4l2_buffer *taken, size_t *n);

#endif
