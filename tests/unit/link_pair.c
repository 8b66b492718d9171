#include "link_pair.h"
#include "unity.h"

#include <stdlib.h>
#include <string.h>

end a, b; /* device and host */
uint64_t now;
uint8_t wire[100000]; /* last output that `move` carried */
size_t wire_size;

void open_end(end *e)
{
    size_t n = pf_link_workspace_size(&e->config);
    TEST_ASSERT_TRUE(n > 0);
    free(e->link);
    void *workspace = aligned_alloc(16, n); /* exact, so that AddressSanitizer sees the byte behind */
    memset(workspace, 0x5C, n);
    e->link = NULL;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_init(&e->link, &e->config, workspace, n));
}

void setUp(void)
{
    memset(&a, 0, sizeof a);
    memset(&b, 0, sizeof b);
    now = 5000 * MS;
    a.config = (pf_link_config){.role = PF_LINK_DEVICE,
                                .nonce = 0x11223344,
                                .boot_id = 0x0102030405060708,
                                .schema = 1,
                                .receive_slots = 1,
                                .max_object = 4096};
    b.config = (pf_link_config){
        .role = PF_LINK_HOST, .nonce = 0xA1B2C3D4, .schema = 1, .receive_slots = 2, .max_object = 20000};
}

void tearDown(void)
{
    free(a.link);
    free(b.link);
}

static void take_events(end *e)
{
    pf_link_event event;
    while (pf_link_next_event(e->link, &event)) {
        TEST_ASSERT_TRUE(event.type >= PF_LINK_UP && event.type <= PF_LINK_REFUSED);
        e->counts[event.type]++;
        if (event.data != NULL) {
            TEST_ASSERT_TRUE(event.size <= sizeof e->data);
            memcpy(e->data, event.data, event.size);
        }
        event.data = NULL;
        e->last[event.type] = event;
    }
}

void feed(end *e, const uint8_t *bytes, size_t n)
{
    for (size_t done = 0; done < n;) {
        done += pf_link_input(e->link, bytes + done, n - done, now);
        take_events(e);
    }
}

/* Carries what `from` has to say; returns the bytes. */
size_t move(end *from, end *to)
{
    wire_size = pf_link_output(from->link, wire, sizeof wire, now);
    TEST_ASSERT_TRUE(wire_size <= sizeof wire);
    take_events(from);
    feed(to, wire, wire_size);
    return wire_size;
}

/* Lets both talk for `ms` milliseconds. */
void talk(uint64_t ms)
{
    for (uint64_t i = 0; i < ms; i++, now += MS)
        while (move(&a, &b) + move(&b, &a) > 0)
            ;
}

void open_both(void)
{
    open_end(&a);
    open_end(&b);
    talk(3);
    TEST_ASSERT_TRUE(pf_link_is_up(a.link) && pf_link_is_up(b.link));
}

/* Feeds a frame as an intact sender would put it on the wire. */
void feed_raw(end *e, const uint8_t *frame, size_t n)
{
    uint8_t raw[PF_LINK_FRAME_MAX], code[PF_LINK_FRAME_MAX + 10];
    memcpy(raw, frame, n);
    pf_put32(raw + n, pf_crc32c(0, raw, n));
    size_t size = pf_cobs_encode(raw, n + 4, code);
    code[size++] = 0;
    feed(e, code, size);
}

/* A frame of b's, made by hand: header with the session's tag, then zeros. */
uint8_t *hand_made(uint8_t *frame, pf_frame_type type)
{
    memset(frame, 0, PF_LINK_RAW_MAX);
    frame[0] = (uint8_t)(1 << 4 | type);
    pf_put16(frame + 2, (b.config.nonce ^ a.config.nonce >> 16) & 0xFFFF);
    return frame;
}

void put_name(uint8_t *name, uint8_t id)
{
    memset(name, id, PF_LINK_NAME_SIZE);
}

void offer_by_hand(uint8_t handle, uint8_t id, uint32_t size)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    hand_made(frame, PF_FRAME_OFFER);
    pf_put16(frame + 4, handle);
    frame[6] = PF_OBJECT_PROFILE;
    pf_put32(frame + 8, size);
    pf_put16(frame + 12, 1024);
    put_name(frame + 16, id);
    feed_raw(&a, frame, PF_SIZE_OFFER);
}

void data_by_hand(uint8_t handle, uint32_t index, uint32_t tx, size_t n)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    hand_made(frame, PF_FRAME_DATA);
    pf_put16(frame + 4, handle);
    pf_put16(frame + 6, index);
    pf_put32(frame + 8, tx);
    feed_raw(&a, frame, PF_SIZE_DATA + n);
}

/* What a's next acknowledgement says of this handle; 255 = none comes. */
uint32_t ack_state(uint32_t handle)
{
    uint32_t state = 255;
    wire_size = pf_link_output(a.link, wire, sizeof wire, now);
    for (size_t i = 0, start = 0; i < wire_size; i++) {
        if (wire[i] != 0)
            continue;
        uint8_t frame[PF_LINK_FRAME_MAX];
        size_t n = 0;
        if (pf_cobs_decode(wire + start, i - start, frame, &n) == PF_OK && (frame[0] & 15) == PF_FRAME_ACK &&
            pf_get16(frame + 4) == handle)
            state = frame[6];
        start = i + 1;
    }
    return state;
}
