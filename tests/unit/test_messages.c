/* The codec against an independent reader of the wire format: the tests name the fields by their numbers in
 * pipefish.proto. */
#include "message_samples.h"

void setUp(void) {}
void tearDown(void) {}

/* ---- checks of what several messages share */

static void check_telemetry(view t)
{
    TEST_ASSERT_EQUAL_HEX64(0xFEDCBA9876543210u, number(bytes(t, 1), 1));
    TEST_ASSERT_EQUAL_UINT64(123456789012u, number(bytes(t, 1), 2));
    TEST_ASSERT_EQUAL_INT64(-987654321, zigzag(number(t, 2)));
    TEST_ASSERT_EQUAL_FLOAT(0.25f, real32(t, 3));
    TEST_ASSERT_EQUAL_FLOAT(-0.5f, real32(t, 4));
    TEST_ASSERT_EQUAL_FLOAT(0.0625f, real32(t, 5));
    TEST_ASSERT_EQUAL_UINT64(8000, number(t, 6));
    TEST_ASSERT_EQUAL_FLOAT(2.5f, real32(t, 7));
    TEST_ASSERT_EQUAL_FLOAT(0.75f, real32(t, 8));
    TEST_ASSERT_EQUAL_UINT64(3, number(t, 9));
    TEST_ASSERT_EQUAL_UINT64(1, number(t, 10));
}

/* Of sample_tracking: field i is i, but for the states. */
static void check_tracking(view t)
{
    for (uint32_t i = 1; i <= 6; i++)
        TEST_ASSERT_EQUAL_UINT64(i == 2 || i == 5, number(t, i));
    for (uint32_t i = 7; i <= 22; i++)
        TEST_ASSERT_EQUAL_UINT64(i, number(t, i));
    static const uint8_t frames[PF_SCENE_FLAGS] = {0, 3, 0, 0, 0, 0, 5}; /* packed varints */
    TEST_ASSERT_EQUAL_size_t(sizeof frames, bytes(t, 24).n);
    TEST_ASSERT_EQUAL_MEMORY(frames, bytes(t, 24).data, sizeof frames);
}

static void check_status(view s)
{
    static const uint32_t plain[][2] = {{4, 1000}, {5, 2}, {7, 400}, {8, 5}, {9, 6}, {10, 70}, {11, 8}, {17, 99}};
    TEST_ASSERT_EQUAL_UINT64(8, number(bytes(s, 1), 2));
    TEST_ASSERT_EQUAL_MEMORY(survey_id, bytes(s, 2).data, 16);
    check_text("surveying", bytes(s, 3));
    for (size_t i = 0; i < sizeof plain / sizeof plain[0]; i++)
        TEST_ASSERT_EQUAL_UINT64(plain[i][1], number(s, plain[i][0]));
    TEST_ASSERT_EQUAL_DOUBLE(29.5, real64(s, 12));
    for (uint32_t i = 1; i <= 7; i++)
        TEST_ASSERT_EQUAL_FLOAT((float)i, real32(bytes(s, 13), i));
    for (uint32_t i = 1; i <= 6; i++)
        TEST_ASSERT_EQUAL_UINT64(i == 5 ? 0 : 10 + i, number(bytes(s, 14), i));
    TEST_ASSERT_EQUAL_UINT64(1, number(bytes(s, 15), 1));
    for (uint32_t i = 2; i <= 12; i++)
        TEST_ASSERT_EQUAL_UINT64(19 + i, number(bytes(s, 15), i));
    check_telemetry(bytes(s, 16));
    check_tracking(bytes(s, 20));
    TEST_ASSERT_EQUAL_INT64(-123456789, zigzag(number(bytes(s, 18), 2)));
    TEST_ASSERT_EQUAL_UINT64(1000, number(bytes(s, 18), 3));
    check_text("Anna", bytes(bytes(s, 30), 1));
    check_text("viewer", bytes(bytes(s, 30), 2));
    for (uint32_t i = 3; i <= 9; i++)
        TEST_ASSERT_EQUAL_UINT64(i, number(bytes(s, 30), i));
}

static pf_msg_profile sample_profile(void)
{
    pf_msg_profile p = {.name = "Kanal 7", .serial = "S1", .crc32c = 0xDEADBEEF, .is_trial = true, .starts_left = 3};
    for (uint8_t i = 0; i < 32; i++)
        p.sha256[i] = (uint8_t)(200 + i);
    return p;
}

static void check_profile(view p)
{
    pf_msg_profile expected = sample_profile();
    check_text("Kanal 7", bytes(p, 1));
    check_text("S1", bytes(p, 2));
    TEST_ASSERT_EQUAL_size_t(32, bytes(p, 3).n);
    TEST_ASSERT_EQUAL_MEMORY(expected.sha256, bytes(p, 3).data, 32);
    TEST_ASSERT_EQUAL_HEX64(0xDEADBEEF, number(p, 4));
    TEST_ASSERT_EQUAL_UINT64(1, number(p, 5));
    TEST_ASSERT_EQUAL_UINT64(3, number(p, 6));
}

/* ---- tests */

/* Proves: every field of a keyframe arrives; the observations are nine packed arrays of one length, ids as differences,
 * lost tracks left out. */
static void test_keyframe_round_trip(void)
{
    pf_track tracks[TRACKS];
    uint8_t out[1024];
    size_t n = 0;
    pf_msg_keyframe k;
    view m, o, column[10];
    uint64_t id = 0;
    uint32_t items = 0;
    sample_tracks(tracks);
    k = sample_keyframe(tracks);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_keyframe(&k, out, sizeof out, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_msg_append_break("restart", out, n + 10, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_append_break("restart", out, n + 11, &n));
    m = (view){out, n};
    check_tracking(bytes(m, 17));
    TEST_ASSERT_EQUAL_MEMORY(survey_id, bytes(m, 1).data, 16);
    TEST_ASSERT_EQUAL_UINT64(12, number(m, 2));
    TEST_ASSERT_EQUAL_UINT64(7, number(bytes(m, 3), 1));
    TEST_ASSERT_EQUAL_UINT64(8000, number(bytes(m, 3), 2));
    TEST_ASSERT_EQUAL_UINT64(300, number(m, 4));
    TEST_ASSERT_EQUAL_size_t(32, bytes(m, 5).n);
    TEST_ASSERT_EACH_EQUAL_HEX8(0xAB, bytes(m, 5).data, 32);
    TEST_ASSERT_EQUAL_UINT64(1280, number(m, 6));
    TEST_ASSERT_EQUAL_UINT64(800, number(m, 7));
    TEST_ASSERT_EQUAL_size_t(sizeof jpeg, bytes(m, 8).n);
    TEST_ASSERT_EQUAL_MEMORY(jpeg, bytes(m, 8).data, sizeof jpeg);
    TEST_ASSERT_EQUAL_UINT64(90, number(m, 9));
    TEST_ASSERT_EQUAL_UINT64(3, number(m, 10));
    check_telemetry(bytes(m, 11));
    o = bytes(m, 12);
    TEST_ASSERT_EQUAL_UINT64(44, number(m, 13));
    TEST_ASSERT_EQUAL_UINT64(1, number(m, 14));
    check_text("restart", bytes(m, 15));
    TEST_ASSERT_EQUAL_UINT64(3600000000000u, number(m, 16));
    for (uint32_t i = 1; i <= 9; i++)
        column[i] = bytes(o, i);
    for (int i = 0; i < TRACKS; i++) {
        const pf_track *t = &tracks[i];
        if (t->status == PF_TRACK_LOST)
            continue;
        items++;
        id += varint(&column[1]);
        TEST_ASSERT_EQUAL_UINT64(t->id, id);
        TEST_ASSERT_EQUAL_INT64(t->pos.x, zigzag(varint(&column[2])));
        TEST_ASSERT_EQUAL_INT64(t->pos.y, zigzag(varint(&column[3])));
        TEST_ASSERT_EQUAL_UINT64(t->cov_xx_q20, varint(&column[4]));
        TEST_ASSERT_EQUAL_INT64(t->cov_xy_q20, zigzag(varint(&column[5])));
        TEST_ASSERT_EQUAL_UINT64(t->cov_yy_q20, varint(&column[6]));
        TEST_ASSERT_EQUAL_UINT64(t->age, varint(&column[7]));
        TEST_ASSERT_EQUAL_UINT64(t->quality, varint(&column[8]));
        TEST_ASSERT_EQUAL_UINT64(t->status, varint(&column[9]));
    }
    TEST_ASSERT_EQUAL_UINT32(TRACKS - 1, items);
    for (uint32_t i = 1; i <= 9; i++)
        TEST_ASSERT_EQUAL_size_t(0, column[i].n);
}

/* Proves: what was not measured is absent, not zero. */
static void test_unmeasured_telemetry_is_absent(void)
{
    pf_track tracks[TRACKS];
    uint8_t out[1024];
    size_t n = 0;
    pf_msg_keyframe k;
    view t;
    sample_tracks(tracks);
    k = sample_keyframe(tracks);
    k.telemetry = (pf_msg_telemetry){.time = {1, 2}, .has_attitude = true};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_keyframe(&k, out, sizeof out, &n));
    t = bytes((view){out, n}, 11);
    TEST_ASSERT_TRUE(has(t, 3));
    TEST_ASSERT_TRUE(has(t, 4));
    TEST_ASSERT_FALSE(has(t, 2));
    for (uint32_t field = 5; field <= 10; field++)
        TEST_ASSERT_FALSE(has(t, field));
    TEST_ASSERT_FALSE(has((view){out, n}, 14));
    TEST_ASSERT_FALSE(has((view){out, n}, 15));
}

static void test_survey_start_round_trip(void)
{
    uint8_t out[1024];
    size_t n = 0;
    pf_msg_survey_start s = sample_start();
    view m, last;
    uint64_t value;
    uint32_t count;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_survey_start(&s, out, sizeof out, &n));
    m = (view){out, n};
    TEST_ASSERT_EQUAL_MEMORY(survey_id, bytes(m, 1).data, 16);
    TEST_ASSERT_EQUAL_UINT64(9, number(bytes(m, 2), 2));
    check_text("\xC3\x96l", bytes(m, 3));
    check_text("pipefishd 0.1.0", bytes(m, 4));
    TEST_ASSERT_EQUAL_size_t(sizeof profile, bytes(m, 5).n);
    TEST_ASSERT_EQUAL_MEMORY(profile, bytes(m, 5).data, sizeof profile);
    TEST_ASSERT_EQUAL_DOUBLE(0.0001, real64(bytes(m, 6), 1));
    TEST_ASSERT_EQUAL_DOUBLE(1e-6, real64(bytes(m, 6), 2));
    TEST_ASSERT_EQUAL_DOUBLE(0.005, real64(bytes(m, 6), 3));
    TEST_ASSERT_EQUAL_UINT64(640, number(m, 7));
    TEST_ASSERT_EQUAL_UINT64(480, number(m, 8));
    TEST_ASSERT_EQUAL_DOUBLE(29.97, real64(m, 9));
    check_text("replay x.y4m", bytes(m, 10));
    TEST_ASSERT_EQUAL_DOUBLE(0.3, real64(m, 11));
    TEST_ASSERT_TRUE(find(m, 12, &value, &last, &count));
    TEST_ASSERT_EQUAL_UINT32(3, count);
    check_text(config[2], last);
    TEST_ASSERT_EACH_EQUAL_HEX8(0xCD, bytes(m, 13).data, 32);
    s.profile = NULL;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_survey_start(&s, out, sizeof out, &n));
    TEST_ASSERT_FALSE(has((view){out, n}, 5));
}

static void test_survey_end_status_and_preview_round_trip(void)
{
    uint8_t out[2048];
    size_t n = 0;
    pf_msg_status status = sample_status();
    pf_msg_survey_end e = sample_end(&status);
    pf_msg_preview p = {
        .time = {7, 11}, .frame_sequence = 5, .width = 80, .height = 60, .jpeg = jpeg, .jpeg_size = sizeof jpeg};
    view m, packed;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_status(&status, out, sizeof out, &n));
    check_status((view){out, n});

    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_survey_end(&e, out, sizeof out, &n));
    m = (view){out, n};
    TEST_ASSERT_EQUAL_MEMORY(survey_id, bytes(m, 1).data, 16);
    TEST_ASSERT_EQUAL_UINT64(10, number(bytes(m, 2), 2));
    TEST_ASSERT_EQUAL_UINT64(99, number(m, 3));
    TEST_ASSERT_EQUAL_UINT64(1234567890123u, number(m, 4));
    TEST_ASSERT_EQUAL_UINT64(2, number(m, 5));
    check_text("terminated", bytes(m, 6));
    check_status(bytes(m, 7));
    packed = bytes(m, 8);
    for (int i = 0; i < 3; i++)
        TEST_ASSERT_EQUAL_UINT64(lost_first[i], varint(&packed));
    TEST_ASSERT_EQUAL_size_t(0, packed.n);
    packed = bytes(m, 9);
    for (int i = 0; i < 3; i++)
        TEST_ASSERT_EQUAL_UINT64(lost_count[i], varint(&packed));
    TEST_ASSERT_EQUAL_size_t(0, packed.n);

    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_preview(&p, out, sizeof out, &n));
    m = (view){out, n};
    TEST_ASSERT_EQUAL_UINT64(11, number(bytes(m, 1), 2));
    TEST_ASSERT_EQUAL_UINT64(5, number(m, 2));
    TEST_ASSERT_EQUAL_UINT64(80, number(m, 3));
    TEST_ASSERT_EQUAL_UINT64(60, number(m, 4));
    TEST_ASSERT_EQUAL_MEMORY(jpeg, bytes(m, 5).data, sizeof jpeg);
}

/* Proves: a raw frame's pixels come without what the stride puts between the rows, and within the bound stated. */
static void test_raw_frame_round_trip(void)
{
    static const uint8_t pixels[] = {1, 2, 3, 99, 4, 5, 6, 99}, packed[] = {1, 2, 3, 4, 5, 6};
    uint8_t out[PF_MSG_RAW_FRAME_MAX(6)];
    size_t n = 0;
    pf_msg_raw_frame f = {.time = {UINT64_MAX, UINT64_MAX},
                          .frame_sequence = UINT64_MAX,
                          .image = {pixels, 3, 2, 4},
                          .telemetry = sample_status().telemetry};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_raw_frame(&f, out, sizeof out, &n));
    const view m = {out, n};
    TEST_ASSERT_EQUAL_UINT64(UINT64_MAX, number(bytes(m, 1), 2));
    TEST_ASSERT_EQUAL_UINT64(UINT64_MAX, number(m, 2));
    TEST_ASSERT_EQUAL_UINT64(3, number(m, 3));
    TEST_ASSERT_EQUAL_UINT64(2, number(m, 4));
    check_text("mono8", bytes(m, 5));
    TEST_ASSERT_EQUAL_size_t(sizeof packed, bytes(m, 6).n);
    TEST_ASSERT_EQUAL_MEMORY(packed, bytes(m, 6).data, sizeof packed);
    TEST_ASSERT_TRUE(has(m, 7));
    for (size_t capacity = 0; capacity < n; capacity++) {
        size_t unused;
        TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_msg_encode_raw_frame(&f, out, capacity, &unused));
    }
}

static void test_reply_round_trip(void)
{
    uint8_t out[1024];
    size_t n = 0;
    pf_msg_status status = sample_status();
    pf_msg_info info = {.software = "pipefishd 0.1.0", .source = "replay", .boot_id = 5, .schema = PF_SCHEMA_VERSION};
    pf_msg_reply reply = {.id = 77, .error = "", .status = &status};
    view m;
    memcpy(info.survey_id, survey_id, 16);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_reply(&reply, out, sizeof out, &n));
    m = (view){out, n};
    TEST_ASSERT_EQUAL_UINT64(77, number(m, 1));
    TEST_ASSERT_EQUAL_size_t(0, bytes(m, 2).n);
    check_status(bytes(m, 3));
    TEST_ASSERT_FALSE(has(m, 4));

    reply = (pf_msg_reply){.id = 78, .error = "no", .info = &info};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_reply(&reply, out, sizeof out, &n));
    m = (view){out, n};
    check_text("no", bytes(m, 2));
    check_text("pipefishd 0.1.0", bytes(bytes(m, 4), 1));
    TEST_ASSERT_EQUAL_UINT64(5, number(bytes(m, 4), 2));
    TEST_ASSERT_EQUAL_UINT64(PF_SCHEMA_VERSION, number(bytes(m, 4), 3));
    TEST_ASSERT_EQUAL_MEMORY(survey_id, bytes(bytes(m, 4), 4).data, 16);
    check_text("replay", bytes(bytes(m, 4), 5));
    reply.status = &status;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_msg_encode_reply(&reply, out, sizeof out, &n));

    pf_msg_profile_state state = {.has_stored = true,
                                  .in_use = sample_profile(),
                                  .stored = sample_profile(),
                                  .problem = "self_test: no",
                                  .slot_erases = {5, 6}};
    reply = (pf_msg_reply){.id = 79, .error = "", .profile = &state};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_reply(&reply, out, sizeof out, &n));
    m = bytes((view){out, n}, 5);
    TEST_ASSERT_FALSE(has(m, 1));
    check_profile(bytes(m, 2));
    check_text("self_test: no", bytes(m, 3));
    TEST_ASSERT_EQUAL_UINT64(5, number(m, 4));
    TEST_ASSERT_EQUAL_UINT64(6, number(m, 5));
    reply.info = &info;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_msg_encode_reply(&reply, out, sizeof out, &n));

    reply = (pf_msg_reply){.id = 80, .error = "", .paired_key = state.stored.sha256};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_reply(&reply, out, sizeof out, &n));
    TEST_ASSERT_EQUAL_MEMORY(state.stored.sha256, bytes(bytes((view){out, n}, 20), 1).data, 32);

    status.has_profile = true;
    status.profile = sample_profile();
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_status(&status, out, sizeof out, &n));
    check_profile(bytes((view){out, n}, 19));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_keyframe_round_trip);
    RUN_TEST(test_unmeasured_telemetry_is_absent);
    RUN_TEST(test_survey_start_round_trip);
    RUN_TEST(test_survey_end_status_and_preview_round_trip);
    RUN_TEST(test_raw_frame_round_trip);
    RUN_TEST(test_reply_round_trip);
    return UNITY_END();
}
