/* How far out new tracks begin: a drive through a tube drawn ray by ray, so that it is known what way is left before
 * each place leaves the picture. */
#include <math.h>
#include <string.h>

#include "pipefish/track.h"
#include "unity.h"

#define SIDE   320
#define FOCAL  100.0 /* px a radian: 90 degrees at 157 px */
#define CIRCLE 150
#define REACH  16 /* px: nearer to the rim no window fits */
#define STEP   0.03
#define FRAMES 14

static uint8_t frame[2][SIDE * SIDE];
static _Alignas(16) uint8_t workspace[2500000], camera_block[4000], rays_block[60000];
static const pf_camera_fixed *camera;
static const pf_camera_rays *table;
static uint32_t height; /* of the picture: rows above and below are cut off, alike */
static double axis[2];  /* where the tube's is beside the camera's, which it is parallel to */

static bool breaks, is_absurd; /* once it was foreseen: all is forgotten; the axis told is none */

void setUp(void)
{
    height = SIDE;
    axis[0] = axis[1] = 0;
    breaks = is_absurd = false;
}
void tearDown(void) {}

/* How far ahead the wall is that is seen at (x, y) from the picture's middle; *azimuth on the tube. */
static double ahead(double x, double y, double *azimuth)
{
    const double r = hypot(x, y), c = x / r, s = y / r, off = axis[0] * s - axis[1] * c;
    const double rho = axis[0] * c + axis[1] * s + sqrt(1 - off * off);
    *azimuth = atan2(rho * s - axis[1], rho * c - axis[0]);
    return rho / tan(r / FOCAL);
}

static double way_left(double x, double y)
{
    const double r = hypot(x, y), cut = fabs(y) > 0 ? (height / 2.0) * r / fabs(y) : CIRCLE;
    const double rim = (cut < CIRCLE ? cut : CIRCLE) - REACH;
    double azimuth;
    return ahead(x, y, &azimuth) - ahead(x * rim / r, y * rim / r, &azimuth);
}

static void draw(uint8_t *out, double way)
{
    for (uint32_t v = 0; v < height; v++)
        for (uint32_t u = 0; u < SIDE; u++) {
            const double x = u - SIDE / 2.0 + 1e-6, y = v - height / 2.0;
            double azimuth, value = 0;
            const double z = ahead(x, y, &azimuth) + way;
            for (int k = 0; k < 12; k++) { /* waves of 20 to 60 degrees of the wall */
                const int around = 3 + 5 * k % 17;
                value += sin(around * azimuth + (k % 2 ? 1 : -1) * (6 + 7 * k % 13) * z + 1.7 * k);
            }
            out[v * SIDE + u] = (uint8_t)lrint(120 + 22 * value < 0     ? 0
                                               : 120 + 22 * value > 245 ? 245
                                                                        : 120 + 22 * value);
        }
}

/* The ways left where tracks began once the camera was on its way. */
typedef struct births {
    uint32_t n;
    double x[4000], y[4000], left[4000];
} births;

/* Drives; `way` < 0: nothing is foreseen. */
static void drive(double way, bool knows_axis, uint32_t most, births *b)
{
    const int64_t q24[4] = {lrint(axis[0] * (1 << 24)), lrint(axis[1] * (1 << 24)), 0, 0};
    const pf_camera lens = {.width = SIDE,
                            .height = height,
                            .radial = PF_RADIAL_EQUIDISTANT,
                            .f_u = FOCAL,
                            .f_v = FOCAL,
                            .c_u = SIDE / 2.0,
                            .c_v = height / 2.0,
                            .theta_max = 1.56};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_fixed_init(&camera, &lens, camera_block, sizeof camera_block));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_camera_rays_init(&table, camera, 16, rays_block, sizeof rays_block));
    const pf_tracker_config config = {.width = SIDE,
                                      .height = height,
                                      .max_tracks = most,
                                      .cell = 16,
                                      .circle = {SIDE << 15, (int32_t)height << 15},
                                      .circle_radius_q16 = CIRCLE << 16,
                                      .lens = pf_track_lens_of(table, camera)};
    pf_tracker *t;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&t, &config, workspace, sizeof workspace));
    if (way >= 0)
        pf_tracker_foresee(t, lrint(way * (1 << 24)), knows_axis ? q24 : NULL);
    if (is_absurd)
        pf_tracker_foresee(t, INT64_MAX, (const int64_t[]){INT64_MAX, INT64_MIN, INT64_MIN, INT64_MAX});
    if (breaks)
        pf_tracker_reset(t);
    b->n = 0;
    for (uint32_t k = 0; k < FRAMES; k++) {
        uint32_t n;
        draw(frame[k % 2u], STEP * k);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_frame(t, &(pf_image){frame[k % 2u], SIDE, height, SIDE}, NULL, NULL));
        const pf_track *track = pf_tracker_tracks(t, &n);
        for (uint32_t i = 0; i < n && k > 0; i++)
            if (track[i].status == PF_TRACK_NEW) {
                b->x[b->n] = track[i].pos.x / 65536.0 - SIDE / 2.0;
                b->y[b->n] = track[i].pos.y / 65536.0 - height / 2.0;
                b->left[b->n] = way_left(b->x[b->n], b->y[b->n]);
                b->n++;
            }
    }
}

/* Of the births on that side (dx, dy) of the middle, within 45 degrees, the least way left. */
static double least_left(const births *b, double dx, double dy)
{
    double least = 100;
    for (uint32_t i = 0; i < b->n; i++)
        if (dx * b->x[i] + dy * b->y[i] > 0.7 * hypot(b->x[i], b->y[i]))
            least = fmin(least, b->left[i]);
    return least;
}

/* Proves: where a window's way is foreseen, nothing begins that has less of it left, and all the rest may, on every
 * side; in a tube whose axis is a quarter beside the camera's too, but only if that is known. */
static void test_nothing_begins_that_will_be_gone(void)
{
    static const double side[4][2] = {{1, 0}, {0, 1}, {-1, 0}, {0, -1}};
    static births b;
    for (int k = 0; k < 3; k++) {
        axis[0] = k ? 0.15 : 0;
        axis[1] = k ? -0.2 : 0;
        drive(0.8, k < 2, 300, &b);
        double least = 100, most = 0;
        for (int i = 0; i < 4; i++) {
            const double left = least_left(&b, side[i][0], side[i][1]);
            least = fmin(least, left);
            most = fmax(most, left);
        }
        TEST_ASSERT_GREATER_THAN_UINT32(40, b.n);
        TEST_ASSERT_TRUE(k < 2 ? least > 0.78 && most < 0.92 : least < 0.77 && most > 0.92);
    }
}

/* Proves: what is usual, and what is told, is what counts; and the outer eighth stays closed however short the way. */
static void test_the_way_foreseen_decides(void)
{
    static births b;
    drive(-1, false, 300, &b);
    TEST_ASSERT_DOUBLE_WITHIN(0.06, 0.54, least_left(&b, 1, 0));
    drive(1.2, false, 300, &b);
    TEST_ASSERT_DOUBLE_WITHIN(0.06, 1.25, least_left(&b, 1, 0));
    drive(0, false, 300, &b);
    double farthest = 0;
    for (uint32_t i = 0; i < b.n; i++)
        farthest = fmax(farthest, hypot(b.x[i], b.y[i]));
    TEST_ASSERT_TRUE(farthest <= 7.0 / 8 * CIRCLE && farthest > 7.0 / 8 * CIRCLE - 8);
}

/* Proves: after a break what was foreseen before it is forgotten, however absurd; that itself does no harm. */
static void test_a_break_forgets_what_was_foreseen(void)
{
    static births b;
    is_absurd = true;
    drive(1.2, false, 300, &b);
    TEST_ASSERT_GREATER_THAN_UINT32(10, b.n);
    breaks = true;
    drive(1.2, false, 300, &b);
    TEST_ASSERT_DOUBLE_WITHIN(0.06, 0.54, least_left(&b, 1, 0));
    TEST_ASSERT_DOUBLE_WITHIN(0.06, 0.54, least_left(&b, -1, 0));
}

/* Proves: where the picture cuts the circle off, what counts is the way to the picture's border. */
static void test_a_cut_off_circle_ends_where_the_picture_does(void)
{
    static births b;
    height = 208;
    drive(0.6, false, 300, &b);
    TEST_ASSERT_GREATER_THAN_UINT32(40, b.n);
    TEST_ASSERT_TRUE(least_left(&b, 0, 1) > 0.53 && least_left(&b, 0, -1) > 0.53);
    TEST_ASSERT_TRUE(least_left(&b, 0, 1) < 0.75 && least_left(&b, 1, 0) < 0.75);
}

/* Proves: a tracker with hardly a track begins them wherever it can: by what else should the motion be known. */
static void test_few_tracks_begin_anywhere(void)
{
    static births b;
    drive(1.2, false, 10, &b);
    TEST_ASSERT_TRUE(least_left(&b, 1, 0) < 1 || least_left(&b, -1, 0) < 1 || least_left(&b, 0, 1) < 1 ||
                     least_left(&b, 0, -1) < 1);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_nothing_begins_that_will_be_gone);
    RUN_TEST(test_the_way_foreseen_decides);
    RUN_TEST(test_a_break_forgets_what_was_foreseen);
    RUN_TEST(test_a_cut_off_circle_ends_where_the_picture_does);
    RUN_TEST(test_few_tracks_begin_anywhere);
    return UNITY_END();
}
