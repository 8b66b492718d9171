/* The driver that V4L2's and libcamera's cameras share, on a session made up here. Proves: frames are used where they
 * lie if there are buffers enough and stay whole while they are held, whatever becomes of the camera; a silent,
 * refusing or unplugged camera comes back by itself; numbers show what was lost; exposure reaches its target. Does not
 * prove: that the systems behave so (test_v4l2.c, tests/hil). */
#include "camera_common/session.h"
#include "unity.h"

#include <stdlib.h>
#include <string.h>

#define MS UINT64_C(1000000)

enum { W = 64, H = 48, STRIDE = 80, BUFFERS = 8, BYTES = STRIDE * H * 3, KEPT = 8 };

enum { FREE = 0, QUEUED, FILLED, HELD };

/* One camera, a frame each period while it is plugged in, started and not silent. */
static struct {
    uint64_t now, next, period;
    bool is_plugged, is_open, is_started, is_silent, stays_silent, has_controls, is_stamp_first, is_over;
    uint32_t buffers, sequence, starts, opens;
    int refuse_starts, refuse_opens, damaged; /* so many of the next */
    bool stays_damaged;                       /* whatever the stream is restarted */
    const char *format;
    uint8_t pool[2][BUFFERS][BYTES], (*memory)[BYTES]; /* those of one opening, and of the one before */
    int state[BUFFERS];
    uint32_t number[BUFFERS];
    uint64_t stamp[BUFFERS];
    uint8_t *kept[KEPT];
    bool is_automatic, was_set;
    int64_t time, gain;
} k;

static pf_camera_source camera;
static char error[256];

static uint64_t fake_now(void *self)
{
    (void)self;
    return k.now;
}

static void fake_sleep(void *self, uint32_t ms)
{
    (void)self;
    k.now += ms * MS;
}

static pf_status fake_open(void *self, const pf_session_wish *wish, pf_session_info *info, pf_failure *failure)
{
    (void)self;
    TEST_ASSERT_FALSE_MESSAGE(k.is_open, "opened twice");
    if (!k.is_plugged)
        return pf_fail(failure, PF_ERR_AGAIN, "no camera");
    if (k.refuse_opens > 0 && k.refuse_opens--)
        return pf_fail(failure, PF_ERR_IO, "refused");
    *info = (pf_session_info){.id = "fake",
                              .width = wish->width ? wish->width : W,
                              .height = wish->height ? wish->height : H,
                              .buffers = k.buffers,
                              .format = wish->format ? wish->format : pf_pixel_format_named(k.format),
                              .frame_rate = wish->frame_rate,
                              .has_time = k.has_controls,
                              .has_gain = k.has_controls,
                              .time = {10, 100000, 1},
                              .gain = {64, 1024, 1},
                              .time_now = 1000,
                              .gain_now = 64,
                              .time_unit_us = 1,
                              .gain_unit = 64};
    uint32_t row = pf_pixel_format_row(info->format, W);
    info->stride = row == W ? STRIDE : row;
    memset(k.state, 0, sizeof k.state);
    k.is_open = true;
    k.memory = k.pool[k.opens++ % 2];
    return PF_OK;
}

static pf_status fake_start(void *self, pf_failure *failure)
{
    (void)self;
    TEST_ASSERT_TRUE(k.is_open && !k.is_started);
    if (k.refuse_starts > 0 && k.refuse_starts--)
        return pf_fail(failure, PF_ERR_IO, "does not start");
    k.is_started = true;
    k.is_silent = k.is_silent && k.stays_silent;
    k.damaged = k.stays_damaged ? k.damaged : 0;
    k.starts++;
    k.sequence = 0; /* as drivers do */
    k.next = k.now + k.period;
    for (uint32_t i = 0; i < k.buffers; i++)
        if (k.state[i] == FREE)
            k.state[i] = QUEUED;
    return PF_OK;
}

static void fake_stop(void *self)
{
    (void)self;
    k.is_started = false;
    for (uint32_t i = 0; i < k.buffers; i++)
        if (k.state[i] != HELD)
            k.state[i] = FREE;
}

static void fill(void)
{
    uint32_t number = k.sequence++;
    for (uint32_t i = 0; i < k.buffers; i++) {
        if (k.state[i] != QUEUED)
            continue;
        memset(k.memory[i], (int)(number & 0x7f), BYTES);
        if (k.has_controls && k.was_set) { /* brightness follows exposure and gain */
            double level = (double)k.time / 10000.0 * (double)k.gain / 64.0 * 100.0;
            memset(k.memory[i], level > 255 ? 255 : (int)level, BYTES);
        }
        k.number[i] = number;
        k.stamp[i] = k.next;
        k.state[i] = FILLED;
        return;
    }
}

static pf_status fake_take(void *self, uint32_t timeout_ms, pf_session_frame *frame, pf_failure *failure)
{
    (void)self;
    const uint64_t end = k.now + timeout_ms * MS;
    TEST_ASSERT_TRUE(k.is_started);
    for (;;) {
        uint32_t oldest = BUFFERS;
        if (!k.is_plugged)
            return pf_fail(failure, PF_ERR_CLOSED, "has gone");
        for (; k.now >= k.next; k.next += k.period)
            if (!k.is_silent)
                fill();
        for (uint32_t i = 0; i < k.buffers; i++)
            if (k.state[i] == FILLED && (oldest == BUFFERS || k.number[i] < k.number[oldest]))
                oldest = i;
        if (oldest < BUFFERS) {
            k.state[oldest] = HELD;
            *frame = (pf_session_frame){.buffer = oldest,
                                        .sequence = k.number[oldest],
                                        .pixels = k.memory[oldest],
                                        .n = BYTES,
                                        .stamp_ns = k.stamp[oldest],
                                        .is_stamp_first = k.is_stamp_first,
                                        .is_damaged = k.damaged > 0 && k.damaged--};
            return PF_OK;
        }
        if (k.now >= end)
            return PF_ERR_AGAIN;
        k.now = k.next < end ? k.next : end;
    }
}

static void fake_give(void *self, uint32_t i)
{
    (void)self;
    TEST_ASSERT_EQUAL_INT_MESSAGE(HELD, k.state[i], "given back twice");
    TEST_ASSERT_TRUE_MESSAGE(k.is_open, "given back to a camera that was closed");
    k.state[i] = k.is_started ? QUEUED : FREE;
}

static void fake_set(void *self, bool is_automatic, int64_t time, int64_t gain)
{
    (void)self;
    k.was_set = true;
    k.is_automatic = is_automatic;
    k.time = time;
    k.gain = gain;
}

static void fake_keep(void *self, uint32_t i)
{
    (void)self;
    TEST_ASSERT_EQUAL_INT(HELD, k.state[i]);
    for (uint32_t j = 0; j < KEPT; j++) {
        if (k.kept[j] == NULL) {
            k.kept[j] = k.memory[i];
            return;
        }
    }
    TEST_FAIL_MESSAGE("too many kept");
}

static void fake_drop(void *self, uint8_t *pixels)
{
    (void)self;
    for (uint32_t j = 0; j < KEPT; j++) {
        if (k.kept[j] == pixels) {
            k.kept[j] = NULL;
            return;
        }
    }
    TEST_FAIL_MESSAGE("dropped, but not kept");
}

static void fake_close(void *self)
{
    (void)self;
    TEST_ASSERT_TRUE(k.is_open && !k.is_started);
    for (uint32_t i = 0; i < k.buffers; i++) {
        bool is_kept = k.state[i] != HELD;
        for (uint32_t j = 0; j < KEPT; j++)
            is_kept = is_kept || k.kept[j] == k.memory[i];
        TEST_ASSERT_TRUE_MESSAGE(is_kept, "closed under a frame that is held");
    }
    k.is_open = false;
}

static void fake_end(void *self)
{
    (void)self;
    TEST_ASSERT_FALSE(k.is_open);
    k.is_over = true;
}

static const pf_session_io session = {.now = fake_now,
                                      .sleep = fake_sleep,
                                      .open = fake_open,
                                      .start = fake_start,
                                      .stop = fake_stop,
                                      .take = fake_take,
                                      .give = fake_give,
                                      .set = fake_set,
                                      .keep = fake_keep,
                                      .drop = fake_drop,
                                      .close = fake_close,
                                      .end = fake_end};

static pf_status open_camera(const pf_camera_config *config)
{
    return pf_camera_open(&camera, config, &session, "fake", error, sizeof error);
}

static void open_and_start(const pf_camera_config *config)
{
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, open_camera(config), error);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
}

static const pf_camera_config plain = {
    .device = "", .width = W, .height = H, .frame_rate = 20, .mode = PF_EXPOSURE_DEVICE};

static pf_frame next(void)
{
    pf_frame frame;
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 1000, &frame));
    return frame;
}

static void release(pf_frame *frame)
{
    camera.ops->release(camera.self, frame);
}

static void skip(int n)
{
    while (n-- > 0) {
        pf_frame f = next();
        release(&f);
    }
}

static pf_camera_stats stats(void)
{
    pf_camera_stats s;
    camera.ops->stats(camera.self, &s);
    return s;
}

void setUp(void)
{
    memset(&k, 0, sizeof k);
    k.now = 1000 * MS;
    k.period = 50 * MS;
    k.is_plugged = true;
    k.buffers = BUFFERS;
    k.format = "GREY";
}

void tearDown(void)
{
    if (camera.self != NULL)
        camera.ops->close(camera.self);
    if (camera.self != NULL)
        TEST_ASSERT_TRUE(k.is_over);
    camera.self = NULL;
    for (uint32_t j = 0; j < KEPT; j++)
        TEST_ASSERT_NULL_MESSAGE(k.kept[j], "memory kept for ever");
}

/* Proves: with six buffers a frame is the camera's own memory, untouched while it is held; with fewer it is a copy, and
 * the camera has all buffers to fill. */
static void test_frames_lie_where_the_camera_put_them_if_it_has_buffers_to_spare(void)
{
    open_and_start(&plain);
    pf_frame a = next();
    TEST_ASSERT_EQUAL_PTR(k.memory[0], a.image.data);
    TEST_ASSERT_EQUAL_UINT32(STRIDE, a.image.stride);
    pf_frame b = next(), c = next(), d;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, camera.ops->next(camera.self, 0, &d));
    k.now += 500 * MS; /* the camera goes on filling what it has */
    TEST_ASSERT_EQUAL_UINT8(0, a.image.data[0]);
    TEST_ASSERT_EQUAL_UINT8(1, b.image.data[0]);
    TEST_ASSERT_EQUAL_UINT8(2, c.image.data[STRIDE * (H - 1) + W - 1]);
    release(&a);
    release(&b);
    release(&c);
    camera.ops->close(camera.self);
    setUp();
    k.buffers = 4;
    open_and_start(&plain);
    a = next();
    TEST_ASSERT_EQUAL_UINT32(W, a.image.stride);
    for (uint32_t i = 0; i < k.buffers; i++)
        TEST_ASSERT_EQUAL_INT(QUEUED, k.state[i]);
    release(&a);
}

/* Proves: times are the middle of the exposure, numbers follow the camera's and show gaps; a damaged frame is left out
 * and leaves one. */
static void test_numbers_and_times(void)
{
    k.has_controls = true;
    pf_camera_config fixed = plain;
    fixed.mode = PF_EXPOSURE_FIXED;
    fixed.exposure_us = 8000;
    fixed.gain = 2;
    open_and_start(&fixed);
    pf_frame a = next();
    TEST_ASSERT_EQUAL_UINT64(k.stamp[0] - 4 * MS, a.time_ns);
    TEST_ASSERT_TRUE(a.telemetry.has_exposure && a.telemetry.has_gain);
    TEST_ASSERT_EQUAL_UINT32(8000, a.telemetry.exposure_us);
    TEST_ASSERT_TRUE(a.telemetry.gain == 2);
    TEST_ASSERT_EQUAL_INT64(128, k.gain);
    release(&a);
    k.is_stamp_first = true;
    k.now = k.next + 5 * MS; /* it comes later than it is stamped */
    a = next();
    TEST_ASSERT_EQUAL_UINT64(k.next - k.period + 4 * MS, a.time_ns);
    release(&a);
    k.is_stamp_first = false;
    k.sequence += 3;
    k.damaged = 1;
    a = next();
    TEST_ASSERT_EQUAL_UINT64(6, a.sequence);
    TEST_ASSERT_EQUAL_UINT64(1, stats().damaged);
    release(&a);
}

/* Proves: silence ends with a restart within two seconds, a camera that needs more is opened anew, and frames held
 * meanwhile stay whole; the numbers leave out as many frames as the pause was long. */
static void test_a_stalled_camera_comes_back(void)
{
    open_and_start(&plain);
    skip(3);
    pf_frame held = next(), f;
    k.is_silent = true;
    uint64_t start = k.now;
    do
        TEST_ASSERT_TRUE(k.now - start < 2000 * MS);
    while (camera.ops->next(camera.self, 100, &f) != PF_OK);
    TEST_ASSERT_EQUAL_UINT64(1, stats().restarts);
    TEST_ASSERT_UINT64_WITHIN(1, held.sequence + (k.now - start) / k.period, f.sequence);
    TEST_ASSERT_EQUAL_UINT8(3, held.image.data[0]);
    release(&f);
    k.is_silent = k.stays_silent = true;
    for (int i = 0; i < 40 && k.opens < 2; i++)
        (void)camera.ops->next(camera.self, 100, &f);
    k.stays_silent = k.is_silent = false;
    TEST_ASSERT_EQUAL_UINT32(2, k.opens);
    f = next();
    TEST_ASSERT_EQUAL_UINT8(3, held.image.data[0]);
    release(&f);
    release(&held);
}

/* Proves: a camera that gives frames in time, all of them damaged, is restarted, and opened anew if that does not help;
 * as long as a whole one comes between, it is left alone. */
static void test_a_camera_that_gives_only_damaged_frames_is_restarted(void)
{
    pf_frame f;
    open_and_start(&plain);
    for (int i = 0; i < 20; i++) {
        skip(1);
        k.damaged = 30; /* 1.5 s */
        while (k.damaged > 0)
            TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, camera.ops->next(camera.self, 50, &f));
    }
    skip(1);
    k.now += 5000 * MS; /* nobody asks: that is not the camera's doing */
    k.damaged = 30;
    while (k.damaged > 0)
        TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, camera.ops->next(camera.self, 50, &f));
    TEST_ASSERT_EQUAL_UINT64(0, stats().restarts);
    skip(1);
    k.damaged = INT32_MAX;
    const uint64_t start = k.now;
    while (camera.ops->next(camera.self, 100, &f) != PF_OK)
        TEST_ASSERT_TRUE(k.now - start < 3500 * MS);
    release(&f);
    TEST_ASSERT_EQUAL_UINT64(1, stats().restarts);
    TEST_ASSERT_EQUAL_UINT64(0, stats().reopens);
    k.damaged = INT32_MAX;
    k.stays_damaged = true;
    for (int i = 0; i < 100 && k.opens < 2; i++)
        (void)camera.ops->next(camera.self, 100, &f);
    k.stays_damaged = false;
    k.damaged = 0;
    TEST_ASSERT_EQUAL_UINT32(2, k.opens);
    skip(1);
}

/* Proves: an unplugged camera is waited for and found again; frames that were held outlive it; refusals on the way are
 * tried again. */
static void test_an_unplugged_camera_comes_back(void)
{
    pf_frame f;
    open_and_start(&plain);
    pf_frame a = next(), b = next();
    k.is_plugged = false;
    for (int i = 0; i < 20; i++)
        TEST_ASSERT_NOT_EQUAL(PF_OK, camera.ops->next(camera.self, 100, &f));
    TEST_ASSERT_FALSE(stats().is_there);
    TEST_ASSERT_FALSE(k.is_open);
    TEST_ASSERT_EQUAL_UINT8(1, b.image.data[0]);
    release(&a);
    k.is_plugged = true;
    k.refuse_opens = k.refuse_starts = 1;
    int tries = 0;
    while (camera.ops->next(camera.self, 100, &f) != PF_OK)
        TEST_ASSERT_TRUE(tries++ < 20);
    TEST_ASSERT_TRUE(stats().is_there && stats().reopens >= 1);
    TEST_ASSERT_TRUE(f.sequence > b.sequence + 40);
    release(&f);
    release(&b);
}

/* Proves: with a size the driver opens without the camera and waits; without one, or with another size, it says so. */
static void test_opening_without_a_camera(void)
{
    pf_camera_config any = {.device = ""};
    k.is_plugged = false;
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, open_camera(&any));
    TEST_ASSERT_EQUAL_STRING("no camera", error);
    TEST_ASSERT_TRUE(k.is_over);
    any.format = "XYZ1";
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_camera(&any));
    TEST_ASSERT_NOT_NULL(strstr(error, "XYZ1"));
    k.is_over = false;
    open_and_start(&plain);
    pf_frame f;
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 100, &f));
    k.is_plugged = true;
    skip(1);
}

/* Proves: colours become grey, in the copies. */
static void test_colours_become_grey(void)
{
    pf_camera_config rgb = plain;
    rgb.format = "RGB3";
    open_and_start(&rgb);
    skip(7);
    pf_frame f = next();
    TEST_ASSERT_EQUAL_UINT32(W, f.image.stride);
    TEST_ASSERT_EQUAL_UINT8(7, f.image.data[W * H - 1]); /* grey stays grey */
    release(&f);
}

/* Proves: automatic exposure is ours and settles on its target, held within the longest exposure; the camera's own is
 * left on when that is asked for. */
static void test_exposure_settles(void)
{
    pf_camera_config ours = plain;
    k.has_controls = true;
    ours.mode = PF_EXPOSURE_AUTO;
    ours.exposure_max_us = 15000;
    open_and_start(&ours);
    skip(40);
    TEST_ASSERT_FALSE(k.is_automatic);
    TEST_ASSERT_EQUAL_INT64(15000, k.time);
    double level = (double)k.time / 10000.0 * (double)k.gain / 64.0 * 100.0;
    TEST_ASSERT_TRUE(level > PF_EXPOSURE_TARGET - PF_EXPOSURE_BAND - 1 &&
                     level < PF_EXPOSURE_TARGET + PF_EXPOSURE_BAND + 1);
    camera.ops->close(camera.self);
    setUp();
    k.has_controls = true;
    open_and_start(&plain);
    skip(2);
    TEST_ASSERT_TRUE(k.was_set && k.is_automatic);
    camera.ops->close(camera.self);
    camera.self = NULL;
    setUp();
    ours.mode = PF_EXPOSURE_FIXED;
    ours.exposure_us = 100;
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, open_camera(&ours)); /* no controls this time */
    TEST_ASSERT_NOT_NULL(strstr(error, "exposure"));
}

/* Proves: what is fixed without a value is neither set nor told, so that it stays as another program sets it, and the
 * longest exposure of the automatics binds neither it nor a fixed one. */
static void test_fixed_without_a_value_is_left_alone(void)
{
    static const struct {
        uint32_t exposure_us;
        double gain;
        int64_t time_set, gain_set;
    } cases[] = {{8000, 0, 8000, PF_SESSION_AS_IS}, {0, 2, PF_SESSION_AS_IS, 128}, {8000, 2, 8000, 128}};
    pf_camera_config fixed = plain;
    fixed.mode = PF_EXPOSURE_FIXED;
    fixed.exposure_max_us = 500; /* less than the camera's 1000 */
    k.has_controls = true;
    open_and_start(&fixed);
    pf_frame f = next();
    TEST_ASSERT_FALSE(k.was_set || f.telemetry.has_exposure || f.telemetry.has_gain);
    release(&f);
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        camera.ops->close(camera.self);
        setUp();
        k.has_controls = true;
        fixed.exposure_us = cases[i].exposure_us;
        fixed.gain = cases[i].gain;
        open_and_start(&fixed);
        f = next();
        TEST_ASSERT_TRUE(k.was_set && !k.is_automatic);
        TEST_ASSERT_EQUAL_INT64(cases[i].time_set, k.time);
        TEST_ASSERT_EQUAL_INT64(cases[i].gain_set, k.gain);
        TEST_ASSERT_EQUAL_INT(cases[i].exposure_us > 0, f.telemetry.has_exposure);
        TEST_ASSERT_EQUAL_INT(cases[i].gain > 0, f.telemetry.has_gain);
        release(&f);
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_frames_lie_where_the_camera_put_them_if_it_has_buffers_to_spare);
    RUN_TEST(test_numbers_and_times);
    RUN_TEST(test_a_stalled_camera_comes_back);
    RUN_TEST(test_a_camera_that_gives_only_damaged_frames_is_restarted);
    RUN_TEST(test_an_unplugged_camera_comes_back);
    RUN_TEST(test_opening_without_a_camera);
    RUN_TEST(test_colours_become_grey);
    RUN_TEST(test_exposure_settles);
    RUN_TEST(test_fixed_without_a_value_is_left_alone);
    return UNITY_END();
}
