/* Prediction through rays, and what it does for the tracker: large shifts are found, wrong predictions harm nothing. */
#include "tube_scene.h"
#include "unity.h"

static uint8_t frame[2][TUBE_W * TUBE_H];
static _Alignas(16) uint8_t workspace[600000];
static pf_tracker *tracker;
static pf_predictor predictor;
static _Alignas(16) uint8_t predictor_block[PF_PREDICTOR_BYTES(400)];
static uint32_t elapsed; /* frames, of the hints */
static int64_t counts_from;
static double roll_from;
static _Alignas(16) uint8_t camera_block[4000], rays_block[60000];
static const pf_camera_fixed *camera;
static const pf_camera_rays *table;
static pf_ray_q30 rays[2 * PF_TRACKS_MAX];
static pf_expected at[2 * PF_TRACKS_MAX];
static pf_track before[2 * PF_TRACKS_MAX];
static tube_view view, last;
static uint32_t fed, before_n;

void setUp(void)
{
    tube_seed = 5;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&tracker, &tube_config, workspace, sizeof workspace));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_predictor_init(&predictor, 400, predictor_block, sizeof predictor_block));
    elapsed = 1;
    counts_from = 0;
    roll_from = 0;
    view = last = tube_usual;
    fed = 0;
    const pf_camera lens = {.width = TUBE_W, /* of tube_scene.h */
                            .height = TUBE_H,
                            .radial = PF_RADIAL_EQUIDISTANT,
                            .f_u = TUBE_FOCAL,
                            .f_v = TUBE_FOCAL,
                            .c_u = TUBE_W / 2,
                            .c_v = TUBE_H / 2,
                            .theta_max = 2 * asin(0.75)};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&camera, &lens, camera_block, sizeof camera_block));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_rays_init(&table, camera, 16, rays_block, sizeof rays_block));
}
void tearDown(void) {}

static pf_motion_hints hints_of(const tube_view *v, bool with_sensors)
{
    const uint64_t count = (uint64_t)counts_from + (uint64_t)(int64_t)floor(v->z * 20);
    return (pf_motion_hints){with_sensors, with_sensors, (int64_t)count,
                             (int32_t)lrint(remainder(roll_from - v->roll, 2 * TUBE_PI) * 1e6), elapsed};
}

/* Guesses for the table as it is and the view to come. */
static uint32_t guess(const tube_view *next, bool with_sensors)
{
    uint32_t n;
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    const pf_motion_hints hints = hints_of(next, with_sensors);
    pf_predictor_guess(&predictor, tracks, rays, n, &hints, pf_track_project, camera, at);
    return n;
}

/* The view as a frame, tracked; learned from when `learns`. */
static void feed(bool learns, bool with_sensors)
{
    uint8_t *f = frame[fed++ % 2u];
    uint32_t n;
    memcpy(before, pf_tracker_tracks(tracker, &before_n), sizeof before);
    tube_render(f, &view);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_frame(tracker, &(pf_image){f, TUBE_W, TUBE_H, TUBE_W}, NULL, NULL));
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    const pf_motion_hints now = hints_of(&view, with_sensors);
    pf_track_bearings(table, tracks, n, rays);
    if (learns)
        pf_predictor_learn(&predictor, tracks, rays, n, &now);
    last = view;
}

/* Median and share within 3 px of |guess - truth| over live tracks that stay in view. */
static double guess_error(const tube_view *next, bool with_sensors, double *share)
{
    static uint32_t error[2 * PF_TRACKS_MAX];
    uint32_t n, count = 0, good = 0;
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    TEST_ASSERT_EQUAL_UINT32(n, guess(next, with_sensors));
    for (uint32_t i = 0; i < n; i++) {
        const double p[2] = {tracks[i].pos.x / 65536.0, tracks[i].pos.y / 65536.0};
        double q[2];
        tube_move(p, &view, next, q);
        if (tracks[i].status == PF_TRACK_LOST || hypot(q[0] - TUBE_W / 2, q[1] - TUBE_H / 2) > TUBE_CIRCLE)
            continue;
        TEST_ASSERT_NOT_EQUAL_INT32(PF_NO_GUESS, at[i].at.x);
        const double e = hypot(at[i].at.x / 65536.0 - q[0], at[i].at.y / 65536.0 - q[1]);
        good += e < 3;
        error[count++] = (uint32_t)(e * 1000);
    }
    TEST_ASSERT_GREATER_THAN_UINT32(25, count);
    uint32_t median = 0, least = UINT32_MAX;
    for (uint32_t i = 0; i < count; i++) {
        uint32_t below = 0;
        for (uint32_t j = 0; j < count; j++)
            below += error[j] < error[i];
        if (below >= count / 2u && error[i] < least)
            median = least = error[i];
    }
    *share = (double)good / count;
    return median / 1000.0;
}

/* Proves: steady driving is predicted to 0.25 px in the median from the pictures alone, though tracks speed up on their
 * way out; three times the speed, told by the encoder, to 0.5 px; a standstill and a return likewise. */
static void test_driving_is_predicted_through_rays(void)
{
    static const double factor[] = {1, 3, 0, -2};
    for (int k = 0; k < 4; k++) {
        double share;
        setUp();
        for (int i = 0; i < 8; i++) {
            view.z += 4;
            feed(true, k > 0);
        }
        tube_view next = view;
        next.z += 4 * factor[k];
        const double median = guess_error(&next, k > 0, &share);
        TEST_ASSERT_TRUE(median < (k ? 0.5 : 0.25));
        TEST_ASSERT_TRUE(share > 0.9);
    }
}

/* Proves: what an encoder count means in radii is learned, to 3 %, whichever way the encoder counts; before, and
 * without one, nothing is said; nor after a leap, which is no reading to foresee by, or of a frame without one. */
static void test_a_count_is_so_many_radii(void)
{
    const uint64_t radius = (uint64_t)lround(TUBE_RADIUS * 20); /* counts, as hints_of has them */
    for (int way = -1; way <= 1; way++) {
        setUp();
        pf_motion_hints now = hints_of(&view, true);
        TEST_ASSERT_EQUAL_INT64(0, pf_predictor_way(&predictor, &now, radius));
        for (int i = 0; i < 16; i++) {
            view.z += way < 0 ? -4 : 4;
            feed(true, way != 0);
        }
        now = hints_of(&view, true);
        const int64_t said = pf_predictor_way(&predictor, &now, radius);
        TEST_ASSERT_INT64_WITHIN(way ? (1 << 24) / 33 : 0, way ? 1 << 24 : 0, said);
    }
    pf_predictor_assume(&predictor, -(1 << 20)); /* -1/128 of a radius */
    pf_motion_hints next = hints_of(&view, true);
    for (int i = 0; i < 3; i++, next.encoder += 256) /* four radii are no leap yet */
        TEST_ASSERT_EQUAL_INT64((1 << 24) / 128 * 10, pf_predictor_way(&predictor, &next, 10));
    next.encoder = hints_of(&view, true).encoder - 513;
    TEST_ASSERT_EQUAL_INT64(0, pf_predictor_way(&predictor, &next, 10));
    next.frames = 2; /* one was dropped */
    TEST_ASSERT_EQUAL_INT64((1 << 24) / 128 * 10, pf_predictor_way(&predictor, &next, 10));
    next.has_encoder = false;
    TEST_ASSERT_EQUAL_INT64(0, pf_predictor_way(&predictor, &next, 10));
}

/* Proves: a steady roll is predicted from the pictures, a sudden one from the inclinometer. */
static void test_roll_is_predicted(void)
{
    double share;
    for (int i = 0; i < 6; i++) {
        view.z += 3;
        view.roll += 0.05;
        feed(true, true);
    }
    tube_view next = view;
    next.z += 3;
    next.roll += 0.05;
    TEST_ASSERT_TRUE(guess_error(&next, false, &share) < 0.4);
    next.roll -= 0.25;
    TEST_ASSERT_TRUE(guess_error(&next, true, &share) < 0.6);
}

/* Proves: over two dropped frames driving and roll are predicted three frames on, from the pictures alone and with an
 * encoder, to 0.5 px; and what was learned over the gap is one frame's motion again. */
static void test_dropped_frames_are_counted(void)
{
    for (int sensors = 0; sensors < 2; sensors++) {
        double share;
        setUp();
        for (int i = 0; i < 8; i++) {
            view.z += 4;
            view.roll += 0.02;
            feed(true, sensors);
        }
        for (int i = 0; i < 2; i++) {
            tube_view next = view;
            elapsed = i ? 1 : 3;
            next.z += 4 * elapsed;
            next.roll += 0.02 * elapsed;
            TEST_ASSERT_TRUE(guess_error(&next, sensors, &share) < 0.5);
            view = next;
            TEST_ASSERT_TRUE(guess(&view, sensors) > 0);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_expect(tracker, at, before_n = guess(&view, sensors)));
            feed(true, sensors);
        }
    }
}

/* Proves: readings at the ends of their ranges predict like others: a roll of half a turn, an encoder's register that
 * wraps; a leap that no drive makes is no reading. */
static void test_readings_wrap_and_leaps_are_ignored(void)
{
    double share;
    roll_from = TUBE_PI - 0.01;
    counts_from = INT64_MAX - 80 * 9;
    for (int i = 0; i < 8; i++) {
        view.z += 4;
        view.roll += i % 2 ? 0.05 : -0.05; /* across the end and back */
        feed(true, true);
    }
    tube_view next = view;
    next.z += 12;
    TEST_ASSERT_TRUE(guess_error(&next, true, &share) < 1.0);
    next.z = view.z + 4;
    counts_from = 0;
    TEST_ASSERT_TRUE(guess_error(&next, true, &share) < 1.0);
    counts_from = INT64_MAX - 80 * 9 - 1000000; /* 600 radii */
    TEST_ASSERT_TRUE(guess_error(&next, true, &share) < 1.0);
}

/* Tracked tracks and those off by over 1 px, in the last frame, of tracks that should still be seen. */
static uint32_t count_found(const tube_view *from, uint32_t *possible, uint32_t *wrong)
{
    uint32_t n, found = 0;
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    *possible = *wrong = 0;
    for (uint32_t i = 0; i < before_n; i++) {
        const double p[2] = {before[i].pos.x / 65536.0, before[i].pos.y / 65536.0};
        double q[2];
        tube_move(p, from, &view, q);
        if (before[i].status == PF_TRACK_LOST || hypot(q[0] - TUBE_W / 2, q[1] - TUBE_H / 2) > TUBE_CIRCLE - 14)
            continue;
        (*possible)++;
        for (uint32_t j = 0; j < n; j++)
            if (tracks[j].id == before[i].id && tracks[j].status == PF_TRACK_TRACKED) {
                found++;
                *wrong += hypot(tracks[j].pos.x / 65536.0 - q[0], tracks[j].pos.y / 65536.0 - q[1]) > 1;
            }
    }
    return found;
}

/* Proves: guesses that are 40 px off in any direction cost at most a track or two, and make none wrong. */
static void test_wrong_predictions_harm_nothing(void)
{
    uint32_t found[9], possible, wrong;
    for (int k = 0; k < 9; k++) {
        setUp();
        for (int i = 0; i < 5; i++) {
            view.z += 2;
            feed(true, false);
        }
        const tube_view from = view;
        uint32_t n;
        view.z += 2;
        const pf_track *tracks = pf_tracker_tracks(tracker, &n);
        for (uint32_t i = 0; i < n; i++) {
            at[i] = (pf_expected){.warp_q16 = {65536, 0, 0, 65536},
                                  .at = {tracks[i].pos.x + (int32_t)(40 * 65536 * cos(k)),
                                         tracks[i].pos.y + (int32_t)(40 * 65536 * sin(k))}};
            if (k == 8)
                at[i] = (pf_expected){.warp_q16 = {65536, 0, 0, 65536}, .at = {INT32_MAX, INT32_MIN + 1}};
        }
        if (k)
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_expect(tracker, at, n));
        feed(false, false);
        found[k] = count_found(&from, &possible, &wrong);
        TEST_ASSERT_EQUAL_UINT32(0, wrong);
        TEST_ASSERT_TRUE(found[k] + 2 >= found[0]);
    }
    TEST_ASSERT_TRUE(10 * found[0] >= 9 * possible);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_tracker_expect(tracker, at, 1));
}

int main(void)
{
    tube_make();
    UNITY_BEGIN();
    RUN_TEST(test_driving_is_predicted_through_rays);
    RUN_TEST(test_a_count_is_so_many_radii);
    RUN_TEST(test_roll_is_predicted);
    RUN_TEST(test_dropped_frames_are_counted);
    RUN_TEST(test_readings_wrap_and_leaps_are_ignored);
    RUN_TEST(test_wrong_predictions_harm_nothing);
    return UNITY_END();
}
