/* Exposure and gain of V4L2 cameras, against controls made up here. Proves: which control is used, what a unit of it
 * is, and that the camera's own automatics are switched off once, and on again when they are asked for. Does not prove:
 * that a real camera obeys. */
#include "camera_v4l2/v4l2.h"
#include "unity.h"

#include <errno.h>
#include <string.h>

typedef struct fake_control {
    uint32_t id;
    int64_t min, max, value;
    uint32_t flags, refusals; /* so many of the next writes it does not take */
} fake_control;

enum { CONTROLS = 8, WRITES = 32 };

static fake_control controls[CONTROLS];
static struct {
    uint32_t id;
    int32_t value;
} writes[WRITES];
static uint32_t n_controls, n_writes;
static pf_v4l2 camera;
static pf_session_info info;

static fake_control *find(uint32_t id)
{
    errno = EINVAL;
    for (uint32_t i = 0; i < n_controls; i++)
        if (controls[i].id == id)
            return &controls[i];
    return NULL;
}

static int query(struct v4l2_queryctrl *q)
{
    const fake_control *c = find(q->id);
    if (c == NULL || c->max > INT32_MAX)
        return -1;
    q->minimum = (int32_t)c->min;
    q->maximum = (int32_t)c->max;
    q->step = 1;
    q->flags = c->flags;
    return 0;
}

static int write_control(const struct v4l2_control *v)
{
    fake_control *c = find(v->id);
    if (c == NULL)
        return -1;
    TEST_ASSERT_TRUE(n_writes < WRITES);
    writes[n_writes].id = v->id;
    writes[n_writes++].value = v->value;
    errno = EBUSY;
    if (c->refusals > 0 && c->refusals--)
        return -1;
    errno = ERANGE;
    if (v->value < c->min || v->value > c->max)
        return -1;
    c->value = v->value;
    return 0;
}

static int fake_ioctl(void *self, int fd, unsigned long request, void *argument)
{
    (void)self;
    TEST_ASSERT_EQUAL_INT(7, fd);
    struct v4l2_control *v = argument;
    if (request == VIDIOC_QUERYCTRL)
        return query(argument);
    if (request == VIDIOC_S_CTRL)
        return write_control(v);
    if (request == VIDIOC_G_CTRL) {
        const fake_control *c = find(v->id);
        if (c != NULL)
            v->value = (int32_t)c->value;
        return c != NULL ? 0 : -1;
    }
    const struct v4l2_ext_controls *many = argument;
    TEST_ASSERT_TRUE(request == VIDIOC_G_EXT_CTRLS && many->count == 1);
    const fake_control *c = find(many->controls[0].id);
    if (c != NULL)
        many->controls[0].value64 = c->value;
    return c != NULL ? 0 : -1;
}

static void have(uint32_t id, int64_t min, int64_t max, int64_t value)
{
    controls[n_controls++] = (fake_control){id, min, max, value, 0, 0};
}

static void look(void)
{
    pf_v4l2_controls_find(&camera, &info);
}

void setUp(void)
{
    memset(&camera, 0, sizeof camera);
    memset(controls, 0, sizeof controls);
    memset(&info, 0, sizeof info);
    n_controls = n_writes = 0;
    camera.io.ioctl = fake_ioctl;
    camera.fd = 7;
    info.width = 640;
}

void tearDown(void) {}

static void test_absolute_exposure_counts_100_us(void)
{
    have(V4L2_CID_EXPOSURE, 0, 255, 9);
    have(V4L2_CID_EXPOSURE_ABSOLUTE, 3, 2047, 250);
    look();
    TEST_ASSERT_TRUE(info.has_time && !info.has_gain);
    TEST_ASSERT_EQUAL_DOUBLE(100, info.time_unit_us);
    TEST_ASSERT_EQUAL_INT64(3, info.time.min);
    TEST_ASSERT_EQUAL_INT64(2047, info.time.max);
    TEST_ASSERT_EQUAL_INT64(250, info.time_now);
    pf_v4l2_controls_set(&camera, false, 333, 5);
    TEST_ASSERT_EQUAL_INT64(333, find(V4L2_CID_EXPOSURE_ABSOLUTE)->value);
    TEST_ASSERT_EQUAL_INT64(9, find(V4L2_CID_EXPOSURE)->value);
}

/* A line is the picture's width and the blanking, at the pixel rate, which does not fit into 32 bits. */
static void test_exposure_in_lines_is_told_in_microseconds(void)
{
    have(V4L2_CID_EXPOSURE, 4, 1118, 640);
    have(V4L2_CID_HBLANK, 0, 5000, 1160);
    have(V4L2_CID_PIXEL_RATE, 0, INT64_MAX, INT64_C(6000000000));
    look();
    TEST_ASSERT_DOUBLE_WITHIN(1e-9, 1800e6 / 6e9, info.time_unit_us);
    find(V4L2_CID_PIXEL_RATE)->value = 0;
    look();
    TEST_ASSERT_TRUE(info.has_time);
    TEST_ASSERT_EQUAL_DOUBLE(0, info.time_unit_us);
    find(V4L2_CID_PIXEL_RATE)->value = 182400000;
    find(V4L2_CID_HBLANK)->id = 1; /* it does not tell */
    look();
    TEST_ASSERT_EQUAL_DOUBLE(0, info.time_unit_us);
}

static void test_analogue_gain_comes_before_digital(void)
{
    have(V4L2_CID_GAIN, 0, 100, 50);
    look();
    TEST_ASSERT_TRUE(info.has_gain && info.gain.max == 100 && info.gain_now == 50);
    have(V4L2_CID_ANALOGUE_GAIN, 16, 978, 20);
    look();
    TEST_ASSERT_TRUE(info.has_gain && info.gain.min == 16 && info.gain.max == 978 && info.gain_now == 20);
    pf_v4l2_controls_set(&camera, false, 1, 40);
    TEST_ASSERT_EQUAL_INT64(40, find(V4L2_CID_ANALOGUE_GAIN)->value);
    TEST_ASSERT_EQUAL_INT64(50, find(V4L2_CID_GAIN)->value);
}

static void test_what_cannot_be_set_is_no_control(void)
{
    have(V4L2_CID_EXPOSURE_ABSOLUTE, 1, 5000, 100);
    have(V4L2_CID_ANALOGUE_GAIN, 5, 5, 5); /* of one value */
    controls[0].flags = V4L2_CTRL_FLAG_READ_ONLY;
    look();
    TEST_ASSERT_TRUE(!info.has_time && !info.has_gain);
    controls[0].flags = V4L2_CTRL_FLAG_DISABLED;
    look();
    TEST_ASSERT_FALSE(info.has_time);
    pf_v4l2_controls_set(&camera, false, 7, 7);
    TEST_ASSERT_EQUAL_UINT32(0, n_writes);
}

/* Which automatics were written, and as what; in the order of the calls. */
static void expect_writes(const int32_t (*expected)[2], uint32_t n)
{
    TEST_ASSERT_EQUAL_UINT32(n, n_writes);
    for (uint32_t i = 0; i < n; i++) {
        TEST_ASSERT_EQUAL_HEX32((uint32_t)expected[i][0], writes[i].id);
        TEST_ASSERT_EQUAL_INT32(expected[i][1], writes[i].value);
    }
    n_writes = 0;
}

static void test_automatics_go_off_once_and_on_when_asked(void)
{
    have(V4L2_CID_EXPOSURE_ABSOLUTE, 1, 5000, 100);
    have(V4L2_CID_EXPOSURE_AUTO, 1, 3, V4L2_EXPOSURE_APERTURE_PRIORITY); /* without "auto": its iris is fixed */
    have(V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0, 1, 1);
    have(V4L2_CID_AUTOGAIN, 0, 1, 1);
    look();
    pf_v4l2_controls_set(&camera, false, 200, 0);
    expect_writes((const int32_t[][2]){{V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_MANUAL},
                                       {V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0},
                                       {V4L2_CID_AUTOGAIN, 0},
                                       {V4L2_CID_EXPOSURE_ABSOLUTE, 200}},
                  4);
    pf_v4l2_controls_set(&camera, false, 300, 0);
    expect_writes((const int32_t[][2]){{V4L2_CID_EXPOSURE_ABSOLUTE, 300}}, 1);
    pf_v4l2_controls_set(&camera, true, 300, 0);
    TEST_ASSERT_EQUAL_INT64(V4L2_EXPOSURE_APERTURE_PRIORITY, find(V4L2_CID_EXPOSURE_AUTO)->value);
    TEST_ASSERT_EQUAL_INT64(0, find(V4L2_CID_EXPOSURE_AUTO_PRIORITY)->value);
    TEST_ASSERT_EQUAL_INT64(1, find(V4L2_CID_AUTOGAIN)->value);
    find(V4L2_CID_EXPOSURE_AUTO)->min = V4L2_EXPOSURE_AUTO; /* one with an iris */
    pf_v4l2_controls_set(&camera, true, 300, 0);
    TEST_ASSERT_EQUAL_INT64(V4L2_EXPOSURE_AUTO, find(V4L2_CID_EXPOSURE_AUTO)->value);
    pf_v4l2_controls_set(&camera, false, 400, 0);
    TEST_ASSERT_EQUAL_INT64(V4L2_EXPOSURE_MANUAL, find(V4L2_CID_EXPOSURE_AUTO)->value);
    look(); /* plugged in anew: all is as it was made */
    n_writes = 0;
    pf_v4l2_controls_set(&camera, false, 400, 0);
    TEST_ASSERT_EQUAL_UINT32(4, n_writes);
}

static void test_automatics_that_did_not_go_off_are_asked_again(void)
{
    have(V4L2_CID_EXPOSURE_ABSOLUTE, 1, 5000, 100);
    have(V4L2_CID_GAIN, 0, 255, 1);
    have(V4L2_CID_EXPOSURE_AUTO, 0, 3, V4L2_EXPOSURE_AUTO);
    have(V4L2_CID_AUTOGAIN, 0, 1, 1);
    look();
    find(V4L2_CID_EXPOSURE_AUTO)->refusals = 2;
    find(V4L2_CID_AUTOGAIN)->refusals = 1;
    for (int i = 0; i < 3; i++) {
        TEST_ASSERT_EQUAL_INT64(V4L2_EXPOSURE_AUTO, find(V4L2_CID_EXPOSURE_AUTO)->value);
        TEST_ASSERT_EQUAL_INT64(i < 2, find(V4L2_CID_AUTOGAIN)->value);
        n_writes = 0;
        pf_v4l2_controls_set(&camera, false, 200, 9);
    }
    TEST_ASSERT_EQUAL_INT64(V4L2_EXPOSURE_MANUAL, find(V4L2_CID_EXPOSURE_AUTO)->value);
    n_writes = 0;
    pf_v4l2_controls_set(&camera, false, 300, 9); /* no priority to set: one that is not there is not asked again */
    expect_writes((const int32_t[][2]){{V4L2_CID_EXPOSURE_ABSOLUTE, 300}, {V4L2_CID_GAIN, 9}}, 2);
}

static void test_what_is_to_stay_keeps_its_automatics(void)
{
    have(V4L2_CID_EXPOSURE_ABSOLUTE, 1, 5000, 100);
    have(V4L2_CID_GAIN, 0, 255, 1);
    have(V4L2_CID_EXPOSURE_AUTO, 0, 3, V4L2_EXPOSURE_AUTO);
    have(V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0, 1, 1);
    have(V4L2_CID_AUTOGAIN, 0, 1, 1);
    look();
    pf_v4l2_controls_set(&camera, false, PF_SESSION_AS_IS, PF_SESSION_AS_IS);
    TEST_ASSERT_EQUAL_UINT32(0, n_writes);
    pf_v4l2_controls_set(&camera, false, PF_SESSION_AS_IS, 9);
    expect_writes((const int32_t[][2]){{V4L2_CID_AUTOGAIN, 0}, {V4L2_CID_GAIN, 9}}, 2);
    pf_v4l2_controls_set(&camera, false, 200, PF_SESSION_AS_IS);
    expect_writes((const int32_t[][2]){{V4L2_CID_EXPOSURE_AUTO, V4L2_EXPOSURE_MANUAL},
                                       {V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0},
                                       {V4L2_CID_EXPOSURE_ABSOLUTE, 200}},
                  3);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_absolute_exposure_counts_100_us);
    RUN_TEST(test_exposure_in_lines_is_told_in_microseconds);
    RUN_TEST(test_analogue_gain_comes_before_digital);
    RUN_TEST(test_what_cannot_be_set_is_no_control);
    RUN_TEST(test_automatics_go_off_once_and_on_when_asked);
    RUN_TEST(test_automatics_that_did_not_go_off_are_asked_again);
    RUN_TEST(test_what_is_to_stay_keeps_its_automatics);
    return UNITY_END();
}
