/* A kernel with one V4L2 camera, made up: its clock stands still but for what waits, its calls fail on demand, and it
 * fails the test of whoever uses it wrongly (queues twice, opens twice, closes with a mapping left). test_v4l2.c is
 * built on it. */
#ifndef V4L2_KERNEL_H
#define V4L2_KERNEL_H

#include "camera_v4l2/v4l2.h"

#define MS UINT64_C(1000000)

enum { W = 64, H = 48, STRIDE = 80, SLOTS = 8, FORMATS = 4, BYTES = 2 * STRIDE * H, MAPS = 64 };

typedef struct fake_format {
    uint32_t fourcc, rate; /* rate 0 = it does not tell */
} fake_format;

/* One camera at /dev/video0. */
typedef struct v4l2_kernel {
    uint64_t now, next_frame, period;
    bool is_plugged, is_open, is_streaming, is_silent, restart_helps, has_error, is_busy;
    bool is_busy_early; /* is_busy is told when the format is set, not when buffers are asked for */
    bool is_busy_file;  /* or when it is opened */
    fake_format formats[FORMATS];
    uint32_t n_formats, width, height, fourcc, sequence, n_buffers, restarts;
    bool is_queued[SLOTS], is_done[SLOTS], is_mplane;
    uint32_t image_size; /* that it tells */
    uint32_t header;     /* bytes before each picture: multi-planar cameras tell of them */
    uint32_t done[SLOTS], n_done, flags[SLOTS], numbers[SLOTS], damaged_next;
    uint64_t stamps[SLOTS];
    uint8_t memory[MAPS][BYTES]; /* a fresh one for each mapping: what is unmapped is never seen again */
    bool is_mapped[MAPS], is_kept[MAPS];
    uint32_t n_maps, base;
    int32_t exposure_auto;         /* a control that outlives the program, as all do */
    int calls, fail_at, fail_with; /* the call number that fails; 0 = none */
    uint64_t call_ns;              /* each takes so long, and fails: the camera does not answer */
} v4l2_kernel;

extern v4l2_kernel k;
extern const pf_v4l2_io v4l2_kernel_io;

/* As after a boot: a camera of YUYV and GREY at ten frames a second. */
void v4l2_kernel_reset(void);

#endif
