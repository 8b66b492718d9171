/* States of the scene, recognised by the tracker while it drives through a tube: each state, the way into it and out of
 * it, and that nothing else is reported meanwhile. */
#include <stdio.h>

#include "tube_scene.h"
#include "unity.h"

static uint8_t frame[2][TUBE_W * TUBE_H];
static _Alignas(16) uint8_t workspace[600000];
static pf_tracker *tracker;
static pf_scene scene;
static pf_scene_hints hints;
static tube_view view;
static uint32_t fed;

void setUp(void)
{
    tube_seed = 5;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&tracker, &tube_config, workspace, sizeof workspace));
    memset(&scene, 0, sizeof scene);
    memset(&hints, 0, sizeof hints);
    view = tube_usual;
    fed = 0;
}
void tearDown(void) {}

static uint32_t feed(void)
{
    uint8_t *f = frame[fed++ % 2u];
    tube_render(f, &view);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_frame(tracker, &(pf_image){f, TUBE_W, TUBE_H, TUBE_W}, NULL, NULL));
    return pf_scene_update(&scene, &pf_tracker_last_stats(tracker)->scene, &hints);
}

/* Drives `frames` frames at `speed` texels each; in the last `settled` of them exactly `expected` must be reported, and
 * in those before nothing but what was already and `expected`. */
static void drive(uint32_t frames, double speed, uint32_t settled, uint32_t expected)
{
    const uint32_t before = scene.flags;
    for (uint32_t k = 0; k < frames; k++) {
        view.z += speed;
        const uint32_t flags = feed();
        char text[64];
        (void)snprintf(text, sizeof text, "frame %u", fed - 1u);
        if (k + settled >= frames)
            TEST_ASSERT_EQUAL_HEX32_MESSAGE(expected, flags, text);
        else
            TEST_ASSERT_EQUAL_HEX32_MESSAGE(0, flags & ~(before | expected), text);
    }
}

/* Proves: driving ahead at any speed is reported as nothing special. */
static void test_driving_ahead_is_no_state(void)
{
    static const double speed[] = {0.5, 2, 6, 10};
    for (int k = 0; k < 4; k++) {
        setUp();
        drive(30, speed[k], 30, 0);
    }
}

/* Proves: standing is reported within a window and 5 frames, and over 2 frames after it moves; creeping at 0.15 px a
 * frame in the median is not standing. */
static void test_standing_still_is_told_from_creeping(void)
{
    drive(20, 3, 20, 0);
    drive(2 * PF_SCENE_WINDOW + 10, 0, 3, PF_SCENE_STANDING);
    drive(10, 3, 8, 0);
    drive(40, 0.3, 20, 0);
}

/* Proves: going back is reported within 5 frames, ended by going ahead and by standing. */
static void test_reversing_is_the_sign_of_the_radial_flow(void)
{
    drive(20, 3, 20, 0);
    drive(20, -3, 15, PF_SCENE_REVERSING);
    drive(20, 3, 15, 0);
    drive(20, -3, 15, PF_SCENE_REVERSING);
    drive(40, 0, 10, PF_SCENE_STANDING);
    drive(20, -3, 12, PF_SCENE_REVERSING);
}

/* Proves: rolling, on the spot and under way, is no reversing. */
static void test_roll_is_not_reversing(void)
{
    for (int k = 0; k < 40; k++) {
        view.roll += 0.03;
        view.z += k < 20 ? 0 : 2;
        TEST_ASSERT_EQUAL_HEX32(0, feed());
    }
}

/* Proves: with the lamp off the scene is dark, and back within 2 frames; a lamp known to be on makes the same picture a
 * covered lens. Meanwhile the encoder tells of standing and reversing. */
static void test_lamp_off_is_dark_and_dark_with_the_lamp_on_is_covered(void)
{
    drive(15, 3, 15, 0);
    view.gain = 0.02;
    drive(10, 3, 8, PF_SCENE_DARK);
    hints.has_encoder = true;
    for (int k = 0; k < 12; k++) {
        hints.encoder -= 5;
        (void)feed();
    }
    TEST_ASSERT_EQUAL_HEX32(PF_SCENE_DARK | PF_SCENE_REVERSING, scene.flags);
    drive(20, 0, 3, PF_SCENE_DARK | PF_SCENE_STANDING);
    hints.has_encoder = false;
    hints.has_lamp = hints.lamp_on = true;
    drive(10, 0, 2, PF_SCENE_COVERED);
    view.gain = 1;
    drive(20, 3, 12, 0);
}

/* Proves: something grey right before the lens, with a soft slope of light, is a covered lens, and neither weak texture
 * nor standing. */
static void test_covered_lens_is_recognised(void)
{
    drive(15, 3, 15, 0);
    view.gain = 0.03;
    view.bias = 90;
    drive(15, 3, 8, PF_SCENE_COVERED);
    view = (tube_view){view.z, 0, 1, 0, 1, 2};
    drive(15, 3, 8, 0);
}

/* Proves: the noise of a high gain does not hide it, though its grain passes for texture. */
static void test_covered_lens_is_recognised_under_noise(void)
{
    for (int noise = 8; noise <= 20; noise += 6) {
        setUp();
        drive(15, 3, 15, 0);
        view.gain = 0.03;
        view.bias = 90;
        view.noise = noise;
        drive(20, 3, 8, PF_SCENE_COVERED);
    }
}

/* Proves: an encoder that counts against the picture is told after 10 frames, and one that stands while it moves; one
 * that agrees, in either direction and across the end of its range, and one beside a roll are not. */
static void test_an_encoder_against_the_picture_is_told(void)
{
    static const struct {
        double speed;
        int64_t counts;
        uint32_t flags;
    } way[] = {{3, 5, 0},
               {3, -5, PF_SCENE_ENCODER},
               {3, 0, PF_SCENE_ENCODER},
               {-3, -5, PF_SCENE_REVERSING},
               {-3, 5, PF_SCENE_REVERSING | PF_SCENE_ENCODER}};
    for (size_t i = 0; i < sizeof way / sizeof way[0]; i++) {
        setUp();
        hints = (pf_scene_hints){.has_encoder = true, .encoder = INT64_MAX - 50};
        uint64_t at = INT64_MAX - 50;
        for (int k = 0; k < 40; k++) {
            view.z += way[i].speed;
            at += (uint64_t)way[i].counts;
            hints.encoder = (int64_t)at;
            (void)feed();
        }
        TEST_ASSERT_EQUAL_HEX32(way[i].flags, scene.flags);
    }
    setUp();
    hints.has_encoder = true;
    for (int k = 0; k < 40; k++) {
        view.roll += 0.03;
        TEST_ASSERT_EQUAL_HEX32(0, feed() & PF_SCENE_ENCODER);
    }
}

/* Proves: glare over a quarter of the picture is over-exposure; a bright picture that is not saturated is none. */
static void test_over_exposure_is_recognised(void)
{
    drive(15, 3, 15, 0);
    view.gain = 1.15;
    drive(15, 3, 15, 0);
    view.gain = 3;
    drive(15, 3, 8, PF_SCENE_OVEREXPOSED);
    view.gain = 1;
    drive(15, 3, 8, 0);
}

/* Proves: a smooth pipe is weak texture, and neither dark nor covered. */
static void test_weak_texture_is_recognised(void)
{
    drive(15, 3, 15, 0);
    view.contrast = 0.03;
    drive(20, 3, 10, PF_SCENE_WEAK_TEXTURE);
    view.contrast = 1;
    drive(20, 3, 10, 0);
}

/* Proves: a single odd frame (a flash, a dropped exposure) changes no state. */
static void test_one_odd_frame_changes_nothing(void)
{
    static const double gain[] = {0, 3};
    for (int k = 0; k < 2; k++) {
        setUp();
        drive(15, 3, 15, 0);
        view.gain = gain[k];
        drive(1, 3, 1, 0);
        view.gain = 1;
        drive(15, 3, 15, 0);
    }
}

int main(void)
{
    tube_make();
    UNITY_BEGIN();
    RUN_TEST(test_driving_ahead_is_no_state);
    RUN_TEST(test_standing_still_is_told_from_creeping);
    RUN_TEST(test_reversing_is_the_sign_of_the_radial_flow);
    RUN_TEST(test_roll_is_not_reversing);
    RUN_TEST(test_lamp_off_is_dark_and_dark_with_the_lamp_on_is_covered);
    RUN_TEST(test_covered_lens_is_recognised);
    RUN_TEST(test_covered_lens_is_recognised_under_noise);
    RUN_TEST(test_an_encoder_against_the_picture_is_told);
    RUN_TEST(test_over_exposure_is_recognised);
    RUN_TEST(test_weak_texture_is_recognised);
    RUN_TEST(test_one_odd_frame_changes_nothing);
    return UNITY_END();
}
