/* Where nothing may be tracked, and what must not be believed: the user's mask, parts that stand still while the
 * picture moves, reflections, saturation; and new tracks spread over polar cells. */
#include "tube_scene.h"
#include "unity.h"

static uint8_t frame[2][TUBE_W * TUBE_H], mask[TUBE_W * TUBE_H];
static _Alignas(16) uint8_t workspace[600000];
static pf_tracker *tracker;
static pf_tracker_config config;
static tube_view view;
static uint32_t fed, lost_by[PF_TRACK_REASONS];

void setUp(void)
{
    tube_seed = 5;
    config = tube_config;
    view = tube_usual;
    fed = 0;
    memset(lost_by, 0, sizeof lost_by);
}
void tearDown(void) {}

static void start(void)
{
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&tracker, &config, workspace, sizeof workspace));
}

/* Draws over a frame before it is fed. */
typedef void (*painter)(uint8_t *f);

static void feed(painter paint)
{
    uint8_t *f = frame[fed++ % 2u];
    tube_render(f, &view);
    if (paint)
        paint(f);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_frame(tracker, &(pf_image){f, TUBE_W, TUBE_H, TUBE_W}, NULL, NULL));
    for (uint32_t i = 0; i < PF_TRACK_REASONS; i++)
        lost_by[i] += pf_tracker_last_stats(tracker)->lost_by[i];
}

/* Live tracks with x0 <= x < x1, y0 <= y < y1 and at least this age. */
static uint32_t live_in(int x0, int y0, int x1, int y1, uint32_t age)
{
    uint32_t n, count = 0;
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    for (uint32_t i = 0; i < n; i++) {
        const int x = tracks[i].pos.x >> 16, y = tracks[i].pos.y >> 16;
        count += tracks[i].status != PF_TRACK_LOST && tracks[i].age >= age && x >= x0 && x < x1 && y >= y0 && y < y1;
    }
    return count;
}

/* Proves: one masked pixel rules out its block of 8 x 8, for new tracks and for those that come along; the rest is
 * used.
 */
static void test_nothing_is_tracked_in_the_users_mask(void)
{
    memset(mask, 255, sizeof mask);
    for (int y = 40; y < 120; y++)
        for (int x = 200; x < 264; x += 8)
            if (y % 8 == 3)
                mask[y * TUBE_W + x + 5] = 0;
    const pf_image image = {mask, TUBE_W, TUBE_H, TUBE_W};
    config.mask = &image;
    start();
    for (int k = 0; k < 40; k++) {
        feed(NULL);
        TEST_ASSERT_EQUAL_UINT32(0, live_in(200, 40, 264, 120, 0));
        view.z += 4;
    }
    TEST_ASSERT_GREATER_THAN_UINT32(0, lost_by[PF_TRACK_MASKED]);
    TEST_ASSERT_GREATER_THAN_UINT32(40, pf_tracker_last_stats(tracker)->live);
    const pf_image small = {mask, TUBE_W - 1, TUBE_H, TUBE_W};
    config.mask = &small;
    TEST_ASSERT_EQUAL_size_t(0, pf_tracker_workspace_size(&config));
}

/* A part of the robot: a dark plate with bright marks, in the lower right. */
static void paint_plate(uint8_t *f)
{
    for (int y = 150; y < 190; y++)
        for (int x = 180; x < 228; x++)
            f[y * TUBE_W + x] = (uint8_t)(((x / 7 + y / 5) % 3 == 0 ? 190 : 50) + (f[y * TUBE_W + x] & 3));
}

/* Proves: a part that stands still while the wall goes by holds no track for longer than 10 frames from the start, and
 * is masked after 300 frames at 8 px; of the moving wall no block is. */
static void test_parts_that_stand_still_are_learned(void)
{
    start();
    for (int k = 0; k < 300; k++) {
        feed(paint_plate);
        view.z += 5;
        if (k > 20)
            TEST_ASSERT_LESS_OR_EQUAL_UINT32(1, live_in(184, 154, 224, 186, 10));
    }
    TEST_ASSERT_GREATER_THAN_UINT32(0, lost_by[PF_TRACK_STATIC]);
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(2, live_in(176, 144, 232, 194, 1));
    const uint32_t learned = pf_tracker_last_stats(tracker)->scene.static_blocks;
    TEST_ASSERT_TRUE(learned >= 20 && learned <= 72); /* it covers 24 blocks whole; windows that see it fill 72 */
    for (int k = 0; k < 300; k++) {                   /* it is gone: the wall is used again */
        feed(NULL);
        view.z += 5;
    }
    /* what is left lies where the tube's end begins to be seen, at 7 degrees */
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(16, pf_tracker_last_stats(tracker)->scene.static_blocks);
    TEST_ASSERT_GREATER_THAN_UINT32(1, live_in(184, 154, 224, 186, 1));
}

/* Proves: on a weakly textured wall (sigma 6, less than the lamp's fall across a block) the mask does not grow: over
 * 600 frames it stays below 3 % of the 484 blocks; dirt is found there as well, and forgotten when it is gone. What is
 * masked lies where the tube's end begins to be seen. */
static void test_weak_walls_are_not_masked(void)
{
    start();
    view.contrast = 0.2;
    view.noise = 1;
    for (int k = 0; k < 900; k++) {
        feed(k < 300 ? paint_plate : NULL);
        view.z += 5;
        if (k == 299)
            TEST_ASSERT_GREATER_OR_EQUAL_UINT32(20, pf_tracker_last_stats(tracker)->scene.static_blocks);
    }
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(12, pf_tracker_last_stats(tracker)->scene.static_blocks);
}

/* Proves: at a standstill nothing is dropped and nothing learned, however long it lasts. */
static void test_standing_still_teaches_nothing(void)
{
    start();
    for (int k = 0; k < 20; k++, view.z += 4)
        feed(NULL);
    memset(lost_by, 0, sizeof lost_by);
    for (int k = 0; k < 150; k++)
        feed(NULL);
    TEST_ASSERT_EQUAL_UINT32(0, lost_by[PF_TRACK_STATIC]);
    TEST_ASSERT_EQUAL_UINT32(0, pf_tracker_last_stats(tracker)->scene.static_blocks);
    TEST_ASSERT_GREATER_THAN_UINT32(45, live_in(0, 0, TUBE_W, TUBE_H, 150));
}

/* Two reflections of the lamp: they sway a little, but stay where the lamp is. */
static void paint_glints(uint8_t *f)
{
    static const int at[2][2] = {{100, 90}, {220, 140}};
    for (int k = 0; k < 2; k++)
        for (int y = -8; y <= 8; y++)
            for (int x = -8; x <= 8; x++) {
                const double sway = 0.4 * sin(fed * 0.8 + k), d = (x - sway) * (x - sway) / 12 + y * y / (8.0 + 6 * k);
                const double a = fmin(1, 1.6 * exp(-d));
                uint8_t *p = &f[(at[k][1] + y) * TUBE_W + at[k][0] + x];
                *p = (uint8_t)lrint(*p + a * (235 - *p));
            }
}

/* Proves: a track that sticks to a reflection is lost as STATIC within 10 frames of its first sight, and the reflection
 * is not taken up again and again. */
static void test_reflections_are_not_followed(void)
{
    uint32_t stuck = 0;
    start();
    for (int k = 0; k < 80; k++) {
        feed(paint_glints);
        view.z += 4;
        if (k >= 20)
            stuck += live_in(96, 86, 105, 95, 6) + live_in(216, 136, 225, 145, 6);
    }
    TEST_ASSERT_TRUE(lost_by[PF_TRACK_STATIC] >= 1 && lost_by[PF_TRACK_STATIC] <= 20);
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(12, stuck);
}

/* Proves: on a plain drive no track is called static, at any speed, with roll, ahead and back. */
static void test_walls_are_not_called_static(void)
{
    static const double speed[] = {1, 5, 9, -4};
    for (int s = 0; s < 4; s++) {
        setUp();
        start();
        for (int k = 0; k < 60; k++) {
            feed(NULL);
            view.z += speed[s];
            view.roll += 0.02 * sin(k * 0.3);
        }
        TEST_ASSERT_LESS_OR_EQUAL_UINT32(3, lost_by[PF_TRACK_STATIC]);
        TEST_ASSERT_LESS_OR_EQUAL_UINT32(3, pf_tracker_last_stats(tracker)->scene.static_blocks);
    }
}

#define LOW 0.1 /* height over the invert in radii: 0.05 diameters */

/* Draws the tube as a camera low above its invert sees it, `z` radii in: what lies up moves at a twentieth of the pace
 * of what lies down. */
static void render_low(uint8_t *f, double z)
{
    for (int y = 0; y < TUBE_H; y++)
        for (int x = 0; x < TUBE_W; x++) {
            const double dx = x - TUBE_W / 2, dy = y - TUBE_H / 2, r = hypot(dx, dy), theta = r / TUBE_FOCAL;
            double v = 0;
            if (theta > 0.05 && theta < 1.5) {
                const double ux = dx / r, uy = dy / r, b = (1 - LOW) * uy;
                const double d = -b + sqrt(b * b + 1 - (1 - LOW) * (1 - LOW)), along = d / tan(theta);
                if (along < 8)
                    v = (130 + tube_wall((along + z) * 120, atan2(1 - LOW + d * uy, d * ux) * TUBE_RADIUS)) /
                        (1 + along * along / 9);
            }
            v += tube_noise[(fed * 7919u + (uint32_t)(y * TUBE_W + x)) & 0xFFFFu];
            f[y * TUBE_W + x] = (uint8_t)(v < 0 ? 0 : v > 255 ? 255 : lrint(v));
        }
}

/* Proves: with the camera 0.05 diameters above the invert nothing of the wall is called static, though the crown's pace
 * is far below its ring's median; reflections are, there as anywhere. */
static void test_slow_crowns_are_not_called_static(void)
{
    config.max_tracks = 160;
    for (int glints = 0; glints < 2; glints++) {
        memset(lost_by, 0, sizeof lost_by);
        start();
        for (fed = 0; fed < 60;) {
            uint8_t *f = frame[fed % 2u];
            render_low(f, fed * LOW * 0.12);
            if (glints)
                paint_glints(f);
            fed++;
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_frame(tracker, &(pf_image){f, TUBE_W, TUBE_H, TUBE_W}, NULL, NULL));
            lost_by[PF_TRACK_STATIC] += pf_tracker_last_stats(tracker)->lost_by[PF_TRACK_STATIC];
        }
        TEST_ASSERT_GREATER_THAN_UINT32(60, pf_tracker_last_stats(tracker)->tracked);
        if (glints)
            TEST_ASSERT_GREATER_THAN_UINT32(0, lost_by[PF_TRACK_STATIC]);
        else
            TEST_ASSERT_EQUAL_UINT32(0, lost_by[PF_TRACK_STATIC]);
    }
}

/* Glare that grows over the right half. */
static void paint_glare(uint8_t *f)
{
    for (int y = 0; y < TUBE_H; y++)
        for (int x = 0; x < TUBE_W; x++) {
            const double v = f[y * TUBE_W + x] * (x > 160 ? 1 + fed * 0.05 : 1);
            f[y * TUBE_W + x] = (uint8_t)(v > 255 ? 255 : v);
        }
}

/* Proves: where a quarter of the window is saturated a track is lost, as SATURATED if nothing else was wrong before,
 * and none is taken up. */
static void test_saturated_patches_are_given_up(void)
{
    start();
    for (int k = 0; k < 40; k++) {
        uint32_t n;
        feed(paint_glare);
        view.z += 1;
        const pf_track *tracks = pf_tracker_tracks(tracker, &n);
        const uint8_t *f = frame[(fed - 1u) % 2u];
        for (uint32_t i = 0; i < n; i++) {
            int bright = 0;
            for (int y = -7; y <= 7 && tracks[i].status != PF_TRACK_LOST; y++)
                for (int x = -7; x <= 7; x++)
                    bright += f[((tracks[i].pos.y >> 16) + y) * TUBE_W + (tracks[i].pos.x >> 16) + x] >= 250;
            TEST_ASSERT_TRUE(bright <= 15 * 15 / 4);
        }
    }
    TEST_ASSERT_GREATER_THAN_UINT32(3, lost_by[PF_TRACK_SATURATED]);
}

/* Proves: with polar cells no cell gets more new tracks than its share, none lies in the inner eighth, and 9 of 12
 * sectors of the middle rings have some; without a circle there are no polar cells. */
static void test_polar_cells_share_the_tracks(void)
{
    uint32_t n, in[12][6] = {{0}}, sectors = 0;
    config.max_tracks = 144;
    config.polar = true;
    start();
    feed(NULL);
    const pf_track *tracks = pf_tracker_tracks(tracker, &n);
    TEST_ASSERT_GREATER_THAN_UINT32(50, n);
    for (uint32_t i = 0; i < n; i++) {
        const double dx = tracks[i].pos.x / 65536.0 - TUBE_W / 2, dy = tracks[i].pos.y / 65536.0 - TUBE_H / 2;
        const double phi = atan2(dy, dx), r = hypot(dx, dy) / TUBE_CIRCLE;
        TEST_ASSERT_TRUE(r >= 0.124);
        in[(int)((phi < 0 ? phi + 2 * TUBE_PI : phi) / (TUBE_PI / 6))][(int)(6 * r)]++;
    }
    for (int s = 0; s < 12; s++) {
        for (int r = 0; r < 6; r++)
            TEST_ASSERT_LESS_OR_EQUAL_UINT32(3, in[s][r]);
        sectors += in[s][2] + in[s][3] + in[s][4] > 0;
    }
    TEST_ASSERT_GREATER_OR_EQUAL_UINT32(9, sectors);
    config.circle_radius_q16 = 0;
    TEST_ASSERT_EQUAL_size_t(0, pf_tracker_workspace_size(&config));
}

int main(void)
{
    tube_make();
    UNITY_BEGIN();
    RUN_TEST(test_nothing_is_tracked_in_the_users_mask);
    RUN_TEST(test_parts_that_stand_still_are_learned);
    RUN_TEST(test_weak_walls_are_not_masked);
    RUN_TEST(test_standing_still_teaches_nothing);
    RUN_TEST(test_reflections_are_not_followed);
    RUN_TEST(test_walls_are_not_called_static);
    RUN_TEST(test_slow_crowns_are_not_called_static);
    RUN_TEST(test_saturated_patches_are_given_up);
    RUN_TEST(test_polar_cells_share_the_tracks);
    return UNITY_END();
}
