/* The link's rules one by one: configuration, session, bytes, the examples of SPEC.md. Bulk and latest:
 * test_link_bulk.c; behaviour on bad lines: test_link_channel.c. */
#include "link_pair.h"
#include "unity.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* ---- configuration ---- */

static void test_init_refuses_what_is_out_of_range(void)
{
    static const struct {
        size_t offset;
        uint32_t value;
    } bad[] = {
        {offsetof(pf_link_config, role), 0},
        {offsetof(pf_link_config, role), 3},
        {offsetof(pf_link_config, nonce), 0},
        {offsetof(pf_link_config, max_fragment), 63},
        {offsetof(pf_link_config, max_fragment), 1025},
        {offsetof(pf_link_config, send_slots), 17},
        {offsetof(pf_link_config, receive_slots), 17},
        {offsetof(pf_link_config, max_object), 0},
        {offsetof(pf_link_config, max_object), 65535u * 1024 + 1},
        {offsetof(pf_link_config, max_latest), (1u << 20) + 1},
        {offsetof(pf_link_config, max_control), 15},
        {offsetof(pf_link_config, max_control), 1001},
        {offsetof(pf_link_config, control_queue), 65},
        {offsetof(pf_link_config, window), 1023},
        {offsetof(pf_link_config, window), (1u << 24) + 1},
        {offsetof(pf_link_config, keepalive_ms), 9},
        {offsetof(pf_link_config, keepalive_ms), 60001},
        {offsetof(pf_link_config, rto_min_ms), 10001},
    };
    static _Alignas(16) uint8_t workspace[600000];
    pf_link *link = NULL;
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        pf_link_config config = a.config;
        memcpy((uint8_t *)&config + bad[i].offset, &bad[i].value, sizeof(uint32_t));
        TEST_ASSERT_EQUAL_size_t_MESSAGE(0, pf_link_workspace_size(&config), "accepted");
        TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_init(&link, &config, workspace, sizeof workspace));
    }
    size_t n = pf_link_workspace_size(&a.config);
    TEST_ASSERT_TRUE(n > 0 && n <= sizeof workspace);
    TEST_ASSERT_EQUAL_size_t(0, pf_link_workspace_size(NULL));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_init(NULL, &a.config, workspace, n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_init(&link, &a.config, NULL, n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_init(&link, &a.config, workspace + 8, n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_link_init(&link, &a.config, workspace, n - 1));
    TEST_ASSERT_NULL(link);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_init(&link, &a.config, workspace, n));
}

/* The largest of everything at the least and the most generous configuration, in workspaces of the exact size. */
static void test_workspace_holds_the_largest_of_everything(void)
{
    static uint8_t bytes[40000];
    for (uint32_t large = 0; large < 2; large++) {
        setUp();
        pf_link_config c = {.role = PF_LINK_DEVICE,
                            .nonce = 1,
                            .max_fragment = large ? 1024 : 64,
                            .send_slots = large ? 16 : 1,
                            .receive_slots = large ? 16 : 1,
                            .max_object = large ? 40000 : 64 * 8 * 3,
                            .max_latest = large ? 33333 : 64,
                            .max_control = large ? 1000 : 16,
                            .control_queue = large ? 64 : 1,
                            .window = large ? 1u << 20 : 1024};
        a.config = b.config = c;
        b.config.role = PF_LINK_HOST;
        b.config.nonce = 2;
        open_both();
        for (uint32_t i = 0; i < (large ? 64u : 1u); i++)
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_control(a.link, bytes, c.max_control));
        TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_link_send_control(a.link, bytes, 1));
        for (uint32_t topic = 0; topic < PF_LINK_TOPICS; topic++)
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_latest(a.link, topic, bytes, c.max_latest));
        for (uint8_t id = 0; id < c.send_slots; id++) {
            uint8_t name[PF_LINK_NAME_SIZE];
            put_name(name, id);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_object(a.link, name, 2, bytes, c.max_object));
        }
        TEST_ASSERT_EQUAL_UINT32(0, pf_link_free_send_slots(a.link));
        TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_link_send_object(a.link, (const uint8_t[32]){99}, 2, bytes, 1));
        for (uint32_t i = 0; i < 50; i++) {
            talk(2);
            for (uint32_t slot = 0; slot < c.receive_slots; slot++)
                if (pf_link_answer_object(b.link, slot, PF_ANSWER_ACCEPT) != PF_OK)
                    pf_link_answer_object(b.link, slot, PF_ANSWER_STORED);
        }
        TEST_ASSERT_EQUAL_UINT32(large ? 64 : 1, b.counts[PF_LINK_CONTROL]);
        TEST_ASSERT_EQUAL_UINT32(PF_LINK_TOPICS, b.counts[PF_LINK_LATEST]);
        TEST_ASSERT_EQUAL_UINT32(c.send_slots, a.counts[PF_LINK_SENT]);
        tearDown();
        a.link = b.link = NULL;
    }
}

static void test_calls_refuse_wrong_arguments(void)
{
    static uint8_t bytes[20000];
    uint8_t name[PF_LINK_NAME_SIZE] = {1};
    open_end(&a);
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, pf_link_send_control(a.link, bytes, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_CLOSED, pf_link_send_latest(a.link, 0, bytes, 1));
    open_both();
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_control(a.link, bytes, 513));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_control(a.link, NULL, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_latest(a.link, 0, bytes, 16385));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_latest(a.link, PF_LINK_TOPICS, bytes, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_latest(a.link, 0, NULL, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_object(a.link, name, 2, bytes, 0));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_object(a.link, name, 2, NULL, 5));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_object(a.link, NULL, 2, bytes, 5));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_object(a.link, name, 256, bytes, 5));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_object(a.link, name, 2, bytes, 5));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_send_object(a.link, name, 2, bytes, 5));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_cancel_object(a.link, (const uint8_t[32]){9}));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_cancel_object(a.link, NULL));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_answer_object(b.link, 0, PF_ANSWER_ACCEPT));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_answer_object(b.link, 99, PF_ANSWER_ACCEPT));
    talk(1);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_OFFER]);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_answer_object(b.link, 0, PF_ANSWER_AGAIN));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, 0, PF_ANSWER_ACCEPT));
    talk(1);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_OBJECT]);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_link_answer_object(b.link, 0, PF_ANSWER_ACCEPT));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, 0, PF_ANSWER_STORED));
    talk(1);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_SENT]);
}

/* ---- session ---- */

static void test_hello_tells_who_the_peer_is_and_whether_it_restarted(void)
{
    open_both();
    TEST_ASSERT_EQUAL_UINT32(PF_LINK_DEVICE, b.last[PF_LINK_UP].peer_role);
    TEST_ASSERT_EQUAL_UINT32(1, b.last[PF_LINK_UP].peer_version);
    TEST_ASSERT_EQUAL_UINT32(1, b.last[PF_LINK_UP].peer_schema);
    TEST_ASSERT_EQUAL_HEX32(0x11223344, b.last[PF_LINK_UP].peer_nonce);
    TEST_ASSERT_EQUAL_HEX64(0x0102030405060708, b.last[PF_LINK_UP].peer_boot_id);
    TEST_ASSERT_FALSE(b.last[PF_LINK_UP].peer_restarted);
    pf_link_reset(b.link, now);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_DOWN]);
    TEST_ASSERT_EQUAL_UINT32(2, b.counts[PF_LINK_UP]);
    TEST_ASSERT_FALSE(b.last[PF_LINK_UP].peer_restarted);
    pf_link_renew(a.link, 76, now);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(3, b.counts[PF_LINK_UP]);
    TEST_ASSERT_FALSE(b.last[PF_LINK_UP].peer_restarted); /* the same boot */
    a.config.nonce = 77;
    a.config.boot_id++;
    open_end(&a);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(4, b.counts[PF_LINK_UP]);
    TEST_ASSERT_TRUE(b.last[PF_LINK_UP].peer_restarted);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_DOWN]); /* a restart is told by the new UP */
}

static void test_other_version_is_told_once_a_peer(void)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    open_end(&a);
    hand_made(frame, PF_FRAME_HELLO);
    frame[0] = 2 << 4;
    frame[4] = PF_LINK_HOST;
    frame[5] = 2;
    pf_put32(frame + 8, 1234);
    for (int i = 0; i < 3; i++)
        feed_raw(&a, frame, 90);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_INCOMPATIBLE]);
    TEST_ASSERT_EQUAL_UINT32(2, a.last[PF_LINK_INCOMPATIBLE].peer_version);
    TEST_ASSERT_EQUAL_UINT32(PF_LINK_HOST, a.last[PF_LINK_INCOMPATIBLE].peer_role);
    pf_put32(frame + 8, 1235);
    feed_raw(&a, frame, 90);
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_INCOMPATIBLE]);
    TEST_ASSERT_FALSE(pf_link_is_up(a.link));
    frame[0] = 2 << 4 | PF_FRAME_CONTROL;
    feed_raw(&a, frame, 90);
    TEST_ASSERT_EQUAL_UINT64(1, pf_link_get_stats(a.link)->malformed);
}

/* A longer hello of the same version is a newer minor: its tail is ignored. */
static void test_longer_hello_is_accepted_and_own_echo_is_not(void)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    open_end(&a);
    hand_made(frame, PF_FRAME_HELLO);
    frame[4] = PF_LINK_HOST;
    frame[5] = 1;
    pf_put32(frame + 8, a.config.nonce);
    pf_put32(frame + 12, a.config.nonce);
    pf_put16(frame + 24, 1024);
    feed_raw(&a, frame, PF_SIZE_HELLO);
    TEST_ASSERT_FALSE(pf_link_is_up(a.link));
    TEST_ASSERT_EQUAL_UINT64(1, pf_link_get_stats(a.link)->malformed);
    pf_put32(frame + 8, b.config.nonce);
    feed_raw(&a, frame, PF_SIZE_HELLO + 20);
    TEST_ASSERT_TRUE(pf_link_is_up(a.link));
}

/* The peer restarts and what it sent before still arrives, and so do its old hellos: neither is taken for new. */
static void test_frames_of_an_earlier_session_are_dropped(void)
{
    static uint8_t late[2000], hello[200];
    open_both();
    pf_link_send_control(b.link, "old", 3);
    size_t n_late = pf_link_output(b.link, late, sizeof late, now);
    pf_link_reset(b.link, now);
    size_t n_hello = pf_link_output(b.link, hello, sizeof hello, now);
    b.config.nonce = 0x77778888;
    open_end(&b);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_UP]);
    feed(&a, late, n_late);
    feed(&a, hello, n_hello);
    TEST_ASSERT_EQUAL_UINT32(0, a.counts[PF_LINK_CONTROL]);
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_UP]);
    TEST_ASSERT_TRUE(pf_link_get_stats(a.link)->stale >= 2);
}

static uint32_t hellos(uint32_t *echo, bool *asks)
{
    uint32_t n = 0;
    wire_size = pf_link_output(a.link, wire, sizeof wire, now);
    for (size_t i = 0, start = 0; i < wire_size; i++) {
        uint8_t frame[PF_LINK_FRAME_MAX];
        size_t size = 0;
        if (wire[i] != 0)
            continue;
        if (pf_cobs_decode(wire + start, i - start, frame, &size) == PF_OK && (frame[0] & 15) == PF_FRAME_HELLO) {
            n++;
            *echo = pf_get32(frame + 12);
            *asks = (frame[7] & 1) != 0;
        }
        start = i + 1;
    }
    return n;
}

/* A stranger's hello is answered until it shows that it exists; a frame of a wrong session asks who is there. */
static void test_hello_is_said_when_sessions_disagree(void)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    uint32_t echo = 0;
    bool asks = false;
    open_both();
    TEST_ASSERT_EQUAL_UINT32(0, hellos(&echo, &asks));
    now += 250 * MS;
    hand_made(frame, PF_FRAME_CONTROL);
    frame[2] ^= 1;
    feed_raw(&a, frame, PF_SIZE_CONTROL);
    TEST_ASSERT_EQUAL_UINT32(1, hellos(&echo, &asks));
    TEST_ASSERT_TRUE(asks && echo == b.config.nonce);
    hand_made(frame, PF_FRAME_HELLO);
    frame[4] = PF_LINK_HOST;
    pf_put32(frame + 8, 0x600D);
    pf_put16(frame + 24, 1024);
    feed_raw(&a, frame, PF_SIZE_HELLO);
    for (int i = 0; i < 3; i++, now += 200 * MS) {
        TEST_ASSERT_EQUAL_UINT32(1, hellos(&echo, &asks));
        TEST_ASSERT_TRUE(asks && echo == 0x600D);
    }
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_UP]);
    pf_put32(frame + 12, a.config.nonce);
    feed_raw(&a, frame, PF_SIZE_HELLO);
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_UP]);
    now += 250 * MS;
    TEST_ASSERT_EQUAL_UINT32(0, hellos(&echo, &asks));
}

static void control_by_hand(uint32_t sequence)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    hand_made(frame, PF_FRAME_CONTROL);
    pf_put32(frame + 4, sequence);
    feed_raw(&a, frame, PF_SIZE_CONTROL);
}

/* A number left out is a message that the peer has given up; an older one is a repetition. */
static void test_control_takes_what_is_not_older(void)
{
    static const uint32_t numbers[] = {0, 0, 5, 5, 3, 6}, seen[] = {1, 1, 2, 2, 2, 3};
    open_both();
    for (size_t i = 0; i < 6; i++) {
        control_by_hand(numbers[i]);
        TEST_ASSERT_EQUAL_UINT32(seen[i], a.counts[PF_LINK_CONTROL]);
    }
}

/* The peer's clock runs three hours ahead and the way there takes 4 ms, the way back 2 ms. */
/* Proves: an end that another peer had meanwhile, and is renewed, is understood by the first again: control both ways,
 * latest and objects. Without the new nonce the first goes on counting from where it was. */
static void test_an_end_that_another_peer_had_meanwhile_is_understood(void)
{
    static uint8_t bytes[5000];
    uint8_t name[PF_LINK_NAME_SIZE];
    open_both();
    end first = {0};
    for (uint32_t turn = 0; turn < 3; turn++) { /* b, another, b */
        memset(b.counts, 0, sizeof b.counts);
        memset(a.counts, 0, sizeof a.counts);
        for (uint32_t i = 0; i < (turn == 0 ? 9u : 3u); i++) {
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_control(a.link, "a", 1));
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_control(b.link, "b", 1));
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_latest(a.link, 0, "l", 1));
            put_name(name, (uint8_t)(10 * turn + i + 1));
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_object(a.link, name, 2, bytes, sizeof bytes));
            for (uint32_t k = 0; k < 20; k++) {
                talk(2);
                for (uint32_t slot = 0; slot < b.config.receive_slots; slot++)
                    if (pf_link_answer_object(b.link, slot, PF_ANSWER_ACCEPT) != PF_OK)
                        pf_link_answer_object(b.link, slot, PF_ANSWER_STORED);
            }
        }
        TEST_ASSERT_EQUAL_UINT32(turn == 0 ? 9 : 3, a.counts[PF_LINK_CONTROL]);
        TEST_ASSERT_EQUAL_UINT32(turn == 0 ? 9 : 3, b.counts[PF_LINK_CONTROL]);
        TEST_ASSERT_EQUAL_UINT32(turn == 0 ? 9 : 3, b.counts[PF_LINK_LATEST]);
        TEST_ASSERT_EQUAL_UINT32(turn == 0 ? 9 : 3, a.counts[PF_LINK_SENT]);
        pf_link_reset(b.link, now);
        const end swap = b;
        if (turn == 0) {
            b = (end){.config = swap.config};
            b.config.nonce++;
            open_end(&b);
        } else {
            b = first;
        }
        first = swap;
        pf_link_renew(a.link, 1000 + turn, now);
        talk(2);
    }
    free(first.link);
}

static void test_clock_offset_lies_within_its_error(void)
{
    const uint64_t ahead = UINT64_C(10800) * 1000 * MS;
    static uint8_t bytes[4096];
    open_end(&a);
    open_end(&b);
    for (int i = 0; i < 3000; i++, now += MS) {
        uint64_t here = now;
        size_t n = pf_link_output(a.link, bytes, sizeof bytes, here);
        now = here + 4 * MS + ahead;
        feed(&b, bytes, n);
        n = pf_link_output(b.link, bytes, sizeof bytes, now);
        now = here + 6 * MS;
        feed(&a, bytes, n);
        now = here + 6 * MS;
    }
    const pf_link_stats *s = pf_link_get_stats(a.link);
    TEST_ASSERT_EQUAL_UINT64(3 * MS, s->peer_clock_error_ns);
    int64_t off = s->peer_clock_offset_ns - (int64_t)ahead;
    TEST_ASSERT_TRUE(off >= -(int64_t)s->peer_clock_error_ns && off <= (int64_t)s->peer_clock_error_ns);
    TEST_ASSERT_TRUE(s->rtt_us >= 5900 && s->rtt_us <= 6100);
}

/* ---- bytes ---- */

static void test_garbage_does_no_harm(void)
{
    uint64_t x = 1;
    open_both();
    for (int chunk = 0; chunk < 1024; chunk++) {
        static uint8_t bytes[1024];
        for (size_t i = 0; i < sizeof bytes; i++) {
            x = x * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
            bytes[i] = (uint8_t)(x >> 60 == 0 ? 0 : x >> 56); /* one frame's end in sixteen bytes or so */
        }
        feed(&a, bytes, sizeof bytes);
    }
    TEST_ASSERT_TRUE(pf_link_get_stats(a.link)->crc_errors > 10000);
    TEST_ASSERT_EQUAL_UINT64(1024 * 1024 + pf_link_get_stats(b.link)->bytes_out, pf_link_get_stats(a.link)->bytes_in);
    feed(&a, (const uint8_t[]){0}, 1);
    pf_link_send_control(b.link, "still here", 10);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_CONTROL]);
}

static void test_overlong_frame_is_skipped_and_the_next_is_read(void)
{
    static uint8_t bytes[5000];
    memset(bytes, 7, sizeof bytes);
    open_both();
    feed(&a, bytes, sizeof bytes);
    feed(&a, (const uint8_t[]){0}, 1);
    TEST_ASSERT_EQUAL_UINT64(1, pf_link_get_stats(a.link)->crc_errors);
    pf_link_send_control(b.link, "x", 1);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_CONTROL]);
    /* an intact frame may have 1071 bytes before its delimiter, not 1072 */
    uint8_t frame[PF_LINK_RAW_MAX];
    const pf_link_stats *stats = pf_link_get_stats(a.link);
    for (size_t n = 1062; n <= 1064; n++) { /* on the wire: n + 4 of checksum + 5 of COBS + 1 */
        uint64_t frames = stats->frames_in, errors = stats->crc_errors;
        hand_made(frame, PF_FRAME_CONTROL);
        memset(frame + 4, 7, sizeof frame - 4);
        feed_raw(&a, frame, n);
        TEST_ASSERT_EQUAL_UINT64(frames + (n == 1062), stats->frames_in);
        TEST_ASSERT_EQUAL_UINT64(errors + (n > 1062), stats->crc_errors);
    }
}

/* Every type cut off at every length, with a checksum that is right: no event but for what is whole, and no harm. */
static void test_truncated_frames_of_every_type(void)
{
    static const size_t whole[16] = {PF_SIZE_HELLO, PF_SIZE_CONTROL,  PF_SIZE_CONTROL_ACK, PF_SIZE_LATEST,
                                     PF_SIZE_OFFER, PF_SIZE_DATA + 1, PF_SIZE_ACK,         PF_SIZE_PING,
                                     PF_SIZE_PONG,  PF_SIZE_CANCEL};
    uint8_t frame[PF_LINK_RAW_MAX];
    open_both();
    for (uint32_t type = 0; type < 16; type++) {
        for (size_t n = 4; n < (whole[type] > 0 ? whole[type] : 40); n++) {
            hand_made(frame, (pf_frame_type)type);
            frame[4] = 1;
            uint64_t before = pf_link_get_stats(a.link)->malformed;
            feed_raw(&a, frame, n);
            TEST_ASSERT_EQUAL_UINT64_MESSAGE(before + 1, pf_link_get_stats(a.link)->malformed, "not counted");
        }
        for (size_t n = 0; n < 4; n++) { /* shorter than a header */
            uint64_t before = pf_link_get_stats(a.link)->crc_errors;
            feed_raw(&a, frame, n);
            TEST_ASSERT_EQUAL_UINT64(before + 1, pf_link_get_stats(a.link)->crc_errors);
        }
    }
    for (uint32_t type = PF_LINK_DOWN; type <= PF_LINK_REFUSED; type++)
        TEST_ASSERT_EQUAL_UINT32(0, a.counts[type]);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_UP]);
}

static void test_output_writes_whole_frames_within_its_capacity(void)
{
    static uint8_t bytes[3000];
    open_both();
    uint8_t name[PF_LINK_NAME_SIZE] = {1};
    pf_link_send_object(a.link, name, 2, bytes, sizeof bytes);
    talk(1);
    pf_link_answer_object(b.link, 0, PF_ANSWER_ACCEPT);
    move(&b, &a);
    for (size_t capacity = 0; capacity < 1024; capacity++) /* the fragment is due, but does not fit */
        TEST_ASSERT_EQUAL_size_t(0, pf_link_output(a.link, wire, capacity, now));
    size_t n = pf_link_output(a.link, wire, PF_LINK_FRAME_MAX, now);
    TEST_ASSERT_TRUE(n > 1024 && n <= PF_LINK_FRAME_MAX && wire[n - 1] == 0);
}

/* ---- the examples of SPEC.md ---- */

static char *spec;

/* The last frame of `wire` of this type must stand in SPEC.md as "    name: hex". */
static void expect_in_spec(const char *name, pf_frame_type type)
{
    char text[600];
    for (size_t i = 0, start = 0; i < wire_size; i++) {
        if (wire[i] != 0)
            continue;
        uint8_t frame[PF_LINK_FRAME_MAX];
        size_t n = 0;
        if (i > start && pf_cobs_decode(wire + start, i - start, frame, &n) == PF_OK && (frame[0] & 15) == type) {
            int at = snprintf(text, sizeof text, "%s:", name);
            for (size_t k = start; k <= i && at < 580; k++)
                at += snprintf(text + at, sizeof text - (size_t)at, " %02x", wire[k]);
            snprintf(text + at, sizeof text - (size_t)at, "\n");
            TEST_ASSERT_NOT_NULL_MESSAGE(strstr(spec, text), text);
            return;
        }
        start = i + 1;
    }
    TEST_FAIL_MESSAGE(name);
}

static void read_spec(void)
{
    FILE *file = fopen(PF_LINK_SPEC, "rb");
    TEST_ASSERT_NOT_NULL_MESSAGE(file, PF_LINK_SPEC);
    spec = calloc(1, 100000);
    TEST_ASSERT_TRUE(spec != NULL && fread(spec, 1, 99999, file) > 1000);
    fclose(file);
}

/* SPEC.md tells this conversation; every frame in it is the one that the code sends. */
static void test_examples_of_the_specification_are_what_is_sent(void)
{
    uint8_t name[PF_LINK_NAME_SIZE];
    for (uint8_t i = 0; i < sizeof name; i++)
        name[i] = i;
    read_spec();
    open_end(&a);
    open_end(&b);
    move(&a, &b);
    expect_in_spec("device HELLO", PF_FRAME_HELLO);
    move(&b, &a);
    expect_in_spec("host HELLO", PF_FRAME_HELLO);
    move(&a, &b);
    expect_in_spec("device HELLO, answer", PF_FRAME_HELLO);
    expect_in_spec("device PING", PF_FRAME_PING);
    now += 2 * MS;
    move(&b, &a);
    expect_in_spec("host PONG", PF_FRAME_PONG);
    move(&a, &b);
    pf_link_send_control(b.link, "hi", 2);
    move(&b, &a);
    expect_in_spec("host CONTROL", PF_FRAME_CONTROL);
    move(&a, &b);
    expect_in_spec("device CONTROL_ACK", PF_FRAME_CONTROL_ACK);
    pf_link_send_latest(a.link, PF_TOPIC_STATUS, "ok", 2);
    move(&a, &b);
    expect_in_spec("device LATEST", PF_FRAME_LATEST);
    pf_link_send_object(a.link, name, PF_OBJECT_KEYFRAME, "pipefish", 8);
    move(&a, &b);
    expect_in_spec("device OFFER", PF_FRAME_OFFER);
    pf_link_answer_object(b.link, 0, PF_ANSWER_ACCEPT);
    move(&b, &a);
    expect_in_spec("host ACK, receiving", PF_FRAME_ACK);
    move(&a, &b);
    expect_in_spec("device DATA", PF_FRAME_DATA);
    pf_link_answer_object(b.link, 0, PF_ANSWER_STORED);
    move(&b, &a);
    expect_in_spec("host ACK, stored", PF_FRAME_ACK);
    pf_link_send_object(a.link, name, PF_OBJECT_KEYFRAME, "pipefish", 8);
    move(&a, &b);
    pf_link_cancel_object(a.link, name);
    move(&a, &b);
    expect_in_spec("device CANCEL", PF_FRAME_CANCEL);
    free(spec);
}

/* Proves: silence is noticed by input alone, without a byte, for nobody asks for output while the line takes nothing;
 * and bytes that come late are still a sign of life. */
static void test_silence_is_noticed_without_output(void)
{
    open_both();
    now += 3999 * MS;
    feed(&a, NULL, 0);
    TEST_ASSERT_TRUE(pf_link_is_up(a.link));
    now += 1 * MS;
    (void)move(&b, &a);
    TEST_ASSERT_TRUE(pf_link_is_up(a.link));
    now += 3999 * MS;
    (void)pf_link_input(a.link, NULL, 0, now);
    TEST_ASSERT_TRUE(pf_link_is_up(a.link));
    now += 1000 * MS;
    (void)pf_link_input(a.link, NULL, 0, now);
    TEST_ASSERT_FALSE(pf_link_is_up(a.link));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_init_refuses_what_is_out_of_range);
    RUN_TEST(test_workspace_holds_the_largest_of_everything);
    RUN_TEST(test_calls_refuse_wrong_arguments);
    RUN_TEST(test_hello_tells_who_the_peer_is_and_whether_it_restarted);
    RUN_TEST(test_other_version_is_told_once_a_peer);
    RUN_TEST(test_longer_hello_is_accepted_and_own_echo_is_not);
    RUN_TEST(test_frames_of_an_earlier_session_are_dropped);
    RUN_TEST(test_hello_is_said_when_sessions_disagree);
    RUN_TEST(test_control_takes_what_is_not_older);
    RUN_TEST(test_an_end_that_another_peer_had_meanwhile_is_understood);
    RUN_TEST(test_clock_offset_lies_within_its_error);
    RUN_TEST(test_garbage_does_no_harm);
    RUN_TEST(test_overlong_frame_is_skipped_and_the_next_is_read);
    RUN_TEST(test_truncated_frames_of_every_type);
    RUN_TEST(test_output_writes_whole_frames_within_its_capacity);
    RUN_TEST(test_examples_of_the_specification_are_what_is_sent);
    RUN_TEST(test_silence_is_noticed_without_output);
    return UNITY_END();
}
