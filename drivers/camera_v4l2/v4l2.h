/* The V4L2 driver's parts. */
#ifndef PIPEFISH_V4L2_H
#define PIPEFISH_V4L2_H

#include "camera_common/session.h"

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

typedef struct pf_v4l2_buffer {
    uint8_t *memory;
    size_t size;
    bool is_queued, is_held;
} pf_v4l2_buffer;

typedef struct pf_v4l2_control {
    bool is_there;
    bool is_manual; /* the camera's own automatics of it have been switched off */
    uint32_t id;
} pf_v4l2_control;

/* A session (camera_common/session.h) on one device. */
typedef struct pf_v4l2 {
    pf_v4l2_io io;
    void (*alive)(void); /* pf_camera_config */
    const char *device;  /* the wish's */
    int fd;              /* -1 = not open */
    bool is_streaming, is_compressed;
    uint32_t type; /* V4L2_BUF_TYPE_VIDEO_CAPTURE or its _MPLANE */
    uint32_t n;
    pf_v4l2_buffer buffer[PF_SESSION_BUFFERS_MAX];
    pf_v4l2_buffer kept[PF_CAMERA_HELD_MAX]; /* of devices that were closed, our own memory by now */
    pf_v4l2_control time_control, gain_control;
    pf_failure *failure; /* of the call that is under way */
} pf_v4l2;

/* All calls of the device go through it. */
int pf_v4l2_ioctl(pf_v4l2 *c, unsigned long request, void *argument);

/* The same with the device's name in the failure. PF_OK; PF_ERR_AGAIN (busy: another program has it now, and drivers
 * say so to the first call that would change anything); PF_ERR_IO. */
pf_status pf_v4l2_call(pf_v4l2 *c, unsigned long request, void *argument, const char *what);

/* negotiate.c: format, size and rate of an open device. Fills those of *info, or says why not. PF_ERR_AGAIN: it has no
 * picture to give yet. */
pf_status pf_v4l2_negotiate(pf_v4l2 *c, const pf_session_wish *wish, pf_session_info *info);

/* controls.c: finds the controls of a negotiated device, and sets them as a session's set(). */
void pf_v4l2_controls_find(pf_v4l2 *c, pf_session_info *info);
void pf_v4l2_controls_set(pf_v4l2 *c, bool is_automatic, int64_t time, int64_t gain);

#endif
