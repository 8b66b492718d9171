/* One connection of the daemon, over a line that several hosts have one after the other: a serial cable. */
#include "session.h"
#include "unity.h"

#include <stdlib.h>
#include <string.h>

#define MS UINT64_C(1000000)

typedef struct host {
    pf_link *link;
    uint32_t controls; /* answers */
} host;

static pf_session device;
static uint32_t ups, downs, restarts, heard;
static uint64_t now;
static uint8_t to_device[1 << 16], to_host[1 << 16];
static size_t to_device_n, to_host_n;

void setUp(void)
{
    heard = 0;
}

void tearDown(void)
{
    pf_session_close(&device);
}

/* ---- the line */

static pf_status read_line(void *self, uint8_t *bytes, size_t capacity, size_t *done)
{
    (void)self;
    *done = to_device_n < capacity ? to_device_n : capacity;
    memcpy(bytes, to_device, *done);
    memmove(to_device, to_device + *done, to_device_n - *done);
    to_device_n -= *done;
    return PF_OK;
}

static pf_status write_line(void *self, const uint8_t *bytes, size_t n, size_t *done)
{
    (void)self;
    TEST_ASSERT_TRUE(to_host_n + n <= sizeof to_host);
    memcpy(to_host + to_host_n, bytes, n);
    to_host_n += n;
    *done = n;
    return PF_OK;
}

static size_t room_of_line(void *self)
{
    (void)self;
    return sizeof to_host - to_host_n < 8192 ? 0 : 8192;
}

static void hear(void *self)
{
    (void)self;
    heard++;
}

static const pf_transport_ops line = {.read = read_line, .write = write_line, .room = room_of_line, .heard = hear};

/* ---- both ends */

static void take(void *context, pf_session *s, const pf_link_event *e, uint64_t at)
{
    (void)context;
    (void)at;
    ups += e->type == PF_LINK_UP;
    restarts += e->type == PF_LINK_UP && e->peer_restarted;
    downs += e->type == PF_LINK_DOWN;
    if (e->type == PF_LINK_CONTROL)
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_control(s->link, e->data, e->size));
}

static host open_host(uint32_t nonce)
{
    const pf_link_config config = {.role = PF_LINK_HOST, .nonce = nonce, .boot_id = nonce, .max_object = 1000};
    const size_t n = pf_link_workspace_size(&config);
    host h = {0};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_init(&h.link, &config, aligned_alloc(16, (n + 15) / 16 * 16), n));
    return h;
}

static void talk(host *h, uint32_t ms)
{
    for (uint32_t i = 0; i < ms; i++) {
        bool is_full;
        pf_link_event e;
        now += MS;
        to_device_n += pf_link_output(h->link, to_device + to_device_n, sizeof to_device - to_device_n, now);
        TEST_ASSERT_TRUE(pf_session_read(&device, take, NULL, now));
        TEST_ASSERT_TRUE(pf_session_write(&device, now, &is_full));
        for (size_t at = 0; at < to_host_n;) {
            at += pf_link_input(h->link, to_host + at, to_host_n - at, now);
            while (pf_link_next_event(h->link, &e))
                h->controls += e.type == PF_LINK_CONTROL;
        }
        to_host_n = 0;
    }
}

/* Proves: a host that had the line, left it to another without ending (the cable was put into another computer) and
 * comes back is answered, also the second time, and each change of hosts is one new session to the daemon. */
static void test_a_host_that_comes_back_to_the_line_is_answered(void)
{
    const pf_link_config config = {.role = PF_LINK_DEVICE, .boot_id = 1, .keepalive_ms = 100};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_session_open(&device, &config));
    device.transport.ops = &line;
    pf_session_begin(&device, take, NULL, now);
    device.has_stream = true;
    host hosts[2] = {open_host(100), open_host(200)};
    for (uint32_t turn = 0; turn < 6; turn++) {
        host *h = &hosts[turn % 2];
        const uint32_t asked = turn < 2 ? 9 : 3;
        h->controls = 0;
        if (turn >= 2)
            pf_link_reset(h->link, now); /* it has noticed the silence */
        talk(h, 1000);
        TEST_ASSERT_EQUAL_UINT32(turn + 1, ups);
        for (uint32_t i = 0; i < asked; i++) {
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_control(h->link, "ask", 3));
            talk(h, 20);
        }
        TEST_ASSERT_EQUAL_UINT32(asked, h->controls);
        TEST_ASSERT_EQUAL_UINT32(turn + 1, ups);
    }
    TEST_ASSERT_TRUE(downs <= 5);
    TEST_ASSERT_EQUAL_UINT32(5, restarts); /* each was another computer than the one before */
    free(hosts[0].link);
    free(hosts[1].link);
}

/* Proves: what keeps a host its line are frames, not bytes. */
static void test_only_a_frame_is_heard(void)
{
    const pf_link_config config = {.role = PF_LINK_DEVICE, .boot_id = 1};
    static const uint8_t request[] =
        "\0\3\0\10\x21\x12\xa4\x42 a browser's request to a relay, whose first byte is 0\0";
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_session_open(&device, &config));
    device.transport.ops = &line;
    pf_session_begin(&device, take, NULL, now);
    device.has_stream = true;
    memcpy(to_device, request, to_device_n = sizeof request);
    TEST_ASSERT_TRUE(pf_session_read(&device, take, NULL, now));
    TEST_ASSERT_EQUAL_size_t(0, to_device_n);
    TEST_ASSERT_EQUAL_UINT32(0, heard);
    host h = open_host(100);
    to_device_n = pf_link_output(h.link, to_device, sizeof to_device, now);
    TEST_ASSERT_TRUE(pf_session_read(&device, take, NULL, now));
    TEST_ASSERT_EQUAL_UINT32(1, heard);
    free(h.link);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_host_that_comes_back_to_the_line_is_answered);
    RUN_TEST(test_only_a_frame_is_heard);
    return UNITY_END();
}
