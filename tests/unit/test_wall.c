/* Tracks that walk off the wall are told from those that stay on it, by their neighbours. */
#include <math.h>
#include <string.h>

#include "pipefish/camera_fixed.h"
#include "pipefish/track.h"
#include "unity.h"

#define WIDTH  640
#define HEIGHT 640
#define FOCAL  200.0
#define TRACKS 72u

static _Alignas(16) uint8_t camera_block[4000], block[PF_WALL_BYTES(TRACKS)];
static const pf_camera_fixed *camera;
static pf_wall wall;

/* A point on the wall of a tube of radius 1, by azimuth and place along; a part by which it lies nearer. */
static struct {
    double azimuth, z, nearer;
} point[TRACKS];
static pf_track track[TRACKS];
static pf_ray_q30 ray[TRACKS];
static uint16_t astray[TRACKS];
static uint32_t noise;
static double beside, askew; /* the camera: it stands so far beside the axis, and is tilted by so much both ways */

void setUp(void)
{
    const pf_camera lens = {.width = WIDTH,
                            .height = HEIGHT,
                            .radial = PF_RADIAL_EQUIDISTANT,
                            .f_u = FOCAL,
                            .f_v = FOCAL,
                            .c_u = WIDTH / 2,
                            .c_v = HEIGHT / 2,
                            .theta_max = 1.57};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&camera, &lens, camera_block, sizeof camera_block));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_wall_init(&wall, TRACKS, block, sizeof block));
    noise = 1;
    beside = askew = 0;
    for (uint32_t i = 0; i < TRACKS; i++) {
        point[i].azimuth = 2.399963 * i; /* spread by the golden angle */
        point[i].z = 1.2 + 0.8 * (i % 9u) / 8.0;
        point[i].nearer = 0;
        track[i] = (pf_track){.id = i + 1, .status = PF_TRACK_TRACKED};
    }
}
void tearDown(void) {}

static double next_noise(void)
{
    noise = noise * 1664525u + 1013904223u;
    return (double)(noise >> 8) / (1 << 23) - 1.0;
}

/* The rays of all points from a camera that has driven by `way`: below the axis, tilted, swaying; to 0.1 px. */
static void look(double way)
{
    const double x = beside + 0.02 * sin(3 * way), y = 0.16, yaw = askew + 0.01 + 0.01 * sin(5 * way),
                 pitch = askew + 0.02;
    for (uint32_t i = 0; i < TRACKS; i++) {
        const double near = 1 - point[i].nearer;
        double p[3] = {cos(point[i].azimuth) * near - x, sin(point[i].azimuth) * near - y, point[i].z - way};
        const double a = p[0] * cos(yaw) - p[2] * sin(yaw), c = p[0] * sin(yaw) + p[2] * cos(yaw);
        const double b = p[1] * cos(pitch) - c * sin(pitch), d = p[1] * sin(pitch) + c * cos(pitch);
        const double u = a + 0.0005 * next_noise() * d, v = b + 0.0005 * next_noise() * d,
                     n = sqrt(u * u + v * v + d * d);
        ray[i] = (pf_ray_q30){(int32_t)lrint(u / n * 1073741823), (int32_t)lrint(v / n * 1073741823),
                              (int32_t)lrint(d / n * 1073741823)};
    }
}

static uint32_t check(void)
{
    return pf_wall_check(&wall, track, ray, TRACKS, pf_track_project, camera, PF_WALL_MOST_Q16, astray);
}

/* Drives a radius in so many frames; returns how often each track was found astray. */
static void drive_in(uint32_t frames, uint32_t times[TRACKS])
{
    for (uint32_t i = 0; i < TRACKS; i++)
        times[i] = 0;
    for (uint32_t k = 0; k <= frames; k++) {
        look((double)k / frames);
        const uint32_t n = check();
        for (uint32_t i = 0; i < n; i++)
            times[astray[i]]++;
    }
}

static void drive(uint32_t times[TRACKS])
{
    drive_in(40, times);
}

/* Proves: on a round wall nobody is astray, wherever the camera stands, however it sways and is tilted. */
static void test_nobody_walks_off_a_round_wall(void)
{
    uint32_t times[TRACKS];
    drive(times);
    for (uint32_t i = 0; i < TRACKS; i++)
        TEST_ASSERT_EQUAL_UINT32(0, times[i]);
}

/* Proves: and then it is known where the camera stands in it, and how it is tilted, each of the four to a fifth. */
static void test_the_axis_is_found(void)
{
    uint32_t times[TRACKS];
    int64_t axis[4];
    beside = 0.15;
    askew = 0.1;
    drive(times);
    TEST_ASSERT_TRUE(pf_wall_axis_of(&wall, axis));
    const double yaw = 0.11 + 0.01 * sin(5), pitch = 0.12;
    const double expected[4] = {-0.15 - 0.02 * sin(3), -0.16, -yaw, -pitch};
    for (int i = 0; i < 4; i++)
        TEST_ASSERT_DOUBLE_WITHIN(fabs(expected[i]) / 5, expected[i], (double)axis[i] / 16777216.0);
}

/* Proves: a track that moves like a wall a fiftieth nearer, 2 px and more at the rim, is found, and it alone. */
static void test_a_track_that_walks_off_is_found(void)
{
    uint32_t times[TRACKS];
    point[30].nearer = 0.02;
    drive(times);
    for (uint32_t i = 0; i < TRACKS; i++)
        TEST_ASSERT_EQUAL_UINT32(i == 30, times[i] > 0);
}

/* Proves: so it is with a camera so slow that no point moves by more than 0.4 px a frame, of 0.1 px noise; and
 * what the others walk off, 0.1 px for their noise, adds up so little that 0.3 px are taken back at most. */
static void test_a_slow_camera_finds_it_too(void)
{
    static pf_track settled[TRACKS];
    uint32_t times[TRACKS];
    point[30].nearer = 0.02;
    drive_in(640, times);
    for (uint32_t i = 0; i < TRACKS; i++) {
        TEST_ASSERT_EQUAL_UINT32(i == 30, times[i] > 0);
        TEST_ASSERT_TRUE(pf_track_project(camera, &ray[i], &track[i].pos));
    }
    memcpy(settled, track, sizeof settled);
    pf_wall_settle(&wall, settled, TRACKS, pf_track_project, camera);
    TEST_ASSERT_EQUAL_UINT32(32768, wall.light_q16);
    uint32_t moved = 0;
    for (uint32_t i = 0; i < TRACKS; i++) { /* and it is told by how much, so that the place can be had as it was */
        TEST_ASSERT_EQUAL_INT32(track[i].pos.x, settled[i].pos.x - 256 * settled[i].settled_x_q8);
        TEST_ASSERT_EQUAL_INT32(track[i].pos.y, settled[i].pos.y - 256 * settled[i].settled_y_q8);
        moved += settled[i].settled_x_q8 != 0 || settled[i].settled_y_q8 != 0;
    }
    TEST_ASSERT_GREATER_THAN_UINT32(TRACKS / 2, moved);
    for (uint32_t i = 0; i < TRACKS; i++)
        TEST_ASSERT_TRUE(i == 30 ||
                         hypot(settled[i].pos.x - track[i].pos.x, settled[i].pos.y - track[i].pos.y) < 19661);
}

/* Proves: where neighbours lie nearer alike, something stands on the wall: they are not astray. Its rim aside, where
 * most neighbours lie on the wall. */
static void test_what_stands_on_the_wall_stays(void)
{
    uint32_t times[TRACKS], near = 0;
    for (uint32_t i = 0; i < TRACKS; i++)
        if (cos(point[i].azimuth - 1) > 0.8)
            point[i].nearer = 0.06;
    drive(times);
    for (uint32_t i = 0; i < TRACKS; i++)
        if (cos(point[i].azimuth - 1) > 0.9) {
            TEST_ASSERT_EQUAL_UINT32(0, times[i]);
            near++;
        }
    TEST_ASSERT_GREATER_THAN_UINT32(6, near);
}

/* Where ray i is seen, px. */
static void seen_at(uint32_t i, double at[2])
{
    pf_point_q16 p;
    TEST_ASSERT_TRUE(pf_track_project(camera, &ray[i], &p));
    at[0] = p.x / 65536.0;
    at[1] = p.y / 65536.0;
    track[i].pos = p;
}

/* Proves: of the 4.2 px that a track walks off alone, 2.5 and more of them since the axis is known, a keyframe's place
 * is moved back by a half, as odds of one, times 1 + 4 (1 - 2 cot) as it is within the cotangent of a half of standing
 * square (here 3.3: 0.77); towards where the wall is; others by their noise, 0.1 px a sight, which grows with the
 * picture. */
static void test_a_part_of_what_a_track_walks_alone_is_taken_back(void)
{
    static pf_track settled[TRACKS], whole[TRACKS];
    uint32_t times[TRACKS];
    double at[2], truth[2];
    /* the 31st is first seen where the 30th is, on the wall */
    const double near = 0.98, y = 0.16, cx = near * cos(point[30].azimuth), cy = near * sin(point[30].azimuth) - y;
    const double a = cx * cx + cy * cy, b = cy * y, longer = (sqrt(b * b + a * (1 - y * y)) - b) / a;
    point[30].nearer = 1 - near;
    point[30].z = 1.2;
    point[31].azimuth = atan2(longer * cy + y, longer * cx);
    point[31].z = longer * point[30].z;
    drive(times);
    for (uint32_t i = 0; i < TRACKS; i++)
        seen_at(i, at);
    memcpy(settled, track, sizeof settled);
    memcpy(whole, track, sizeof whole);
    pf_wall_settle(&wall, settled, TRACKS, pf_track_project, camera);
    TEST_ASSERT_EQUAL_UINT32(32768, wall.light_q16);
    wall.light_q16 = 65536; /* all of it */
    pf_wall_settle(&wall, whole, TRACKS, pf_track_project, camera);
    seen_at(31, truth);
    seen_at(30, at);
    const double cot = (double)ray[30].z / hypot(ray[30].x, ray[30].y), part = 1 - 1 / (2 + 4 * (1 - 2 * cot));
    const double off = hypot(at[0] - truth[0], at[1] - truth[1]), x = whole[30].pos.x / 65536.0 - at[0],
                 v = whole[30].pos.y / 65536.0 - at[1], along = (x * (truth[0] - at[0]) + v * (truth[1] - at[1])) / off;
    TEST_ASSERT_TRUE(off > 4 && along > 2.5 && hypot(x, v) < off + 0.4);
    TEST_ASSERT_TRUE(part > 0.75);
    TEST_ASSERT_DOUBLE_WITHIN(0.01, part * x, settled[30].pos.x / 65536.0 - at[0]);
    TEST_ASSERT_DOUBLE_WITHIN(0.01, part * v, settled[30].pos.y / 65536.0 - at[1]);
    for (uint32_t i = 0; i < TRACKS; i++)
        TEST_ASSERT_TRUE(i == 30 ||
                         hypot(settled[i].pos.x - track[i].pos.x, settled[i].pos.y - track[i].pos.y) < 0.67 * 65536);
}

/* Proves: something broad that stands on the wall, 0.06 radii high, keeps its shape to 1 px: its middle has walked 10
 * px off. */
static void test_what_walks_off_alike_is_left_where_it_is(void)
{
    static pf_track settled[TRACKS];
    uint32_t times[TRACKS];
    double at[2];
    for (uint32_t i = 0; i < TRACKS; i++)
        if (cos(point[i].azimuth - 1) > 0.8)
            point[i].nearer = 0.06;
    drive(times);
    for (uint32_t i = 0; i < TRACKS; i++)
        seen_at(i, at);
    memcpy(settled, track, sizeof settled);
    pf_wall_settle(&wall, settled, TRACKS, pf_track_project, camera);
    for (uint32_t i = 0; i < TRACKS; i++)
        if (cos(point[i].azimuth - 1) > 0.95)
            TEST_ASSERT_TRUE(hypot(settled[i].pos.x - track[i].pos.x, settled[i].pos.y - track[i].pos.y) < 65536);
}

/* Sees all, as far as can be from where it saw the time before. */
static bool project_far(const void *turn, const pf_ray_q30 *v, pf_point_q16 *at)
{
    int32_t *times = (int32_t *)(uintptr_t)turn;
    (void)v;
    *at = (*times)++ % 2 == 0 ? (pf_point_q16){INT32_MAX, INT32_MAX} : (pf_point_q16){INT32_MIN, INT32_MIN};
    return true;
}

/* Proves: whatever places a camera gives, the way between two is a number, and no track is moved by more than five
 * sixths of the farthest. */
static void test_places_farther_apart_than_numbers_go_do_no_harm(void)
{
    uint32_t times[TRACKS];
    int32_t turn = 0;
    point[30].nearer = 0.02;
    drive(times);
    (void)pf_wall_check(&wall, track, ray, TRACKS, project_far, &turn, PF_WALL_MOST_Q16, astray);
    for (uint32_t i = 0; i < TRACKS; i++)
        track[i].pos = (pf_point_q16){0, 0};
    pf_wall_settle(&wall, track, TRACKS, project_far, &turn);
    for (uint32_t i = 0; i < TRACKS; i++)
        TEST_ASSERT_TRUE(track[i].pos.x <= 0 && track[i].pos.x >= -(INT32_MAX / 6 * 5 + 6));
}

/* Proves: fewer than twelve tracks judge nobody; standing still, frames without tracks and a bad size do no harm. */
static void test_what_tells_nothing_does_no_harm(void)
{
    for (uint32_t k = 0; k < 50; k++) {
        look(0);
        TEST_ASSERT_EQUAL_UINT32(0, check());
    }
    TEST_ASSERT_EQUAL_UINT32(0,
                             pf_wall_check(&wall, track, ray, 0, pf_track_project, camera, PF_WALL_MOST_Q16, astray));
    for (uint32_t i = 11; i < TRACKS; i++)
        track[i].status = PF_TRACK_LOST;
    for (uint32_t k = 0; k < 20; k++) {
        look(k * 0.03);
        ray[3] = ray[4];
        TEST_ASSERT_EQUAL_UINT32(0, check());
    }
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_wall_init(&wall, TRACKS, block, sizeof block - 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_wall_init(&wall, PF_TRACKS_MAX + 1, block, sizeof block));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_nobody_walks_off_a_round_wall);
    RUN_TEST(test_the_axis_is_found);
    RUN_TEST(test_a_track_that_walks_off_is_found);
    RUN_TEST(test_a_slow_camera_finds_it_too);
    RUN_TEST(test_what_stands_on_the_wall_stays);
    RUN_TEST(test_a_part_of_what_a_track_walks_alone_is_taken_back);
    RUN_TEST(test_what_walks_off_alike_is_left_where_it_is);
    RUN_TEST(test_places_farther_apart_than_numbers_go_do_no_harm);
    RUN_TEST(test_what_tells_nothing_does_no_harm);
    return UNITY_END();
}
