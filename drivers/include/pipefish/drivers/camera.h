/* What every camera driver offers: recorded frames, V4L2 and libcamera alike. A driver is a struct of pointers to
 * functions and a `self`; the daemon knows nothing else of it. All calls of one camera come from one thread.
 */
#ifndef PIPEFISH_DRIVERS_CAMERA_H
#define PIPEFISH_DRIVERS_CAMERA_H

#include "pipefish/image.h"

/* The other sensors' readings that came with a frame. A reading counts only if its has_ flag is set. */
typedef struct pf_telemetry {
    bool has_encoder, has_attitude, has_exposure, has_gain, has_lamp;
    int64_t encoder_count;
    double roll_rad, pitch_rad;
    double attitude_sigma_rad; /* 0 = not stated */
    uint32_t exposure_us;
    double gain;
    double lamp; /* 0..1 */
} pf_telemetry;

typedef struct pf_frame {
    pf_image image;       /* the driver's memory: valid until release */
    uint64_t sequence;    /* the sensor's own count: a gap means dropped frames */
    uint64_t time_ns;     /* monotonic clock, middle of the exposure */
    uint64_t recorded_ns; /* the recording's own time of a replayed frame; 0 = none */
    pf_telemetry telemetry;
    bool has_sha256; /* a recording states the hash of the pixels; the driver has checked it */
    uint8_t sha256[32];
    void *handle; /* the driver's own */
} pf_frame;

typedef struct pf_camera_info {
    uint32_t width, height;
    double frame_rate; /* nominal; 0 = unknown */
    uint64_t frames;   /* how many there will be; 0 = unknown */
    char source[256];  /* "replay demo.y4m" */
} pf_camera_info;

/* What went wrong so far; a recording has nothing to report. */
typedef struct pf_camera_stats {
    bool is_there;       /* a camera that delivers, or is expected to at any moment */
    uint64_t damaged;    /* frames that the driver marked, that were too short, or whose JPEG was broken */
    uint64_t restarts;   /* of a stream that had stalled */
    uint64_t reopens;    /* of a camera that was unplugged, or that a restart did not help */
    uint64_t bad_stamps; /* frames whose time or number was not to be believed */
} pf_camera_stats;

/* Frames of one camera that may be held at a time: the tracker's reference, the one being tracked, the one taken. */
#define PF_CAMERA_HELD_MAX 3u

typedef struct pf_camera_source {
    void *self;
    const struct pf_camera_source_ops *ops;
} pf_camera_source;

typedef struct pf_camera_source_ops {
    /* Valid from opening on. */
    const pf_camera_info *(*info)(void *self);

    /* Starts capture; frames are due from now on. A recording goes on where it was stopped. PF_OK, PF_ERR_IO. */
    pf_status (*start)(void *self);

    /* Waits up to timeout_ms for the next frame. At most PF_CAMERA_HELD_MAX frames are held at a time.
     * PF_OK; PF_ERR_AGAIN (none yet); PF_ERR_END (a recording is over); PF_ERR_CLOSED (unplugged, or not plugged in
     * yet: ask again, it goes on once the camera is back; error() says why it is not); PF_ERR_IO;
     * PF_ERR_FORMAT, PF_ERR_TRUNCATED, PF_ERR_CHECKSUM (a recording is damaged): error() says what and where, and the
     * next call goes on with the frame after it; PF_ERR_ARGUMENT (not started, too many frames are held already). */
    pf_status (*next)(void *self, uint32_t timeout_ms, pf_frame *frame);

    /* Gives a frame back; its pixels stay as they are until then, whatever becomes of the camera. */
    void (*release)(void *self, pf_frame *frame);

    pf_status (*stop)(void *self);

    void (*stats)(void *self, pf_camera_stats *stats);

    /* The last failure in words, with file and position; "" if there was none. */
    const char *(*error)(void *self);

    void (*close)(void *self); /* frees everything, self included */
} pf_camera_source_ops;

/* Recorded frames: times are the recording's distances from start() on, when the first frame is due. A Y4M file with a
 * telemetry CSV beside it, or a folder of PNG, JPEG or PGM images (docs/recording.md). */
typedef enum pf_replay_speed {
    PF_REPLAY_RECORDED = 0, /* frames come when they came then, however slow the rest is: one that is over a period late
                               is skipped once the next is due, and leaves a gap in the sequence */
    PF_REPLAY_FAST = 1,     /* the next frame as soon as it is asked for */
} pf_replay_speed;

typedef struct pf_replay_config {
    const char *path; /* .y4m, or a folder */
    const char *csv;  /* telemetry; NULL = path with .csv for .y4m (may be absent), telemetry.csv in a folder */
    pf_replay_speed speed;
    uint32_t loops; /* play it so often; 0 = for ever. Sequence and time go on rising, the encoder starts again */
    uint64_t
        loop_gap; /* numbers that the sequence leaves out before the recording begins again: the scene jumps back */
    double frame_rate; /* of a recording without times; 0 = 10 */
} pf_replay_config;

/* Opens and checks a recording (every header, the whole CSV, the first frame). On failure *source is untouched and
 * error[n] says what and where. PF_OK, PF_ERR_IO, PF_ERR_FORMAT, PF_ERR_TRUNCATED, PF_ERR_UNSUPPORTED, PF_ERR_ARGUMENT.
 */
pf_status pf_replay_open(pf_camera_source *source, const pf_replay_config *config, char *error, size_t n);

/* A camera of the kernel's V4L2 (pf_v4l2_open), read where the kernel put the pixels wherever the format has grey
 * bytes and there are buffers enough. It may be unplugged and come back under the same path (best one of
 * /dev/v4l/by-path); a stream that falls silent is restarted.
 */
typedef enum pf_exposure_mode {
    PF_EXPOSURE_AUTO = 0, /* ours, for a camera that carries its own lamp, where the camera can be set */
    PF_EXPOSURE_HOLD,     /* the same until it has settled, then fixed: for calibration */
    PF_EXPOSURE_FIXED,    /* as configured */
    PF_EXPOSURE_DEVICE,   /* the camera's own affair */
} pf_exposure_mode;

typedef struct pf_camera_config {
    const char *device;     /* /dev/video0; of libcamera: a part of the camera's id, "" = the first camera */
    uint32_t width, height; /* pixels; both 0 = as the device is set now; else it may be absent at opening */
    double frame_rate;      /* 1/s; 0 = as the device is set */
    const char *format; /* GREY, NV12, NM12, NV21, YU12, Y10P, Y12P, Y10, Y12, YUYV, UYVY, RGB3, BGR3, MJPG, JPEG; NULL
                           or "" = the best that the camera has */
    uint32_t buffers;   /* 2..32; 0 = 6: the held ones, and three that the camera can fill while nobody looks; of fewer
                           none can be spared, and frames are copied */
    pf_exposure_mode mode;
    uint32_t exposure_us;                       /* FIXED; 0 = as it is */
    double gain;                                /* FIXED, in the camera's units; 0 = as it is */
    uint32_t exposure_max_us;                   /* of AUTO and HOLD: motion blur; 0 = the camera's own limit */
    uint32_t circle_u, circle_v, circle_radius; /* what AUTO and HOLD look at, pixels; radius 0 = the whole picture */
    void (*alive)(void); /* called before each of V4L2's calls, one of which may take five seconds and opening a camera
                            that answers none a minute; by the thread that opens it or asks for frames. NULL: nobody */
} pf_camera_config;

/* On failure *source is untouched and error[n] says what. PF_OK; PF_ERR_IO (absent or in use, and no size is given; not
 * readable); PF_ERR_ARGUMENT; PF_ERR_UNSUPPORTED (it has no such size or format: the text lists what it has). */
pf_status pf_v4l2_open(pf_camera_source *source, const pf_camera_config *config, char *error, size_t n);

/* A camera of libcamera's, for sensors whose pipeline the kernel alone does not put together. It may be unplugged and
 * come back under the same id. NM12, Y10P, Y12P and JPEG are V4L2's only; exposure_us and gain are in
 * microseconds and as a factor. Results as above; PF_ERR_UNSUPPORTED also where it was built without libcamera. */
pf_status pf_libcamera_open(pf_camera_source *source, const pf_camera_config *config, char *error, size_t n);

#endif
