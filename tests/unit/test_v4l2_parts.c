/* The V4L2 driver's parts that need no device. Proves: grey values of each format; numbers and times that only rise,
 * whatever the kernel says; when a silent stream is restarted, within what time; that the exposure settles on a lit
 * wall and stays. Does not prove: that a real camera follows its controls. */
#include "camera_common/convert.h"
#include "camera_common/exposure.h"
#include "camera_common/timing.h"
#include "unity.h"

#include <linux/videodev2.h>
#include <math.h>
#include <string.h>
#include <turbojpeg.h>

#define MS UINT64_C(1000000)

void setUp(void) {}
void tearDown(void) {}

/* ---- formats */

/* Proves: a JPEG that is cut short, or has other bytes in its midst, is no frame; one with something after its end is.
 */
static void test_a_damaged_jpeg_is_no_frame(void)
{
    enum { W = 320, H = 240 };
    static uint8_t grey[W * H], back[W * H], bytes[4 * W * H];
    unsigned char *jpeg = NULL;
    unsigned long n = 0;
    uint32_t random = 1;
    pf_failure failure;
    tjhandle to = tjInitCompress(), from = tjInitDecompress();
    for (size_t i = 0; i < sizeof grey; i++) {
        random = random * 1664525u + 1013904223u;
        grey[i] = (uint8_t)((i % W) / 2 + (random >> 27));
    }
    TEST_ASSERT_EQUAL_INT(0, tjCompress2(to, grey, W, W, H, TJPF_GRAY, &jpeg, &n, TJSAMP_GRAY, 90, 0));
    memcpy(bytes, jpeg, n);
    memset(bytes + n, 0x5A, 500);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_to_grey(from, bytes, n, W, H, back, &failure));
    TEST_ASSERT_UINT8_WITHIN(12, grey[W * H - 1], back[W * H - 1]);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_to_grey(from, bytes, n + 500, W, H, back, &failure));
    TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, pf_jpeg_to_grey(from, bytes, n, W, H - 1, back, &failure));
    for (unsigned long cut = 0; cut < n; cut += 1 + n / 40)
        TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, pf_jpeg_to_grey(from, bytes, cut, W, H, back, &failure));
    for (size_t at = n / 4; at < 3 * n / 4; at += n / 8) {
        memcpy(bytes, jpeg, n);
        for (size_t i = 0; i < 1000; i++) {
            random = random * 1664525u + 1013904223u;
            bytes[at + i] = (uint8_t)(random >> 24);
        }
        TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, pf_jpeg_to_grey(from, bytes, n, W, H, back, &failure));
    }
    tjFree(jpeg);
    (void)tjDestroy(to);
    (void)tjDestroy(from);
}

static void test_every_raw_format_gives_its_grey(void)
{
    enum { W = 10, H = 3, PAD = 7 };
    uint32_t n;
    const pf_pixel_format *formats = pf_pixel_formats(&n);
    for (uint32_t k = 0; k < n; k++) {
        const pf_pixel_format *f = &formats[k];
        uint8_t bytes[H * (4 * W + PAD)], grey[W * H];
        const uint32_t stride = pf_pixel_format_row(f, W) + PAD;
        if (f->layout == PF_LAYOUT_JPEG)
            continue;
        memset(bytes, 0xEE, sizeof bytes);
        for (uint32_t y = 0; y < H; y++) {
            for (uint32_t x = 0; x < W; x++) {
                const uint32_t v = 25 * x + y, wide = v << (f->bits - 8) | ((1u << (f->bits - 8)) - 1);
                uint8_t *row = bytes + y * stride;
                switch (f->layout) {
                case PF_LAYOUT_LUMA:
                    row[x] = (uint8_t)v;
                    break;
                case PF_LAYOUT_LUMA_EVEN:
                    row[2 * x] = (uint8_t)v;
                    break;
                case PF_LAYOUT_LUMA_ODD:
                    row[2 * x + 1] = (uint8_t)v;
                    break;
                case PF_LAYOUT_WORDS:
                    row[2 * x] = (uint8_t)wide;
                    row[2 * x + 1] = (uint8_t)(wide >> 8);
                    break;
                case PF_LAYOUT_PACKED_10:
                    row[x / 4 * 5 + x % 4] = (uint8_t)v;
                    break;
                case PF_LAYOUT_PACKED_12:
                    row[x / 2 * 3 + x % 2] = (uint8_t)v;
                    break;
                case PF_LAYOUT_RGB:
                case PF_LAYOUT_BGR:
                    memset(row + 3 * x, (int)v, 3);
                    break;
                case PF_LAYOUT_JPEG:
                    break;
                }
            }
        }
        pf_pixels_to_grey(f, bytes, W, H, stride, grey);
        for (uint32_t y = 0; y < H; y++)
            for (uint32_t x = 0; x < W; x++)
                TEST_ASSERT_EQUAL_UINT8_MESSAGE(25 * x + y, grey[y * W + x], f->name);
        TEST_ASSERT_EQUAL_PTR(f, pf_pixel_format_named(f->name));
        TEST_ASSERT_EQUAL_PTR(f, pf_pixel_format_find(f->fourcc));
    }
    TEST_ASSERT_NULL(pf_pixel_format_find(V4L2_PIX_FMT_RGB32));
    TEST_ASSERT_NULL(pf_pixel_format_named("grey"));
}

static void test_colours_are_weighed_whichever_way_round(void)
{
    const uint8_t rgb[3] = {255, 0, 0}, bgr[3] = {0, 0, 255};
    uint8_t grey;
    pf_pixels_to_grey(pf_pixel_format_named("RGB3"), rgb, 1, 1, 3, &grey);
    TEST_ASSERT_EQUAL_UINT8(77, grey); /* 0.299 of 255 */
    pf_pixels_to_grey(pf_pixel_format_named("BGR3"), bgr, 1, 1, 3, &grey);
    TEST_ASSERT_EQUAL_UINT8(77, grey);
}

static void test_values_beyond_the_format_are_white_not_black(void)
{
    const uint8_t word[2] = {0x00, 0x05}; /* 1280 of 10 bits */
    uint8_t grey;
    pf_pixels_to_grey(pf_pixel_format_named("Y10"), word, 1, 1, 2, &grey);
    TEST_ASSERT_EQUAL_UINT8(255, grey);
}

static void test_a_frame_that_is_too_short_does_not_fit(void)
{
    const pf_pixel_format *f = pf_pixel_format_named("Y10P");
    TEST_ASSERT_EQUAL_UINT32(15, pf_pixel_format_row(f, 10));
    TEST_ASSERT_TRUE(pf_pixel_format_fits(f, 10, 3, 20, 55)); /* the last row needs no padding */
    TEST_ASSERT_FALSE(pf_pixel_format_fits(f, 10, 3, 20, 54));
    TEST_ASSERT_FALSE(pf_pixel_format_fits(f, 10, 3, 14, 1000));
    TEST_ASSERT_FALSE(pf_pixel_format_fits(pf_pixel_format_named("MJPG"), 10, 3, 0, 0));
}

/* ---- numbers and times */

static uint64_t last_number, last_time;

static void take(pf_numbering *n, uint32_t sequence, uint64_t stamp, uint64_t now)
{
    pf_numbering_take(n, sequence, stamp, now, &last_number, &last_time);
}

static void test_gaps_are_the_kernels_and_wrap_with_them(void)
{
    pf_numbering n;
    pf_numbering_init(&n, 100 * MS);
    take(&n, UINT32_MAX - 1, 1000 * MS, 1001 * MS);
    TEST_ASSERT_EQUAL_UINT64(0, last_number);
    TEST_ASSERT_EQUAL_UINT64(1000 * MS, last_time);
    take(&n, UINT32_MAX, 1100 * MS, 1101 * MS);
    take(&n, 2, 1400 * MS, 1401 * MS);
    TEST_ASSERT_EQUAL_UINT64(4, last_number);
    TEST_ASSERT_EQUAL_UINT64(2, n.gaps);
    TEST_ASSERT_EQUAL_UINT64(0, n.bad_counts + n.bad_times);
}

static void test_a_restart_leaves_a_gap_as_long_as_it_took(void)
{
    pf_numbering n;
    pf_numbering_init(&n, 100 * MS);
    take(&n, 50, 1000 * MS, 1001 * MS);
    pf_numbering_restart(&n);
    take(&n, 0, 2540 * MS, 2541 * MS);
    TEST_ASSERT_EQUAL_UINT64(15, last_number);
    take(&n, 1, 2640 * MS, 2641 * MS);
    TEST_ASSERT_EQUAL_UINT64(16, last_number);
}

static void test_numbers_and_times_rise_whatever_the_kernel_says(void)
{
    pf_numbering n;
    pf_numbering_init(&n, 100 * MS);
    uint64_t number = 0, time = 0;
    static const uint64_t stamps[] = {5000, 0, 5000, 4000, 999999999, 1, 5600, 5600};
    for (uint32_t i = 0; i < 8; i++) {
        take(&n, i < 4 ? 10 : 10 - i, stamps[i] * MS, (5000 + 100 * (uint64_t)i) * MS);
        TEST_ASSERT_TRUE(i == 0 || (last_number == number + 1 && last_time > time));
        number = last_number;
        time = last_time;
        TEST_ASSERT_TRUE(time <= (5000 + 100 * (uint64_t)i) * MS + 1);
    }
    TEST_ASSERT_EQUAL_UINT64(6, n.bad_times); /* 5000 and the first 5600 were good */
    TEST_ASSERT_EQUAL_UINT64(7, n.bad_counts);
}

/* ---- recovery */

/* The moment of the first action other than WAIT, in steps of 10 ms. */
static pf_recovery_action next_action(pf_recovery *r, uint64_t *now)
{
    for (;; *now += 10 * MS) {
        pf_recovery_action action = pf_recovery_next(r, *now);
        if (action != PF_RECOVERY_WAIT)
            return action;
    }
}

static void test_a_stream_that_falls_silent_is_restarted_within_a_second_then_reopened(void)
{
    pf_recovery r;
    uint64_t now = 0;
    pf_recovery_init(&r, 33 * MS, now);
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_OPEN, next_action(&r, &now));
    pf_recovery_opened(&r, now);
    for (int i = 0; i < 100; i++, now += 33 * MS) {
        TEST_ASSERT_EQUAL_INT(PF_RECOVERY_WAIT, pf_recovery_next(&r, now));
        pf_recovery_frame(&r, now);
    }
    const uint64_t silent = now;
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_RESTART, next_action(&r, &now));
    TEST_ASSERT_TRUE(now - silent < 1000 * MS);
    pf_recovery_restarted(&r, now);
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_REOPEN, next_action(&r, &now));
    TEST_ASSERT_TRUE(now - silent < 3000 * MS);
    pf_recovery_closed(&r, now);
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_OPEN, next_action(&r, &now));
    pf_recovery_opened(&r, now);
    pf_recovery_frame(&r, now);
    now += 300 * MS;
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_WAIT, pf_recovery_next(&r, now));
    TEST_ASSERT_EQUAL_UINT64(1, r.restarts);
    TEST_ASSERT_EQUAL_UINT64(1, r.reopens);
}

static void test_a_slow_camera_is_not_taken_for_a_stalled_one(void)
{
    pf_recovery r;
    uint64_t now = 0;
    pf_recovery_init(&r, 1000 * MS, now); /* a frame a second, one of them late */
    pf_recovery_opened(&r, now);
    pf_recovery_frame(&r, now);
    now += 2900 * MS;
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_WAIT, pf_recovery_next(&r, now));
    /* One that needs five seconds for its first frame gets them at the third try. */
    pf_recovery_init(&r, 33 * MS, now);
    bool has_started = false;
    for (int try = 0; try < 3 && !has_started; try++) {
        TEST_ASSERT_EQUAL_INT(PF_RECOVERY_OPEN, next_action(&r, &now));
        pf_recovery_opened(&r, now);
        const uint64_t opened = now;
        (void)next_action(&r, &now);
        has_started = now - opened >= 5000 * MS;
        pf_recovery_closed(&r, now);
    }
    TEST_ASSERT_TRUE(has_started);
}

static void test_an_unplugged_camera_is_closed_at_once_and_tried_at_intervals(void)
{
    pf_recovery r;
    uint64_t now = 0;
    pf_recovery_init(&r, 33 * MS, now);
    pf_recovery_opened(&r, now);
    pf_recovery_frame(&r, now);
    pf_recovery_unplug(&r);
    TEST_ASSERT_EQUAL_INT(PF_RECOVERY_REOPEN, pf_recovery_next(&r, now));
    for (int i = 0; i < 5; i++) {
        const uint64_t before = now;
        pf_recovery_closed(&r, now);
        TEST_ASSERT_EQUAL_INT(PF_RECOVERY_OPEN, next_action(&r, &now));
        TEST_ASSERT_TRUE(now - before >= PF_RECOVERY_RETRY_NS && now - before < 2 * PF_RECOVERY_RETRY_NS);
    }
    TEST_ASSERT_EQUAL_UINT64(1, r.unplugs);
    TEST_ASSERT_EQUAL_UINT64(1, r.reopens);
}

/* ---- exposure */

enum { WIDE = 320, HIGH = 240 };

/* A pipe lit from the camera: bright beside the lens (the rim), black in the depth, `light` at exposure x gain = 1. */
static void light_pipe(uint8_t *pixels, double light, const pf_exposure *e, double gamma)
{
    for (uint32_t y = 0; y < HIGH; y++) {
        for (uint32_t x = 0; x < WIDE; x++) {
            double r = hypot(x - 160.0, y - 120.0) / 118;
            double v = r > 1 ? 0.02 : light * r * r * (double)e->time_now * (double)e->gain_now;
            v = 255 * pow(v < 1 ? v : 1, gamma);
            pixels[y * WIDE + x] = (uint8_t)v;
        }
    }
}

/* Frames until nothing has changed for 30 of them; -1: it never settles. The camera follows two frames late. */
static int settle(pf_exposure *e, uint8_t *pixels, double light, double gamma, int *changes)
{
    const pf_image image = {pixels, WIDE, HIGH, WIDE};
    pf_exposure delayed[3] = {*e, *e, *e};
    int quiet = 0;
    *changes = 0;
    for (int i = 0; i < 400; i++) {
        light_pipe(pixels, light, &delayed[i % 3], gamma);
        delayed[i % 3] = *e;
        if (pf_exposure_judge(e, &image)) {
            quiet = 0;
            ++*changes;
        } else if (++quiet == 30) {
            return i - 29;
        }
    }
    return -1;
}

static pf_exposure make_exposure(int64_t time_max, int64_t gain_max, int64_t step)
{
    pf_exposure e = {
        .time = {1, time_max, step}, .gain = {1, gain_max, 1}, .circle_u = 160, .circle_v = 120, .circle_radius = 118};
    pf_exposure_init(&e, 1, 1);
    return e;
}

/* From dark and from white, linear and with a monitor's curve: it settles on the wall's bright part, without swinging.
 */
static void test_exposure_settles_on_the_lit_wall(void)
{
    static uint8_t pixels[WIDE * HIGH];
    static const double lights[] = {0.1, 0.01, 0.003, 0.001};
    for (uint32_t k = 0; k < 4; k++) {
        for (int is_bright = 0; is_bright < 2; is_bright++) {
            pf_exposure e = make_exposure(10000, 16, 1);
            int changes;
            if (is_bright)
                pf_exposure_init(&e, 10000, 16);
            int frames = settle(&e, pixels, lights[k], k % 2 ? 1.0 : 0.45, &changes);
            TEST_ASSERT_TRUE(frames >= 0 && frames < 150);
            TEST_ASSERT_TRUE(changes < 30);
            TEST_ASSERT_UINT_WITHIN(PF_EXPOSURE_BAND, PF_EXPOSURE_TARGET, e.percentile);
            TEST_ASSERT_TRUE(e.is_settled && !e.at_limit);
            TEST_ASSERT_TRUE(e.saturated_ppm < 20000);
        }
    }
}

static void test_gain_is_used_only_where_exposure_does_not_reach(void)
{
    static uint8_t pixels[WIDE * HIGH];
    int changes;
    pf_exposure e = make_exposure(100, 16, 1);
    TEST_ASSERT_TRUE(settle(&e, pixels, 0.01, 1, &changes) >= 0);
    TEST_ASSERT_EQUAL_INT64(1, e.gain_now);
    TEST_ASSERT_TRUE(settle(&e, pixels, 0.002, 1, &changes) >= 0);
    TEST_ASSERT_EQUAL_INT64(100, e.time_now);
    TEST_ASSERT_TRUE(e.gain_now > 1);
    TEST_ASSERT_TRUE(settle(&e, pixels, 1e-6, 1, &changes) >= 0); /* no light at all: to the limit, and rest there */
    TEST_ASSERT_TRUE(e.at_limit && e.time_now == 100 && e.gain_now == 16);
    TEST_ASSERT_TRUE(settle(&e, pixels, 0.01, 1, &changes) >= 0);
    TEST_ASSERT_EQUAL_INT64(1, e.gain_now);
}

static void test_steps_coarser_than_the_band_do_not_swing_for_ever(void)
{
    static uint8_t pixels[WIDE * HIGH];
    int changes;
    pf_exposure e = make_exposure(400, 1, 100); /* 1, 101, 201...: no step hits the target */
    TEST_ASSERT_TRUE(settle(&e, pixels, 0.0045, 1, &changes) >= 0);
    TEST_ASSERT_TRUE(changes < 20);
}

static void test_a_held_exposure_stays_when_the_light_changes(void)
{
    static uint8_t pixels[WIDE * HIGH];
    int changes;
    pf_exposure e = make_exposure(10000, 16, 1);
    e.holds = true;
    TEST_ASSERT_TRUE(settle(&e, pixels, 0.01, 1, &changes) >= 0);
    const int64_t time = e.time_now, gain = e.gain_now;
    TEST_ASSERT_EQUAL_INT(0, settle(&e, pixels, 0.002, 1, &changes));
    TEST_ASSERT_TRUE(e.time_now == time && e.gain_now == gain);
}

/* What lies outside the image circle, a stray reflex there, must not darken the pipe. */
static void test_only_the_image_circle_counts(void)
{
    static uint8_t pixels[WIDE * HIGH];
    const pf_image image = {pixels, WIDE, HIGH, WIDE};
    pf_exposure e = make_exposure(100, 1, 1);
    for (uint32_t y = 0; y < HIGH; y++)
        for (uint32_t x = 0; x < WIDE; x++)
            pixels[y * WIDE + x] = hypot(x - 160.0, y - 120.0) < 118 ? PF_EXPOSURE_TARGET : 255;
    for (int i = 0; i < 30; i++)
        TEST_ASSERT_FALSE(pf_exposure_judge(&e, &image));
    TEST_ASSERT_EQUAL_UINT32(PF_EXPOSURE_TARGET, e.percentile);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_damaged_jpeg_is_no_frame);
    RUN_TEST(test_every_raw_format_gives_its_grey);
    RUN_TEST(test_colours_are_weighed_whichever_way_round);
    RUN_TEST(test_values_beyond_the_format_are_white_not_black);
    RUN_TEST(test_a_frame_that_is_too_short_does_not_fit);
    RUN_TEST(test_gaps_are_the_kernels_and_wrap_with_them);
    RUN_TEST(test_a_restart_leaves_a_gap_as_long_as_it_took);
    RUN_TEST(test_numbers_and_times_rise_whatever_the_kernel_says);
    RUN_TEST(test_a_stream_that_falls_silent_is_restarted_within_a_second_then_reopened);
    RUN_TEST(test_a_slow_camera_is_not_taken_for_a_stalled_one);
    RUN_TEST(test_an_unplugged_camera_is_closed_at_once_and_tried_at_intervals);
    RUN_TEST(test_exposure_settles_on_the_lit_wall);
    RUN_TEST(test_gain_is_used_only_where_exposure_does_not_reach);
    RUN_TEST(test_steps_coarser_than_the_band_do_not_swing_for_ever);
    RUN_TEST(test_a_held_exposure_stays_when_the_light_changes);
    RUN_TEST(test_only_the_image_circle_counts);
    return UNITY_END();
}
