/* Patches of a tube's wall bend as the lens says, and tracks that know it do not drift; none begins too late. */
#include "../../lib/track/track_private.h"
#include "tube_scene.h"
#include "unity.h"

#define FRAMES 36

static uint8_t frame[2][TUBE_W * TUBE_H];
static _Alignas(16) uint8_t workspace[600000], camera_block[4000], rays_block[60000];
static const pf_camera_fixed *camera;
static const pf_camera_rays *table;

void setUp(void)
{
    const pf_camera lens = {.width = TUBE_W, /* of tube_scene.h */
                            .height = TUBE_H,
                            .radial = PF_RADIAL_EQUIDISTANT,
                            .f_u = TUBE_FOCAL,
                            .f_v = TUBE_FOCAL,
                            .c_u = TUBE_W / 2,
                            .c_v = TUBE_H / 2,
                            .theta_max = 2 * asin(0.75)};
    tube_seed = 5;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&camera, &lens, camera_block, sizeof camera_block));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_rays_init(&table, camera, 16, rays_block, sizeof rays_block));
}
void tearDown(void) {}

/* Where the wall seen at (x, y) goes when the camera drives on by `way` texels and rolls by `roll`. */
static void moved(double x, double y, double way, double roll, double q[2])
{
    const double p[2] = {x, y};
    tube_view a = tube_usual, b = tube_usual;
    b.z = way;
    b.roll = roll;
    tube_move(p, &a, &b, q);
}

/* Proves: for drives ahead and back, with a roll, at all angles, the bow is the quadratic part of the map between the
 * two pictures, to 2e-6 a pixel (rays and projections are good to 1e-5 rad and 2e-5 px): 0.001 px over a window of 21.
 */
static void test_a_bow_is_the_quadratic_part_of_the_motion(void)
{
    const pf_track_lens lens = pf_track_lens_of(table, camera);
    const int32_t half = 7;
    for (int32_t k = 0; k < 60; k++) {
        const int32_t x = TUBE_W / 2 + (int32_t)lrint((30 + k) * cos(k)),
                      y = TUBE_H / 2 + (int32_t)lrint((30 + k) * sin(k));
        const double way = (k % 3 - 1) * 12.0, roll = k % 4 == 3 ? 0.2 : 0;
        double q[3][3][2], a[2][2], c[2];
        pf_bow bow;
        for (int j = -1; j <= 1; j++)
            for (int i = -1; i <= 1; i++)
                moved(x + i * half, y + j * half, way, roll, q[j + 1][i + 1]);
        if (hypot(q[1][1][0] - TUBE_W / 2, q[1][1][1] - TUBE_H / 2) > TUBE_CIRCLE - 2 * half)
            continue;
        const pf_point_q16 to = {(int32_t)lrint(q[1][1][0] * 65536), (int32_t)lrint(q[1][1][1] * 65536)};
        TEST_ASSERT_TRUE(pf_bow_between(&lens, half, x, y, to, &bow));
        for (int i = 0; i < 2; i++) {
            a[i][0] = (q[1][2][i] - q[1][0][i]) / (2 * half);
            a[i][1] = (q[2][1][i] - q[0][1][i]) / (2 * half);
        }
        const double det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
        for (int m = 0; m < 3; m++) {
            for (int i = 0; i < 2; i++) {
                const double xx = q[1][2][i] + q[1][0][i] - 2 * q[1][1][i],
                             yy = q[2][1][i] + q[0][1][i] - 2 * q[1][1][i];
                c[i] = (m == 0   ? xx
                        : m == 2 ? yy
                                 : q[2][2][i] + q[0][0][i] - 2 * q[1][1][i] - xx - yy) /
                       (2 * half * half);
            }
            TEST_ASSERT_DOUBLE_WITHIN(2e-6, (a[1][1] * c[0] - a[0][1] * c[1]) / det, bow.c[m] / 16777216.0);
            TEST_ASSERT_DOUBLE_WITHIN(2e-6, (a[0][0] * c[1] - a[1][0] * c[0]) / det, bow.c[3 + m] / 16777216.0);
        }
    }
}

/* Proves: the light has turned by the fall of the cotangent over its square, at most by 2, however square it stood. */
static void test_the_light_turns_as_the_cotangent_falls(void)
{
    const pf_track_lens lens = pf_track_lens_of(table, camera);
    for (int32_t r = 30; r < 90; r += 2)
        for (int32_t s = 30; s < 90; s += 5) {
            const pf_ray_q30 a = lens.ray(lens.rays, (pf_point_q16){(TUBE_W / 2 + r) << 16, (TUBE_H / 2) << 16}),
                             b = lens.ray(lens.rays, (pf_point_q16){(TUBE_W / 2 + s) << 16, (TUBE_H / 2) << 16});
            const double from = a.z / hypot(a.x, a.y), to = b.z / hypot(b.x, b.y), base = fmax(fabs(from), 0.125);
            pf_bow bow;
            if (pf_bow_between(&lens, 7, TUBE_W / 2 + r, TUBE_H / 2,
                               (pf_point_q16){(TUBE_W / 2 + s) << 16, (TUBE_H / 2) << 16}, &bow))
                TEST_ASSERT_DOUBLE_WITHIN(1.1, fmin(512, 256 * fabs(from - to) / (base * base)), bow.turned_q8);
        }
}

/* Proves: where the lens tells nothing (near the axis, beyond its field) there is no bow. */
static void test_there_is_no_bow_where_the_lens_tells_nothing(void)
{
    const pf_track_lens lens = pf_track_lens_of(table, camera);
    const pf_point_q16 to = {(TUBE_W / 2 + 80) << 16, (TUBE_H / 2) << 16}, outside = {400 << 16, 0};
    pf_bow bow;
    TEST_ASSERT_FALSE(pf_bow_between(&lens, 7, TUBE_W / 2, TUBE_H / 2, to, &bow));
    TEST_ASSERT_FALSE(pf_bow_between(&lens, 7, 3, 3, to, &bow));
    TEST_ASSERT_FALSE(pf_bow_between(&lens, 7, TUBE_W / 2 + 60, TUBE_H / 2, outside, &bow));
    TEST_ASSERT_TRUE(pf_bow_between(&lens, 7, TUBE_W / 2 + 60, TUBE_H / 2, to, &bow));
}

/* Mean of how far outwards of their point tracks lie that were first seen beyond 46 degrees, once they have grown by a
 * fifth and more; px. (Below, the bow changes its sign.) */
static double drift(bool with_lens)
{
    static double first[4096][3];
    pf_tracker_config config = tube_config;
    pf_tracker *tracker;
    tube_view view = tube_usual;
    double sum = 0;
    uint32_t count = 0;
    if (with_lens)
        config.lens = pf_track_lens_of(table, camera);
    tube_seed = 5;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&tracker, &config, workspace, sizeof workspace));
    for (uint32_t k = 0; k < FRAMES; k++, view.z += 2.5) {
        uint32_t n;
        tube_render(frame[k % 2u], &view);
        TEST_ASSERT_EQUAL_INT(
            PF_OK, pf_tracker_frame(tracker, &(pf_image){frame[k % 2u], TUBE_W, TUBE_H, TUBE_W}, NULL, NULL));
        const pf_track *track = pf_tracker_tracks(tracker, &n);
        for (uint32_t i = 0; i < n; i++) {
            const double p[2] = {track[i].pos.x / 65536.0, track[i].pos.y / 65536.0};
            double *f = first[track[i].id % 4096u], q[2];
            if (track[i].status == PF_TRACK_NEW) {
                f[0] = p[0], f[1] = p[1], f[2] = view.z;
            } else if (track[i].status == PF_TRACK_TRACKED) {
                moved(f[0], f[1], view.z - f[2], 0, q);
                const double dx = q[0] - TUBE_W / 2, dy = q[1] - TUBE_H / 2, r = hypot(dx, dy);
                const double off = ((p[0] - q[0]) * dx + (p[1] - q[1]) * dy) / r;
                const double grown =
                    sin(r / TUBE_FOCAL) / sin(hypot(f[0] - TUBE_W / 2, f[1] - TUBE_H / 2) / TUBE_FOCAL);
                if (hypot(f[0] - TUBE_W / 2, f[1] - TUBE_H / 2) > 60 && grown * grown > 1.2 && fabs(off) < 1) {
                    sum += off;
                    count++;
                }
            }
        }
    }
    TEST_ASSERT_GREATER_THAN_UINT32(200, count);
    return sum / count;
}

/* Proves: with the lens, tracks do not drift inwards together as they come out from ahead: 0.01 px are left of 0.05. */
static void test_tracks_that_know_the_lens_do_not_drift(void)
{
    TEST_ASSERT_TRUE(fabs(drift(true)) < 0.02);
    TEST_ASSERT_TRUE(drift(false) < -0.035);
}

/* How far from the circle's centre, px, new tracks begin at most, once the flow is known: by `way` texels a frame. */
static double farthest_new(bool with_lens, double way)
{
    pf_tracker_config config = tube_config;
    pf_tracker *tracker;
    tube_view view = tube_usual;
    double most = 0;
    if (with_lens)
        config.lens = pf_track_lens_of(table, camera);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&tracker, &config, workspace, sizeof workspace));
    for (uint32_t k = 0; k < FRAMES; k++, view.z += way) {
        uint32_t n;
        tube_render(frame[k % 2u], &view);
        TEST_ASSERT_EQUAL_INT(
            PF_OK, pf_tracker_frame(tracker, &(pf_image){frame[k % 2u], TUBE_W, TUBE_H, TUBE_W}, NULL, NULL));
        const pf_track *track = pf_tracker_tracks(tracker, &n);
        for (uint32_t i = 0; i < n && k > 1; i++)
            if (track[i].status == PF_TRACK_NEW)
                most = fmax(most, hypot(track[i].pos.x / 65536.0 - TUBE_W / 2, track[i].pos.y / 65536.0 - TUBE_H / 2));
    }
    return most;
}

/* Proves: in a tube whose wall comes out, tracks begin up to where half a radius of way is left before a window reaches
 * the rim (two steps of keyframes), and not beyond; where the wall goes in, or no lens is known, up to the outer
 * eighth.
 */
static void test_nothing_begins_that_is_gone_before_the_third_keyframe(void)
{
    const double rim = (TUBE_CIRCLE - 11) / TUBE_FOCAL; /* where a window of 15 fits in */
    const double late = TUBE_FOCAL * atan2(1, 1 / tan(rim) + 0.5), outer = TUBE_CIRCLE * 7 / 8;
    const double out = farthest_new(true, 2.5), in = farthest_new(true, -2.5), plain = farthest_new(false, 2.5);
    TEST_ASSERT_TRUE(out > late - 3 && out < late + 0.1);
    TEST_ASSERT_TRUE(in > outer - 3 && in < outer + 0.1);
    TEST_ASSERT_TRUE(plain > outer - 3 && plain < outer + 0.1);
}

int main(void)
{
    tube_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_bow_is_the_quadratic_part_of_the_motion);
    RUN_TEST(test_the_light_turns_as_the_cotangent_falls);
    RUN_TEST(test_there_is_no_bow_where_the_lens_tells_nothing);
    RUN_TEST(test_tracks_that_know_the_lens_do_not_drift);
    RUN_TEST(test_nothing_begins_that_is_gone_before_the_third_keyframe);
    return UNITY_END();
}
