/* The codec at its limits: buffers that are too small, numbers that are too large, bytes that are damaged, requests as
 * anybody may send them. */
#include "message_samples.h"

void setUp(void) {}
void tearDown(void) {}

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
        tracks[i].settled_x_q8 = tracks[i].settled_y_q8 = INT16_MIN;
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
    RUN_TEST(test_largest_status_fits_a_control_message);
    RUN_TEST(test_too_small_a_buffer_is_an_error_at_every_size);
    RUN_TEST(test_keyframe_bound_holds_for_the_largest_numbers);
    RUN_TEST(test_keyframe_refuses_tables_that_are_none);
    RUN_TEST(test_a_damaged_keyframe_is_known_and_named);
    RUN_TEST(test_requests_are_decoded);
    RUN_TEST(test_truncated_requests_are_errors);
    return UNITY_END();
}
