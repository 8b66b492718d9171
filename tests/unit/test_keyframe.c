#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "pipefish/track.h"
#include "unity.h"

#define N 200

static pf_keyframe_state state;
static _Alignas(16) uint8_t workspace[PF_KEYFRAME_BYTES(N)];
static pf_track tracks[N];
static pf_ray_q30 rays[N];
static const pf_keyframe_config config = {.min_interval = 1};

void setUp(void)
{
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_keyframe_init(&state, N, workspace, sizeof workspace));
}
void tearDown(void) {}

/* Points on the wall of a 300 mm pipe, seen from z = `travel` (metres) by a camera turned by `angle` about `axis`. */
static void look(double travel, double angle, int axis)
{
    const double c = cos(angle), s = sin(angle);
    for (int i = 0; i < N; i++) {
        const double phi = i * 2.399963, p[3] = {0.15 * cos(phi), 0.15 * sin(phi), 0.05 + 0.002 * i - travel};
        const int a = (axis + 1) % 3, b = (axis + 2) % 3;
        double q[3] = {p[0], p[1], p[2]};
        q[a] = c * p[a] - s * p[b];
        q[b] = s * p[a] + c * p[b];
        const double n = 1073741824.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]);
        rays[i] = (pf_ray_q30){(int32_t)lrint(q[0] * n), (int32_t)lrint(q[1] * n), (int32_t)lrint(q[2] * n)};
        tracks[i] = (pf_track){.id = (uint64_t)i + 1u, .status = PF_TRACK_TRACKED, .age = 10};
    }
}

/* Turns the rays that there are. */
static void look_again(double angle, int axis)
{
    const double c = cos(angle), s = sin(angle);
    for (int i = 0; i < N; i++) {
        int32_t *v[3] = {&rays[i].x, &rays[i].y, &rays[i].z}, *a = v[(axis + 1) % 3], *b = v[(axis + 2) % 3];
        const double x = *a, y = *b;
        *a = (int32_t)lrint(c * x - s * y);
        *b = (int32_t)lrint(s * x + c * y);
    }
}

static pf_keyframe_cause decide(const pf_keyframe_config *c, const int64_t *encoder, uint32_t *common)
{
    return pf_keyframe_decide(&state, c, tracks, rays, N, encoder, 0, common);
}

/* Proves: the encoder rules where there is one, in either direction, and parallax then does not. */
static void test_encoder_steps_choose_keyframes_in_both_directions(void)
{
    const pf_keyframe_config c = {.step_counts = 100, .min_interval = 1};
    static const struct {
        int64_t at;
        pf_keyframe_cause expected;
    } step[] = {{1000, PF_KEYFRAME_FIRST}, {1099, PF_KEYFRAME_NO},      {1100, PF_KEYFRAME_ENCODER},
                {1001, PF_KEYFRAME_NO},    {1000, PF_KEYFRAME_ENCODER}, {901, PF_KEYFRAME_NO}};
    for (size_t i = 0; i < sizeof step / sizeof step[0]; i++) {
        look(0.02 * (double)i, 0, 0);
        TEST_ASSERT_EQUAL_INT(step[i].expected, decide(&c, &step[i].at, NULL));
    }
}

/* Proves: the third keyframe from any frame on comes when it was foreseen to, to a frame: at even speeds, slow ones,
 * those at which keyframes are as near as frames allow, and backwards; and nothing is foreseen without counts. */
static void test_the_third_keyframe_is_foreseen(void)
{
    static const int64_t speed[] = {3, 7, 30, 60, 80, 250, -13};
    const pf_keyframe_config c = {.step_counts = 100, .min_interval = 2};
    for (size_t i = 0; i < sizeof speed / sizeof speed[0]; i++) {
        const uint64_t frame = (uint64_t)llabs(speed[i]);
        uint64_t foreseen[400];
        int64_t at[400];
        uint32_t chosen[400], n = 0;
        pf_keyframe_reset(&state);
        TEST_ASSERT_EQUAL_UINT64(0, pf_keyframe_third(&state, &c, 5000));
        for (int k = 0; k < 400; k++) {
            at[k] = 5000 + speed[i] * k;
            foreseen[k] = pf_keyframe_third(&state, &c, at[k]);
            look(0.0001 * k, 0, 0);
            if (decide(&c, &at[k], NULL) != PF_KEYFRAME_NO)
                chosen[n++] = (uint32_t)k;
        }
        TEST_ASSERT_GREATER_THAN_UINT32(8, n);
        for (uint32_t k = 2, next = 1; k < chosen[n - 3u]; k++) {
            next += k > chosen[next];
            const uint64_t true_way = (uint64_t)llabs(at[chosen[next + 2u]] - at[k]);
            TEST_ASSERT_UINT64_WITHIN(frame, true_way, foreseen[k]);
        }
    }
    TEST_ASSERT_EQUAL_UINT64(0, pf_keyframe_third(&state, &config, 5000));
    TEST_ASSERT_EQUAL_UINT64(0, pf_keyframe_third(&state, &c, INT64_MAX)); /* no drive goes so far */
}

/* Proves: rotation alone is no parallax, about any axis and up to 15 degrees; it is compensated, not just ignored. */
static void test_pure_rotation_makes_no_keyframe(void)
{
    for (int axis = 0; axis < 3; axis++) {
        uint32_t common = 0;
        pf_keyframe_reset(&state);
        look(0, 0, 0);
        TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FIRST, decide(&config, NULL, &common));
        TEST_ASSERT_EQUAL_UINT32(0, common);
        look(0, 15 * 3.14159265 / 180, axis);
        TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, &common));
        TEST_ASSERT_EQUAL_UINT32(N, common);
    }
}

/* Proves: the rotation is found to better than 100 micro-radians (11 LSB of a squared chord) out to 30 degrees, from
 * oblique views too; and to 1000, what a Cauchy loss leaves, when a quarter of the tracks goes astray. */
static void test_rotation_is_found_to_a_ten_thousandth(void)
{
    static const double angle[] = {0.001, 0.1, 0.26, 0.52};
    for (int k = 0; k < 4; k++)
        for (int axis = 0; axis < 3; axis++)
            for (int wild = 0; wild <= N / 4; wild += N / 4) {
                const pf_keyframe_config c = {.min_interval = 1, .parallax_urad = wild ? 1000 : 100};
                pf_keyframe_reset(&state);
                look(0, 0.3, (axis + 1) % 3);
                TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FIRST, decide(&c, NULL, NULL));
                look(0, 0.3, (axis + 1) % 3);
                look_again(angle[k], axis);
                for (int i = 0; i < wild; i++)
                    rays[4 * i] = rays[(4 * i + 57) % N];
                TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&c, NULL, NULL));
            }
}

/* Proves: driving makes a keyframe when the median angle passes the threshold, and not before, roll or no roll. */
static void test_forward_motion_makes_a_keyframe_at_the_parallax(void)
{
    for (int k = 0; k < 2; k++) {
        int steps = 0;
        double median[N];
        pf_keyframe_reset(&state);
        look(0, 0, 2);
        TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FIRST, decide(&config, NULL, NULL));
        do {
            steps++;
            look(0.002 * steps, 0.1 * k, 2);
        } while (decide(&config, NULL, NULL) == PF_KEYFRAME_NO && steps < 200);
        for (int i = 0; i < N; i++) { /* axial points turn by the difference of their polar angles */
            const double z = 0.05 + 0.002 * i;
            median[i] = fabs(atan2(0.15, z - 0.002 * steps) - atan2(0.15, z));
        }
        int above = 0;
        for (int i = 0; i < N; i++)
            above += median[i] >= 0.174533;
        /* half of the points at the threshold; the roll leaves a little to the robust fit */
        TEST_ASSERT_INT_WITHIN(10, N / 2, above);
    }
}

/* Proves: few common tracks force a keyframe; a weakly textured reference is judged by half of what it had. */
static void test_few_common_tracks_force_a_keyframe(void)
{
    uint32_t common;
    look(0, 0, 0);
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FIRST, decide(&config, NULL, NULL));
    for (int i = 0; i < 100; i++)
        tracks[i].status = PF_TRACK_LOST;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, &common));
    TEST_ASSERT_EQUAL_UINT32(100, common);
    tracks[100].status = PF_TRACK_LOST;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FEW_COMMON, decide(&config, NULL, &common));
    TEST_ASSERT_EQUAL_UINT32(99, common);
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, NULL)); /* 99 of 99, though fewer than 100 */
    for (int i = 101; i < 150; i++)
        tracks[i].status = PF_TRACK_LOST;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, &common)); /* 50 of 99: above half */
    tracks[150].status = tracks[151].status = PF_TRACK_LOST;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FEW_COMMON, decide(&config, NULL, NULL));
}

/* Proves: after a keyframe in the dark, without a track, light forces one; a few tracks do not. */
static void test_a_reference_without_tracks_is_not_kept(void)
{
    look(0, 0, 0);
    for (int i = 0; i < N; i++)
        tracks[i].status = PF_TRACK_LOST;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FIRST, decide(&config, NULL, NULL));
    for (int i = 0; i < 16; i++)
        tracks[i].status = PF_TRACK_TRACKED;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, NULL));
    tracks[16].status = PF_TRACK_TRACKED;
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_FEW_COMMON, decide(&config, NULL, NULL));
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, NULL));
}

/* Proves: the interval holds whatever the cause. */
static void test_interval_between_keyframes_is_kept(void)
{
    const pf_keyframe_config c = {.step_counts = 1, .min_interval = 3};
    for (int64_t k = 0; k < 12; k++) {
        const int64_t at = 1000 * k;
        look(0.05 * (double)k, 0, 0);
        for (int i = 0; i < N; i++)
            tracks[i].id += 1000u * (uint64_t)k; /* nothing in common either */
        TEST_ASSERT_EQUAL_INT(k == 0       ? PF_KEYFRAME_FIRST
                              : k % 3 == 0 ? PF_KEYFRAME_ENCODER
                                           : PF_KEYFRAME_NO,
                              decide(&c, &at, NULL));
    }
}

/* Proves: bearings outside the camera's domain are left out of the parallax but count as common. */
static void test_invalid_bearings_are_left_out(void)
{
    uint32_t common;
    look(0, 0, 0);
    decide(&config, NULL, NULL);
    look(0.001, 0, 0);
    for (int i = 0; i < N - 20; i++)
        rays[i] = (pf_ray_q30){0, 0, 0};
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_NO, decide(&config, NULL, &common));
    TEST_ASSERT_EQUAL_UINT32(N, common);
}

/* Frames of 200 corners of noise: nearly all are gone in the next. Returns the keyframes. */
static uint32_t storm(uint32_t frames, uint32_t lasting, const int64_t *encoder, uint32_t scene)
{
    uint32_t keyframes = 0;
    uint64_t id = 1000;
    look(0, 0, 0);
    for (uint32_t k = 0; k < frames; k++) {
        for (uint32_t i = 0; i < N; i++)
            tracks[i] = (pf_track){.id = id++, .status = PF_TRACK_NEW};
        for (uint32_t i = 0; i < lasting; i++)
            tracks[i] = (pf_track){.id = 1 + i + k / 3 * lasting, .status = PF_TRACK_TRACKED, .age = k % 3};
        keyframes += pf_keyframe_decide(&state, &config, tracks, rays, N, encoder, scene, NULL) != PF_KEYFRAME_NO;
    }
    return keyframes;
}

/* Proves: corners of the sensor's noise, which come and go, are no common tracks that were lost; those of them that do
 * live three frames force a keyframe less and less often, none with a standing encoder or in the dark. */
static void test_noise_makes_no_storm_of_keyframes(void)
{
    static const int64_t at = 5;
    TEST_ASSERT_EQUAL_UINT32(1, storm(200, 0, NULL, 0));
    setUp();
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(8, storm(200, 40, NULL, 0));
    setUp();
    TEST_ASSERT_EQUAL_UINT32(1, storm(30, 40, NULL, PF_SCENE_WEAK_TEXTURE));
    setUp();
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(3, storm(200, 40, &at, 0));
}

/* Proves: an encoder that is stuck does not stop keyframes by parallax; one that counts does. */
static void test_parallax_chooses_while_the_encoder_is_stuck(void)
{
    static const int64_t stuck = 7;
    const pf_keyframe_config c = {.step_counts = 100, .min_interval = 1};
    uint32_t keyframes[2] = {0, 0};
    for (int counts = 0; counts < 2; counts++) {
        setUp();
        for (int64_t k = 0; k < 60; k++) {
            look(0.005 * (double)k, 0, 2);
            keyframes[counts] += decide(&c, counts ? &k : &stuck, NULL) == PF_KEYFRAME_PARALLAX;
        }
    }
    TEST_ASSERT_GREATER_THAN_UINT32(2, keyframes[0]);
    TEST_ASSERT_EQUAL_UINT32(0, keyframes[1]);
}

/* Proves: a state that lasts is a keyframe, once, and so is its end; one that passes is not. */
static void test_a_lasting_state_is_a_keyframe(void)
{
    uint32_t made[200] = {0}, total = 0;
    look(0, 0, 0);
    for (uint32_t k = 0; k < 200; k++) {
        const uint32_t scene = k >= 20 && k < 100 ? PF_SCENE_DARK : k >= 150 && k < 170 ? PF_SCENE_COVERED : 0u;
        made[k] = pf_keyframe_decide(&state, &config, tracks, rays, N, NULL, scene, NULL);
        total += made[k] != PF_KEYFRAME_NO;
    }
    TEST_ASSERT_EQUAL_UINT32(3, total);
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_STATE, made[49]);
    TEST_ASSERT_EQUAL_INT(PF_KEYFRAME_STATE, made[129]);
}

/* Proves: the workspace is checked. */
static void test_too_small_a_workspace_is_refused(void)
{
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_keyframe_init(&state, N + 1, workspace, sizeof workspace));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_keyframe_init(&state, 0, workspace, sizeof workspace));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_keyframe_init(&state, PF_TRACKS_MAX + 1, workspace, SIZE_MAX));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_encoder_steps_choose_keyframes_in_both_directions);
    RUN_TEST(test_the_third_keyframe_is_foreseen);
    RUN_TEST(test_pure_rotation_makes_no_keyframe);
    RUN_TEST(test_rotation_is_found_to_a_ten_thousandth);
    RUN_TEST(test_forward_motion_makes_a_keyframe_at_the_parallax);
    RUN_TEST(test_few_common_tracks_force_a_keyframe);
    RUN_TEST(test_a_reference_without_tracks_is_not_kept);
    RUN_TEST(test_interval_between_keyframes_is_kept);
    RUN_TEST(test_invalid_bearings_are_left_out);
    RUN_TEST(test_noise_makes_no_storm_of_keyframes);
    RUN_TEST(test_parallax_chooses_while_the_encoder_is_stuck);
    RUN_TEST(test_a_lasting_state_is_a_keyframe);
    RUN_TEST(test_too_small_a_workspace_is_refused);
    return UNITY_END();
}
