/* The V4L2 driver against a made-up kernel (v4l2_kernel.h), which fails on demand. Proves: frames are used where the
 * kernel put them and stay whole while they are held; a stalled, damaged or unplugged camera comes back by itself; any
 * single system call may fail without frames, buffers or memory getting lost. Does not prove: that a real kernel
 * behaves so (tests/hil). */
#include "unity.h"
#include "v4l2_kernel.h"

#include <errno.h>
#include <string.h>

static pf_camera_source camera;
static char error[512];

void setUp(void)
{
    v4l2_kernel_reset();
    camera.self = NULL;
}

static void close_camera(void)
{
    if (camera.self == NULL)
        return;
    (void)camera.ops->stop(camera.self);
    camera.ops->close(camera.self);
    camera.self = NULL;
    TEST_ASSERT_FALSE_MESSAGE(k.is_open, "left open");
    for (uint32_t i = 0; i < MAPS; i++)
        TEST_ASSERT_FALSE_MESSAGE(k.is_mapped[i], "left mapped");
}

void tearDown(void)
{
    close_camera();
}

static pf_status open_with(uint32_t width, uint32_t height, const char *format, double rate)
{
    pf_camera_config config = {
        .device = "/dev/video0", .width = width, .height = height, .format = format, .frame_rate = rate};
    return pf_v4l2_open_with(&camera, &config, &v4l2_kernel_io, error, sizeof error);
}

static void start(void)
{
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, open_with(W, H, "", 0), error);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
}

/* The next frame within `most_ms`, whatever happens on the way. */
static pf_frame next_within(uint32_t most_ms)
{
    pf_frame frame;
    const uint64_t end = k.now + most_ms * MS;
    pf_status status;
    do
        status = camera.ops->next(camera.self, 100, &frame);
    while (status != PF_OK && k.now < end && (status == PF_ERR_AGAIN || status == PF_ERR_CLOSED));
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, status, camera.ops->error(camera.self));
    return frame;
}

static void check_whole(const pf_frame *frame, uint8_t value)
{
    for (uint32_t y = 0; y < H; y++)
        for (uint32_t x = 0; x < W; x++)
            TEST_ASSERT_EQUAL_UINT8(value, frame->image.data[y * frame->image.stride + x]);
}

static void release(pf_frame *frame)
{
    camera.ops->release(camera.self, frame);
}

static void test_grey_frames_are_used_where_they_lie_and_stay_whole_while_held(void)
{
    pf_frame held[3], another;
    start();
    for (int i = 0; i < 3; i++)
        held[i] = next_within(300);
    TEST_ASSERT_TRUE(held[0].image.data >= k.memory[0] && held[0].image.data < k.memory[MAPS - 1]);
    TEST_ASSERT_EQUAL_UINT32(STRIDE, held[0].image.stride);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, camera.ops->next(camera.self, 100, &another));
    k.now += 2000 * MS; /* the camera goes on into the buffers that are left */
    for (int i = 0; i < 3; i++)
        check_whole(&held[i], (uint8_t)i);
    for (int i = 0; i < 3; i++)
        release(&held[i]);
    for (int i = 0; i < 20; i++) {
        another = next_within(300);
        check_whole(&another, (uint8_t)another.sequence);
        release(&another);
    }
    TEST_ASSERT_TRUE(another.sequence > 20); /* what found no room is a gap */
}

/* Proves: what a multi-planar camera puts before its picture is not taken for pixels, whether the picture is used where
 * it lies, outlives the camera there, or is made grey in memory of ours; and a header as long as the buffer is damage.
 */
static void test_a_header_before_the_picture_is_skipped(void)
{
    for (uint32_t format = 0; format < 2; format++) {
        setUp();
        k.is_mplane = true;
        k.header = 96;
        k.formats[0].fourcc = format == 0 ? V4L2_PIX_FMT_GREY : V4L2_PIX_FMT_NV12;
        k.n_formats = 1;
        start();
        pf_frame frame = next_within(300), held = next_within(300);
        check_whole(&frame, (uint8_t)frame.sequence);
        check_whole(&held, (uint8_t)held.sequence);
        release(&frame);
        k.is_plugged = false;
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 100, &frame));
        check_whole(&held, (uint8_t)held.sequence);
        release(&held);
        k.is_plugged = true;
        frame = next_within(5000);
        release(&frame);
        k.header = BYTES;
        TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, camera.ops->next(camera.self, 100, &frame));
        close_camera();
    }
}

static void test_the_best_format_that_is_fast_enough_is_chosen(void)
{
    TEST_ASSERT_EQUAL_INT(PF_OK, open_with(0, 0, "", 0));
    TEST_ASSERT_EQUAL_UINT32(V4L2_PIX_FMT_GREY, k.fourcc);
    TEST_ASSERT_EQUAL_UINT32(W, camera.ops->info(camera.self)->width);
    close_camera();
    TEST_ASSERT_EQUAL_INT(PF_OK, open_with(W, H, "YUYV", 0));
    TEST_ASSERT_EQUAL_UINT32(V4L2_PIX_FMT_YUYV, k.fourcc);
    close_camera();
    k.formats[1].rate = 10;
    k.formats[2] = (fake_format){V4L2_PIX_FMT_MJPEG, 30};
    k.n_formats = 3;
    k.formats[0].rate = 5;
    TEST_ASSERT_EQUAL_INT(PF_OK, open_with(W, H, "", 30));
    TEST_ASSERT_EQUAL_UINT32(V4L2_PIX_FMT_MJPEG, k.fourcc);
    close_camera();
    TEST_ASSERT_EQUAL_INT(PF_OK, open_with(W, H, "", 60)); /* none is: the best */
    TEST_ASSERT_EQUAL_UINT32(V4L2_PIX_FMT_GREY, k.fourcc);
}

static void test_what_the_camera_cannot_do_is_said_with_what_it_can(void)
{
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, open_with(W + 2, H, "", 0));
    TEST_ASSERT_NOT_NULL(strstr(error, "66 x 48"));
    TEST_ASSERT_NOT_NULL(strstr(error, "YUYV GREY"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, open_with(W, H, "NV12", 0));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_with(W, H, "RGB4", 0));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, open_with(W, 0, "", 0));
    k.is_plugged = false;
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, open_with(0, 0, "", 0)); /* nobody knows what to wait for */
}

/* As v4l2loopback 0.12 has it: ten bits of memory for a pixel of Y10. Each frame would be too short. */
static void test_a_camera_without_room_for_its_own_format_is_told_of(void)
{
    k.formats[0].fourcc = V4L2_PIX_FMT_Y10;
    k.n_formats = 1;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, open_with(W, H, "", 0), error);
    close_camera();
    k.image_size = W * H * 10 / 8;
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, open_with(W, H, "", 0));
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, "its 3840 bytes, 80 a row, hold no Y10 of 64 x 48"), error);
    k.formats[1].fourcc = V4L2_PIX_FMT_MJPEG; /* which has room, and comes after Y10 in our order */
    k.n_formats = 2;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, open_with(W, H, "", 0), error);
    TEST_ASSERT_EQUAL_HEX32(V4L2_PIX_FMT_MJPEG, k.fourcc);
}

static void test_a_camera_that_is_not_there_yet_is_waited_for(void)
{
    pf_frame frame;
    k.is_plugged = false;
    start();
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 500, &frame));
    k.is_plugged = true;
    k.n_formats = 0; /* there, but without a picture: a receiver without a signal */
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 500, &frame));
    k.n_formats = 2;
    frame = next_within(1000);
    release(&frame);
}

static void test_a_camera_that_another_program_uses_is_waited_for(void)
{
    pf_frame frame;
    for (int i = 0; i < 3; i++) {
        close_camera();
        k.is_busy = true;
        k.is_busy_early = i == 1;
        k.is_busy_file = i == 2;
        start();
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 500, &frame));
        TEST_ASSERT_NOT_NULL(strstr(camera.ops->error(camera.self), "busy"));
        TEST_ASSERT_FALSE(k.is_open);
        k.is_busy = false;
        frame = next_within(1000);
        release(&frame);
    }
}

static void test_a_stall_is_over_within_two_seconds_by_stop_and_start(void)
{
    pf_camera_stats stats;
    start();
    pf_frame frame = next_within(300);
    release(&frame);
    const uint64_t last = k.now, number = frame.sequence;
    k.is_silent = k.restart_helps = true;
    frame = next_within(2000);
    TEST_ASSERT_TRUE(k.now - last < 2000 * MS);
    TEST_ASSERT_EQUAL_UINT32(1, k.restarts);
    TEST_ASSERT_UINT64_WITHIN(1, number + (k.now - last) / k.period, frame.sequence);
    release(&frame);
    camera.ops->stats(camera.self, &stats);
    TEST_ASSERT_TRUE(stats.is_there && stats.restarts == 1 && stats.reopens == 0);
}

static void test_a_failed_queue_is_restarted_at_once(void)
{
    start();
    pf_frame frame = next_within(300);
    release(&frame);
    const uint64_t before = k.now;
    k.has_error = true;
    frame = next_within(500);
    TEST_ASSERT_TRUE(k.now - before < 300 * MS);
    release(&frame);
}

static void test_held_frames_outlive_an_unplugged_camera(void)
{
    pf_frame held[2], frame;
    start();
    held[0] = next_within(300);
    held[1] = next_within(300);
    for (int round = 0; round < 6; round++) {
        k.is_plugged = false;
        TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 600, &frame));
        TEST_ASSERT_FALSE(k.is_open);
        check_whole(&held[0], 0);
        check_whole(&held[1], 1);
        k.is_plugged = true;
        frame = next_within(1000);
        TEST_ASSERT_TRUE(frame.sequence > held[1].sequence + 6u * (unsigned)round);
        TEST_ASSERT_TRUE(frame.time_ns > held[1].time_ns);
        release(&frame);
    }
    release(&held[0]);
    release(&held[1]);
}

static void test_another_camera_under_the_same_name_is_not_taken(void)
{
    pf_frame frame;
    start();
    frame = next_within(300);
    release(&frame);
    k.is_plugged = false;
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 600, &frame));
    k.is_plugged = true;
    k.width = W * 2;
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, camera.ops->next(camera.self, 2000, &frame));
    TEST_ASSERT_NOT_NULL(strstr(camera.ops->error(camera.self), "cannot make frames of 64 x 48"));
    k.width = W;
    frame = next_within(1000);
    release(&frame);
}

/* Proves: a camera whose automatics one run has switched off has them again in the next that leaves them to it, and
 * keeps them in one that sets nothing. */
static void test_exposure_is_given_back_to_the_camera(void)
{
    static const pf_exposure_mode modes[] = {PF_EXPOSURE_AUTO, PF_EXPOSURE_DEVICE, PF_EXPOSURE_HOLD, PF_EXPOSURE_DEVICE,
                                             PF_EXPOSURE_FIXED};
    for (size_t i = 0; i < 5; i++) {
        const pf_camera_config config = {.device = "/dev/video0", .mode = modes[i]};
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_v4l2_open_with(&camera, &config, &v4l2_kernel_io, error, sizeof error),
                                      error);
        close_camera();
        /* The last, fixed with zeros, changes nothing. */
        TEST_ASSERT_EQUAL_INT32(i % 2 || i == 4 ? V4L2_EXPOSURE_APERTURE_PRIORITY : V4L2_EXPOSURE_MANUAL,
                                k.exposure_auto);
    }
}

static void test_damaged_frames_are_left_out_with_a_gap(void)
{
    pf_camera_stats stats;
    start();
    pf_frame frame = next_within(300);
    const uint64_t number = frame.sequence;
    release(&frame);
    k.damaged_next = 2;
    frame = next_within(1000);
    TEST_ASSERT_EQUAL_UINT64(number + 3, frame.sequence);
    release(&frame);
    camera.ops->stats(camera.self, &stats);
    TEST_ASSERT_EQUAL_UINT64(2, stats.damaged);
    TEST_ASSERT_EQUAL_UINT64(0, stats.restarts);
}

/* Every system call from opening on fails once, with each of the errors that drivers give. */
static void test_any_single_call_may_fail_and_frames_still_come(void)
{
    static const int errors[] = {EIO, EINVAL, EBUSY, ENOMEM, ENODEV, EPIPE};
    for (size_t e = 0; e < sizeof errors / sizeof errors[0]; e++) {
        for (int at = 1; at < 110; at++) {
            pf_frame held = {0}, frame;
            setUp();
            k.is_plugged = false;
            start();
            k.is_plugged = true;
            k.calls = 0;
            k.fail_at = at;
            k.fail_with = errors[e];
            for (int i = 0; i < 6; i++) {
                frame = next_within(4000);
                check_whole(&frame, frame.image.data[0]);
                if (held.handle != NULL)
                    release(&held);
                held = frame;
            }
            TEST_ASSERT_TRUE(k.n_maps <= 18);
            release(&held);
            k.fail_at = 0;
            for (int i = 0; i < 3; i++) { /* all buffers are with the camera again */
                frame = next_within(1000);
                release(&frame);
            }
            uint32_t queued = 0;
            for (uint32_t i = 0; i < k.n_buffers; i++)
                queued += k.is_queued[i];
            TEST_ASSERT_EQUAL_UINT32(6, queued);
            close_camera();
        }
    }
}

static uint64_t alive_ns, longest_ns;

static void note_alive(void)
{
    if (k.now - alive_ns > longest_ns)
        longest_ns = k.now - alive_ns;
    alive_ns = k.now;
}

/* Proves: a camera that lets each call wait for as long as the kernel does and then fail keeps its thread from waiting
 * for others, but not from saying between any two that it is alive: whoever watches it would reset the board. */
static void test_a_camera_that_does_not_answer_is_no_thread_that_hangs(void)
{
    pf_camera_config config = {.device = "/dev/video0", .width = W, .height = H, .alive = note_alive};
    pf_frame frame;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_v4l2_open_with(&camera, &config, &v4l2_kernel_io, error, sizeof error));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
    frame = next_within(300);
    release(&frame);
    k.call_ns = 5000 * MS;
    alive_ns = k.now;
    longest_ns = 0;
    const uint64_t end = k.now + 60000 * MS;
    while (k.now < end)
        (void)camera.ops->next(camera.self, 100, &frame);
    note_alive();
    TEST_ASSERT_TRUE(longest_ns >= 5000 * MS && longest_ns < 6000 * MS);
    k.call_ns = 0;
    frame = next_within(20000);
    release(&frame);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_grey_frames_are_used_where_they_lie_and_stay_whole_while_held);
    RUN_TEST(test_a_header_before_the_picture_is_skipped);
    RUN_TEST(test_the_best_format_that_is_fast_enough_is_chosen);
    RUN_TEST(test_what_the_camera_cannot_do_is_said_with_what_it_can);
    RUN_TEST(test_a_camera_without_room_for_its_own_format_is_told_of);
    RUN_TEST(test_a_camera_that_is_not_there_yet_is_waited_for);
    RUN_TEST(test_a_camera_that_another_program_uses_is_waited_for);
    RUN_TEST(test_a_stall_is_over_within_two_seconds_by_stop_and_start);
    RUN_TEST(test_a_failed_queue_is_restarted_at_once);
    RUN_TEST(test_held_frames_outlive_an_unplugged_camera);
    RUN_TEST(test_another_camera_under_the_same_name_is_not_taken);
    RUN_TEST(test_exposure_is_given_back_to_the_camera);
    RUN_TEST(test_damaged_frames_are_left_out_with_a_gap);
    RUN_TEST(test_any_single_call_may_fail_and_frames_still_come);
    RUN_TEST(test_a_camera_that_does_not_answer_is_no_thread_that_hangs);
    return UNITY_END();
}
