/* The codec against an independent reader of the wire format: the tests name the fields by their numbers in
 * pipefish.proto. */
#include "pipefish/messages.h"

#include <string.h>

#include "unity.h"
#include "wire.h"

void setUp(void) {}
void tearDown(void) {}

/* ---- samples */

static const uint8_t survey_id[16] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};

static pf_msg_telemetry sample_telemetry(void)
{
    return (pf_msg_telemetry){.time = {0xFEDCBA9876543210u, 123456789012u},
                              .has_encoder = true,
                              .has_attitude = true,
                              .has_exposure = true,
                              .has_gain = true,
                              .has_lamp = true,
                              .encoder_count = -987654321,
                              .encoder_missed = 3,
                              .roll_rad = 0.25f,
                              .pitch_rad = -0.5f,
                              .attitude_sigma_rad = 0.0625f,
                              .exposure_us = 8000,
                              .gain = 2.5f,
                              .lamp = 0.75f,
                              .emergency_stop = true};
}

static pf_msg_tracking sample_tracking(void)
{
    pf_msg_tracking t = {.scene = PF_SCENE_REVERSING | PF_SCENE_OVEREXPOSED,
                         .frames = 7,
                         .tracked = 8,
                         .detected = 9,
                         .age_median = 20,
                         .quality_median = 21,
                         .static_blocks = 22};
    for (uint32_t i = 1; i < PF_TRACK_REASONS; i++)
        t.lost_by[i] = 9 + i;
    t.state_frames[1] = 3;
    t.state_frames[6] = 5;
    return t;
}

static pf_msg_status sample_status(void)
{
    pf_msg_status s = {.time = {7, 8},
                       .state = "surveying",
                       .frames = 1000,
                       .frames_dropped = 2,
                       .tracks_live = 400,
                       .tracks_new = 5,
                       .tracks_lost = 6,
                       .keyframes = 70,
                       .keyframes_dropped = 8,
                       .fps = 29.5,
                       .stage = {1, 2, 3, 4, 5, 6, 7},
                       .spool = {11, 12, 13, 14, 16, 17, true},
                       .link_up = true,
                       .telemetry = sample_telemetry(),
                       .uptime_ns = 99,
                       .has_clock = true,
                       .clock = {7, -123456789, 1000},
                       .has_network = true,
                       .network = {"Anna", "viewer", 3, 4, 5, 6, 7, 8, 9},
                       .tracking = sample_tracking()};
    s.link.bytes_out = 21;
    s.link.bytes_in = 22;
    s.link.frames_out = 23;
    s.link.frames_in = 24;
    s.link.crc_errors = 25;
    s.link.fragments_sent = 26;
    s.link.fragments_resent = 27;
    s.link.objects_sent = 28;
    s.link.sessions = 29;
    s.link.rtt_us = 30;
    s.link.malformed = 31;
    memcpy(s.survey_id, survey_id, 16);
    return s;
}

#define TRACKS 6

static void sample_tracks(pf_track tracks[TRACKS])
{
    for (int i = 0; i < TRACKS; i++)
        tracks[i] = (pf_track){.id = 10 + 3 * (uint64_t)i,
                               .pos = {i * 65536 - 70000, 1000 * i},
                               .cov_xx_q20 = 256u + (uint32_t)i,
                               .cov_yy_q20 = 4294967295u - (uint32_t)i,
                               .cov_xy_q20 = -i,
                               .age = (uint32_t)(TRACKS - i),
                               .status = i == TRACKS - 1 ? PF_TRACK_NEW : PF_TRACK_TRACKED,
                               .quality = (uint16_t)(32767 - i)};
    tracks[2].status = PF_TRACK_LOST;
}

static const uint8_t jpeg[] = {0xFF, 0xD8, 0, 1, 2, 0xFF, 0xD9};

static pf_msg_keyframe sample_keyframe(const pf_track *tracks)
{
    pf_msg_keyframe k = {.index = 12,
                         .time = {7, 8000},
                         .frame_sequence = 300,
                         .recorded_ns = 3600000000000u,
                         .width = 1280,
                         .height = 800,
                         .jpeg = jpeg,
                         .jpeg_size = sizeof jpeg,
                         .jpeg_quality = 90,
                         .cause = PF_KEYFRAME_PARALLAX,
                         .telemetry = sample_telemetry(),
                         .tracks = tracks,
                         .n_tracks = TRACKS,
                         .common_tracks = 44,
                         .tracking = sample_tracking()};
    memcpy(k.survey_id, survey_id, 16);
    memset(k.frame_sha256, 0xAB, 32);
    return k;
}

static const char *const config[] = {"tracker.levels = 4", "link.port = 7447", "survey.name = \xC3\x96l"};
static const uint8_t profile[] = {9, 8, 7, 0, 6};

static pf_msg_survey_start sample_start(void)
{
    pf_msg_survey_start s = {.time = {7, 9},
                             .name = "\xC3\x96l",
                             .software = "pipefishd 0.1.0",
                             .source = "replay x.y4m",
                             .profile = profile,
                             .profile_size = sizeof profile,
                             .metres_per_count = 0.0001,
                             .metres_per_count_sigma = 1e-6,
                             .noise_m_per_sqrt_m = 0.005,
                             .width = 640,
                             .height = 480,
                             .frame_rate = 29.97,
                             .nominal_diameter_m = 0.3,
                             .config = config,
                             .config_count = 3};
    memcpy(s.survey_id, survey_id, 16);
    memset(s.tracker_config_sha256, 0xCD, 32);
    return s;
}

static const uint32_t lost_first[] = {3, 300, 4294967295u}, lost_count[] = {290, 1, 1};

static pf_msg_survey_end sample_end(const pf_msg_status *status)
{
    pf_msg_survey_end e = {.time = {7, 10},
                           .keyframes = 99,
                           .boots = 2,
                           .frames = 1234567890123u,
                           .reason = "terminated",
                           .last_status = status,
                           .lost_first = lost_first,
                           .lost_count = lost_count,
                           .lost_ranges = 3};
    memcpy(e.survey_id, survey_id, 16);
    return e;
}

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

/* Proves: a status and the state of the profiles at their largest fit a control message and a latest message of the
 * link's limits (1000 bytes). */
static void test_largest_status_fits_a_control_message(void)
{
    char name[64] = "", problem[192] = "";
    uint8_t out[1000];
    size_t n = 0;
    pf_msg_status s;
    pf_msg_reply reply = {.id = UINT32_MAX, .error = "", .status = &s};
    memset(&s, 0x7F, sizeof s); /* counters of 63 bits: 292 years of nanoseconds */
    s.spool.is_failing = true;
    s.telemetry.limit_front = s.telemetry.limit_rear = true;
    s.state = "surveying";
    s.link_up = s.has_clock = s.telemetry.has_encoder = s.telemetry.has_attitude = s.telemetry.has_exposure = true;
    s.telemetry.has_gain = s.telemetry.has_lamp = s.telemetry.emergency_stop = true;
    s.telemetry.attitude_sigma_rad = 1.0f;
    memset(name, 'x', sizeof name - 1);
    memset(problem, 'x', sizeof problem - 1);
    s.has_profile = s.profile.is_trial = true;
    s.profile.name = s.profile.serial = name;
    s.has_network = true;
    s.network.peer = name + sizeof name - 48; /* as long as a host's name may be */
    s.network.role = "calibrator";
    s.visitors = 3;
    s.looking_on = PF_LOOKING_VIEWER;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_reply(&reply, out, sizeof out, &n));

    pf_msg_profile_state state = {true, true, s.profile, s.profile, problem, {UINT32_MAX, UINT32_MAX}};
    reply = (pf_msg_reply){.id = UINT32_MAX, .error = problem, .profile = &state};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_reply(&reply, out, sizeof out, &n));
}

typedef pf_status (*encoder)(const void *message, uint8_t *out, size_t capacity, size_t *n);
static pf_status as_keyframe(const void *m, uint8_t *o, size_t c, size_t *n)
{
    return pf_msg_encode_keyframe(m, o, c, n);
}
static pf_status as_start(const void *m, uint8_t *o, size_t c, size_t *n)
{
    return pf_msg_encode_survey_start(m, o, c, n);
}
static pf_status as_end(const void *m, uint8_t *o, size_t c, size_t *n)
{
    return pf_msg_encode_survey_end(m, o, c, n);
}
static pf_status as_status(const void *m, uint8_t *o, size_t c, size_t *n)
{
    return pf_msg_encode_status(m, o, c, n);
}
static pf_status as_reply(const void *m, uint8_t *o, size_t c, size_t *n)
{
    return pf_msg_encode_reply(m, o, c, n);
}

/* Proves: at every capacity below the message's size the answer is PF_ERR_SPACE, nothing is written behind it, and *n
 * is untouched; at the size itself it fits. */
static void test_too_small_a_buffer_is_an_error_at_every_size(void)
{
    pf_track tracks[TRACKS];
    pf_msg_status status = sample_status();
    pf_msg_keyframe k;
    pf_msg_survey_start s = sample_start();
    pf_msg_survey_end e = sample_end(&status);
    pf_msg_reply r = {.id = 1, .error = "", .status = &status};
    const struct {
        encoder encode;
        const void *message;
    } cases[] = {{as_keyframe, &k}, {as_start, &s}, {as_end, &e}, {as_status, &status}, {as_reply, &r}};
    sample_tracks(tracks);
    k = sample_keyframe(tracks);
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        uint8_t out[2048];
        size_t size = 0;
        TEST_ASSERT_EQUAL_INT(PF_OK, cases[i].encode(cases[i].message, out, sizeof out, &size));
        for (size_t capacity = 0; capacity <= size; capacity++) {
            size_t n = 12345;
            memset(out, 0x5A, sizeof out);
            TEST_ASSERT_EQUAL_INT(capacity < size ? PF_ERR_SPACE : PF_OK,
                                  cases[i].encode(cases[i].message, out, capacity, &n));
            TEST_ASSERT_EQUAL_size_t(capacity < size ? 12345 : size, n);
            TEST_ASSERT_EACH_EQUAL_HEX8(0x5A, out + capacity, sizeof out - capacity);
        }
    }
}

/* Proves: PF_MSG_KEYFRAME_MAX is an upper bound where every number takes its most bytes. */
static void test_keyframe_bound_holds_for_the_largest_numbers(void)
{
    static pf_track tracks[PF_TRACKS_MAX];
    static uint8_t out[PF_MSG_KEYFRAME_MAX(PF_TRACKS_MAX, sizeof jpeg)];
    char reason[257];
    size_t n = 0;
    pf_msg_keyframe k;
    memset(tracks, 0xFF, sizeof tracks);
    for (uint32_t i = 0; i < PF_TRACKS_MAX; i++) {
        tracks[i].id = UINT64_MAX / PF_TRACKS_MAX * (i + 1); /* differences of 8 bytes */
        tracks[i].pos = (pf_point_q16){INT32_MIN, INT32_MIN};
        tracks[i].cov_xy_q20 = INT32_MIN;
        tracks[i].status = PF_TRACK_TRACKED;
    }
    tracks[0].id = 1;
    memset(reason, 'x', sizeof reason);
    reason[256] = '\0';
    k = sample_keyframe(tracks);
    k.n_tracks = PF_TRACKS_MAX;
    k.index = k.width = k.height = k.jpeg_quality = k.common_tracks = UINT32_MAX;
    k.frame_sequence = k.recorded_ns = k.time.monotonic_ns = UINT64_MAX;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_keyframe(&k, out, sizeof out, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_append_break(reason, out, sizeof out, &n));
    TEST_ASSERT_GREATER_THAN_size_t(sizeof out * 9 / 10, n);
}

/* Proves: of a keyframe that is damaged behind its first bytes it is still known which one it was, of any index; of one
 * cut there it is not; and a survey's end that is told of it names it, after those that it named. */
static void test_a_damaged_keyframe_is_known_and_named(void)
{
    static const uint32_t indices[] = {0, 1, 300, UINT32_MAX};
    const uint32_t first[] = {3}, count[] = {2};
    uint8_t out[512], id[16];
    size_t n = 0;
    pf_msg_keyframe k = sample_keyframe(NULL);
    pf_msg_survey_end e = {.keyframes = 9, .lost_first = first, .lost_count = count, .lost_ranges = 1};
    k.n_tracks = 0;
    for (size_t i = 0; i < sizeof indices / sizeof indices[0]; i++) {
        uint32_t index = 7;
        k.index = indices[i];
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_keyframe(&k, out, sizeof out, &n));
        memset(out + 25, 0xFF, n - 25);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_peek_keyframe(out, n, id, &index));
        TEST_ASSERT_EQUAL_MEMORY(k.survey_id, id, 16);
        TEST_ASSERT_EQUAL_UINT32(indices[i], index);
        TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_msg_peek_keyframe(out, 18, id, &index));
        TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_msg_peek_keyframe(out, 17, id, &index));
        out[0] ^= 0x10;
        TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_msg_peek_keyframe(out, n, id, &index));
    }
    memcpy(e.survey_id, survey_id, sizeof e.survey_id);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_encode_survey_end(&e, out, sizeof out, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_msg_append_lost(300, out, n + 4, &n));
    const size_t before = n;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_append_lost(300, out, sizeof out, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_peek_survey_end(out, n, id));
    TEST_ASSERT_EQUAL_MEMORY(survey_id, id, 16);
    static const uint8_t added[] = {8 << 3, 0xAC, 0x02, 9 << 3, 1};
    TEST_ASSERT_EQUAL_size_t(before + sizeof added, n);
    TEST_ASSERT_EQUAL_MEMORY(added, out + before, sizeof added);
}

static void test_keyframe_refuses_tables_that_are_none(void)
{
    pf_track tracks[TRACKS];
    uint8_t out[1024];
    size_t n;
    pf_msg_keyframe k;
    sample_tracks(tracks);
    k = sample_keyframe(tracks);
    tracks[4].id = tracks[3].id;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_msg_encode_keyframe(&k, out, sizeof out, &n));
    k.n_tracks = 2 * PF_TRACKS_MAX + 1;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_msg_encode_keyframe(&k, out, sizeof out, &n));
}

/* Requests as protobuf writes them, byte by byte. */
static void test_requests_are_decoded(void)
{
    static const uint8_t lamp[] = {0x08, 0x96, 0x01, 0x2D, 0x00, 0x00, 0x00, 0x3F}; /* id 150, set_lamp 0.5 */
    static const uint8_t clock[] = {0x08, 0x01, 0x32, 0x0D, 0x09, 1, 2, 3, 4, 5, 6, 7, 8, 0x10, 0x09, 0x18, 0x07};
    static const uint8_t nothing[][4] = {{0x08, 2, 0x12, 0}, {0x08, 2, 0x1A, 0}, {0x08, 2, 0x22, 0}, {0x08, 2, 0x3A, 0},
                                         {0x08, 2, 0x42, 0}, {0x08, 2, 0x52, 0}, {0x08, 2, 0x5A, 0}};
    static const pf_request_what what[] = {PF_REQUEST_GET_STATUS, PF_REQUEST_GET_INFO,    PF_REQUEST_STOP_SURVEY,
                                           PF_REQUEST_SHUTDOWN,   PF_REQUEST_GET_PROFILE, PF_REQUEST_REVERT_PROFILE,
                                           PF_REQUEST_GET_STILL};
    uint8_t confirm[36] = {0x08, 3, 0x4A, 32}, sha256[32];
    static const uint8_t newer[] = {0x08, 0x05, 0xA2, 0x06, 0x01, 0x61}; /* id 5, unknown field 100 */
    pf_msg_request r;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_decode_request(lamp, sizeof lamp, &r));
    TEST_ASSERT_EQUAL_UINT32(150, r.id);
    TEST_ASSERT_EQUAL_INT(PF_REQUEST_SET_LAMP, r.what);
    TEST_ASSERT_EQUAL_FLOAT(0.5f, r.lamp);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_decode_request(clock, sizeof clock, &r));
    TEST_ASSERT_EQUAL_INT(PF_REQUEST_CLOCK_SYNC, r.what);
    TEST_ASSERT_EQUAL_HEX64(0x0807060504030201u, r.clock.boot_id);
    TEST_ASSERT_EQUAL_INT64(-5, r.clock.offset_ns);
    TEST_ASSERT_EQUAL_UINT64(7, r.clock.error_ns);
    for (size_t i = 0; i < 7; i++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_decode_request(nothing[i], 4, &r));
        TEST_ASSERT_EQUAL_INT(what[i], r.what);
    }
    memset(sha256, 0xA5, sizeof sha256);
    memcpy(confirm + 4, sha256, sizeof sha256);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_decode_request(confirm, sizeof confirm, &r));
    TEST_ASSERT_EQUAL_INT(PF_REQUEST_CONFIRM_PROFILE, r.what);
    TEST_ASSERT_EQUAL_MEMORY(sha256, r.profile_sha256, sizeof sha256);
    uint8_t pair[64] = {0x08, 4, 0xA2, 0x01, 50, 0x0A, 32}; /* field 20 of 50 bytes */
    memcpy(pair + 7, sha256, sizeof sha256);
    memcpy(pair + 39, "\x12\x06viewer\x1A\x06laptop", 16);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_decode_request(pair, 55, &r));
    TEST_ASSERT_EQUAL_INT(PF_REQUEST_PAIR, r.what);
    TEST_ASSERT_EQUAL_MEMORY(sha256, r.pair.key, sizeof sha256);
    TEST_ASSERT_EQUAL_STRING("viewer", r.pair.role);
    TEST_ASSERT_EQUAL_STRING("laptop", r.pair.name);
    confirm[3] = 31; /* not a SHA-256 */
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_msg_decode_request(confirm, sizeof confirm - 1, &r));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_msg_decode_request(newer, sizeof newer, &r));
    TEST_ASSERT_EQUAL_UINT32(5, r.id);
    TEST_ASSERT_EQUAL_INT(PF_REQUEST_UNKNOWN, r.what);
}

/* Proves: a request cut off anywhere is an error that leaves the result alone, or a shorter valid request. */
static void test_truncated_requests_are_errors(void)
{
    static const uint8_t clock[] = {0x08, 0x01, 0x32, 0x0D, 0x09, 1, 2, 3, 4, 5, 6, 7, 8, 0x10, 0x09, 0x18, 0x07};
    for (size_t n = 0; n < sizeof clock; n++) {
        pf_msg_request r = {.id = 99};
        pf_status status = pf_msg_decode_request(clock, n, &r);
        if (n == 0 || n == 2) { /* between two fields */
            TEST_ASSERT_EQUAL_INT(PF_OK, status);
            TEST_ASSERT_EQUAL_INT(PF_REQUEST_UNKNOWN, r.what);
        } else {
            TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, status);
            TEST_ASSERT_EQUAL_UINT32(99, r.id);
        }
    }
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
    RUN_TEST(test_largest_status_fits_a_control_message);
    RUN_TEST(test_too_small_a_buffer_is_an_error_at_every_size);
    RUN_TEST(test_keyframe_bound_holds_for_the_largest_numbers);
    RUN_TEST(test_keyframe_refuses_tables_that_are_none);
    RUN_TEST(test_a_damaged_keyframe_is_known_and_named);
    RUN_TEST(test_requests_are_decoded);
    RUN_TEST(test_truncated_requests_are_errors);
    return UNITY_END();
}
