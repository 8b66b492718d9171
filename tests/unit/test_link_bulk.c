/* Latest messages and objects, rule by rule, mostly against frames made by hand. */
#include "link_pair.h"
#include "unity.h"

#include <string.h>

/* ---- latest ---- */

static void latest_by_hand(uint8_t topic, uint32_t number, uint32_t size, uint32_t index)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    hand_made(frame, PF_FRAME_LATEST);
    frame[4] = topic;
    pf_put16(frame + 6, index);
    pf_put32(frame + 8, number);
    pf_put32(frame + 12, size);
    feed_raw(&a, frame, PF_SIZE_LATEST + pf_fragment_size(size, 1024, index));
}

static void test_latest_never_goes_back_and_is_whole(void)
{
    open_both();
    const uint32_t *got = &a.counts[PF_LINK_LATEST];
    latest_by_hand(1, 5, 100, 0);
    latest_by_hand(1, 5, 100, 0); /* twice */
    latest_by_hand(1, 4, 100, 0); /* older */
    TEST_ASSERT_EQUAL_UINT32(1, *got);
    latest_by_hand(2, 4, 100, 0); /* another topic counts for itself */
    TEST_ASSERT_EQUAL_UINT32(2, *got);
    latest_by_hand(1, 6, 3000, 0);
    latest_by_hand(1, 6, 3000, 2);
    latest_by_hand(1, 6, 3000, 2);
    TEST_ASSERT_EQUAL_UINT32(2, *got);
    latest_by_hand(1, 6, 3000, 1); /* in any order */
    TEST_ASSERT_EQUAL_UINT32(3, *got);
    TEST_ASSERT_EQUAL_UINT32(3000, a.last[PF_LINK_LATEST].size);
    latest_by_hand(1, 7, 3000, 0);
    latest_by_hand(1, 8, 3000, 0); /* 7 will never be whole */
    latest_by_hand(1, 7, 3000, 1);
    latest_by_hand(1, 7, 3000, 2);
    TEST_ASSERT_EQUAL_UINT32(3, *got);
    TEST_ASSERT_EQUAL_UINT64(1, pf_link_get_stats(a.link)->latest_incomplete);
    latest_by_hand(1, 9, 0, 0); /* empty is whole, and newer than the partial 8 */
    TEST_ASSERT_EQUAL_UINT32(4, *got);
    b.config.nonce = 0x31313131;
    open_end(&b);
    talk(2);
    latest_by_hand(1, 1, 10, 0); /* a new session counts anew */
    TEST_ASSERT_EQUAL_UINT32(5, *got);
    uint64_t malformed = pf_link_get_stats(a.link)->malformed;
    latest_by_hand(1, 10, 16385, 0); /* larger than we take */
    TEST_ASSERT_EQUAL_UINT64(malformed + 1, pf_link_get_stats(a.link)->malformed);
}

static void test_newer_latest_replaces_the_one_that_waits(void)
{
    open_both();
    for (uint8_t i = 0; i < 10; i++)
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_latest(a.link, 0, &i, 1));
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_LATEST]);
    TEST_ASSERT_EQUAL_HEX8(9, b.data[0]);
    TEST_ASSERT_EQUAL_UINT64(9, pf_link_get_stats(a.link)->latest_replaced);
}

/* ---- bulk ---- */

static void test_repeated_offer_asks_once_and_gets_the_answer_again(void)
{
    open_both();
    for (int i = 0; i < 3; i++)
        offer_by_hand(5, 1, 1500);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_OFFER]);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_WAITING, ack_state(5));
    pf_link_answer_object(a.link, 0, PF_ANSWER_ACCEPT);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_RECEIVING, ack_state(5));
    data_by_hand(5, 0, 1, 1024);
    data_by_hand(5, 0, 2, 1024);
    data_by_hand(5, 1, 3, 476);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_COMPLETE, ack_state(5));
    offer_by_hand(5, 1, 1500);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_OBJECT]);
    pf_link_answer_object(a.link, 0, PF_ANSWER_STORED);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_STORED, ack_state(5));
    offer_by_hand(5, 1, 1500); /* the acknowledgement was lost */
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_STORED, ack_state(5));
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_OFFER]);
    offer_by_hand(6, 1, 1500); /* offered anew */
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_OFFER]);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_OBJECT]);
}

static void test_offers_beyond_the_slots_or_the_size_are_turned_down(void)
{
    open_both(); /* a has one slot of 4096 bytes */
    offer_by_hand(1, 1, 4097);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_REFUSED, ack_state(1));
    offer_by_hand(2, 2, 4096);
    offer_by_hand(3, 3, 100);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_BUSY, ack_state(3));
    offer_by_hand(4, 2, 100); /* same name, other size, while the question is open */
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_BUSY, ack_state(4));
    data_by_hand(77, 0, 1, 10);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_UNKNOWN, ack_state(77));
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_OFFER]);
}

/* The same without a restart: the peer has reset, and does not offer the partial again. */
static void test_partial_that_a_reset_peer_does_not_offer_gives_way(void)
{
    open_both();
    offer_by_hand(1, 1, 4096);
    pf_link_answer_object(a.link, 0, PF_ANSWER_ACCEPT);
    data_by_hand(1, 0, 1, 1024);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_RECEIVING, ack_state(1));
    pf_link_reset(b.link, now);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(0, a.counts[PF_LINK_DOWN]);
    offer_by_hand(2, 2, 4096);
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_OFFER]);
}

/* A host that only asks for the status must not make the device drop its spool. */
static void test_objects_wait_for_a_peer_that_takes_objects(void)
{
    uint8_t name[PF_LINK_NAME_SIZE] = {1};
    b.config.max_object = b.config.receive_slots = 0;
    open_both();
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_object(a.link, name, 2, "x", 1));
    talk(3000);
    TEST_ASSERT_EQUAL_UINT32(0, a.counts[PF_LINK_REFUSED]);
    TEST_ASSERT_EQUAL_UINT32(3, pf_link_free_send_slots(a.link));
    b.config.max_object = 1;
    b.config.nonce = 99;
    open_end(&b);
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_OFFER]);
    pf_link_reset(b.link, now); /* the question outlives the session */
    talk(300);
    TEST_ASSERT_EQUAL_UINT32(1, b.counts[PF_LINK_OFFER]);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, b.last[PF_LINK_OFFER].slot, PF_ANSWER_STORED));
    talk(2);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_SENT]);
}

/* A partial blocks its slot only while its sender still speaks of it. */
static void test_partial_of_an_earlier_session_gives_way(void)
{
    open_both();
    offer_by_hand(1, 1, 4096);
    pf_link_answer_object(a.link, 0, PF_ANSWER_ACCEPT);
    data_by_hand(1, 0, 1, 1024);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_RECEIVING, ack_state(1));
    offer_by_hand(2, 2, 4096);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_BUSY, ack_state(2));
    b.config.nonce = 0x55556666;
    open_end(&b);
    talk(2);
    data_by_hand(1, 1, 1, 1024); /* another session's handle */
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_UNKNOWN, ack_state(1));
    TEST_ASSERT_EQUAL_UINT64(1, pf_link_get_stats(a.link)->fragments_received);
    offer_by_hand(1, 2, 4096);
    TEST_ASSERT_EQUAL_UINT32(2, a.counts[PF_LINK_OFFER]);
    TEST_ASSERT_EQUAL_UINT32(PF_ACK_WAITING, ack_state(1));
}

static void test_cancelled_object_frees_both_ends(void)
{
    static uint8_t bytes[20000];
    uint8_t name[PF_LINK_NAME_SIZE] = {1};
    open_both();
    uint32_t free_before = pf_link_free_send_slots(a.link);
    for (int state = 0; state < 4; state++) { /* before the offer, asked, receiving, complete */
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_object(a.link, name, 2, bytes, sizeof bytes));
        if (state > 0)
            talk(1);
        if (state > 1)
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, b.last[PF_LINK_OFFER].slot, PF_ANSWER_ACCEPT));
        if (state > 2)
            talk(1);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_cancel_object(a.link, name));
        talk(2);
        TEST_ASSERT_EQUAL_UINT32(free_before, pf_link_free_send_slots(a.link));
        if (state == 1) /* the question stays open until it is answered */
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, b.last[PF_LINK_OFFER].slot, PF_ANSWER_REFUSE));
        if (state == 3)
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, b.last[PF_LINK_OFFER].slot, PF_ANSWER_STORED));
    }
    TEST_ASSERT_EQUAL_UINT32(3, b.counts[PF_LINK_OFFER]);
    TEST_ASSERT_EQUAL_UINT32(0, a.counts[PF_LINK_SENT]);
}

static void ack_by_hand(uint32_t handle, uint32_t state, uint32_t seen, uint32_t base, size_t bitmap, uint8_t bits)
{
    uint8_t frame[PF_LINK_RAW_MAX];
    hand_made(frame, PF_FRAME_ACK);
    pf_put16(frame + 4, handle);
    frame[6] = (uint8_t)state;
    pf_put32(frame + 8, seen);
    pf_put16(frame + 12, base);
    memset(frame + PF_SIZE_ACK, bits, bitmap);
    feed_raw(&a, frame, PF_SIZE_ACK + bitmap);
}

static void test_acknowledgements_that_cannot_be_are_malformed(void)
{
    static uint8_t bytes[5000]; /* 5 fragments */
    uint8_t name[PF_LINK_NAME_SIZE] = {1};
    open_both();
    pf_link_send_object(a.link, name, 2, bytes, sizeof bytes);
    pf_link_output(a.link, wire, sizeof wire, now); /* offer, handle 1 */
    ack_by_hand(1, PF_ACK_RECEIVING, 0, 0, 0, 0);
    pf_link_output(a.link, wire, sizeof wire, now); /* tx 1..5 */
    const uint64_t *malformed = &pf_link_get_stats(a.link)->malformed;
    TEST_ASSERT_EQUAL_UINT64(0, *malformed);
    ack_by_hand(1, 8, 0, 0, 0, 0);                   /* no such state */
    ack_by_hand(1, PF_ACK_RECEIVING, 6, 0, 0, 0);    /* never sent */
    ack_by_hand(1, PF_ACK_RECEIVING, 5, 6, 0, 0);    /* beyond the end */
    ack_by_hand(1, PF_ACK_RECEIVING, 5, 0, 1, 0x10); /* fragment 5 of 0..4 */
    ack_by_hand(1, PF_ACK_RECEIVING, 5, 0, 65, 0);   /* longer than any */
    TEST_ASSERT_EQUAL_UINT64(5, *malformed);
    ack_by_hand(9, PF_ACK_STORED, 5, 0, 0, 0); /* a handle that is gone is no fault */
    TEST_ASSERT_EQUAL_UINT64(5, *malformed);
    TEST_ASSERT_EQUAL_UINT32(0, a.counts[PF_LINK_SENT]);
    /* one sent two earlier than the newest seen may still come */
    ack_by_hand(1, PF_ACK_RECEIVING, 4, 1, 1, 0x03);
    TEST_ASSERT_EQUAL_size_t(0, pf_link_output(a.link, wire, sizeof wire, now));
    /* 0, 2 and 3 have arrived, 4 is too young to be lost: exactly 1 is repeated */
    ack_by_hand(1, PF_ACK_RECEIVING, 5, 1, 1, 0x03);
    pf_link_output(a.link, wire, sizeof wire, now);
    TEST_ASSERT_EQUAL_UINT64(1, pf_link_get_stats(a.link)->fragments_resent);
    ack_by_hand(1, PF_ACK_STORED, 6, 5, 0, 0);
    TEST_ASSERT_EQUAL_UINT32(1, a.counts[PF_LINK_SENT]);
}

/* What was taken for lost arrives after all before it is repeated. */
static void test_fragment_that_was_only_late_is_not_repeated(void)
{
    static uint8_t bytes[5000];
    uint8_t name[PF_LINK_NAME_SIZE] = {1};
    open_both();
    pf_link_send_object(a.link, name, 2, bytes, sizeof bytes);
    pf_link_output(a.link, wire, sizeof wire, now);
    ack_by_hand(1, PF_ACK_RECEIVING, 0, 0, 0, 0);
    pf_link_output(a.link, wire, sizeof wire, now);
    ack_by_hand(1, PF_ACK_RECEIVING, 5, 0, 1, 0x0E); /* 0 is lost */
    ack_by_hand(1, PF_ACK_RECEIVING, 5, 4, 0, 0);
    for (int i = 0; i < 20; i++, now += MS)
        pf_link_output(a.link, wire, sizeof wire, now);
    TEST_ASSERT_EQUAL_UINT64(0, pf_link_get_stats(a.link)->fragments_resent);
}

/* The only fragment of one object is lost while another object makes progress all the time: no timeout of the line. */
static void test_loss_is_found_while_another_object_progresses(void)
{
    static uint8_t bytes[60000];
    a.config.window = 4096;
    open_both();
    pf_link_send_object(a.link, (const uint8_t[PF_LINK_NAME_SIZE]){1}, 2, bytes, 10);
    pf_link_send_object(a.link, (const uint8_t[PF_LINK_NAME_SIZE]){2}, 2, bytes, 58 * 1024);
    pf_link_output(a.link, wire, sizeof wire, now);
    ack_by_hand(1, PF_ACK_RECEIVING, 0, 0, 0, 0);
    ack_by_hand(2, PF_ACK_RECEIVING, 0, 0, 0, 0);
    for (uint32_t i = 1; i < 50; i++, now += 20 * MS) {
        pf_link_output(a.link, wire, sizeof wire, now);
        ack_by_hand(2, PF_ACK_RECEIVING, i + 1, i, 0, 0);
    }
    TEST_ASSERT_EQUAL_UINT64(0, pf_link_get_stats(a.link)->malformed);
    TEST_ASSERT_TRUE(pf_link_get_stats(a.link)->fragments_resent > 0);
}

/* All counters start just below their wrap. */
static void test_counters_wrap(void)
{
    static uint8_t bytes[20000];
    open_both();
    for (uint32_t i = 0; i < 2; i++) {
        pf_link *from = i == 0 ? a.link : b.link, *to = i == 0 ? b.link : a.link;
        from->control.sequence = to->control.expected = UINT32_MAX - 2;
        from->sender.tx_next = from->sender.tx_tail = UINT32_MAX - 5;
        from->sender.tx_seen = to->receiver.tx_highest = UINT32_MAX - 6;
        from->sender.handle = UINT16_MAX - 2;
        from->sender.order = to->receiver.order = UINT32_MAX - 1;
        from->latest.topics[0].number = UINT32_MAX - 2;
    }
    for (uint8_t i = 0; i < 8; i++) {
        uint8_t name[PF_LINK_NAME_SIZE] = {i};
        pf_link_send_control(a.link, &i, 1);
        pf_link_send_latest(a.link, 0, &i, 1);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_send_object(a.link, name, 2, bytes, sizeof bytes));
        talk(2);
        uint32_t slot = b.last[PF_LINK_OFFER].slot;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, slot, PF_ANSWER_ACCEPT));
        talk(2);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_link_answer_object(b.link, slot, PF_ANSWER_STORED));
        talk(2);
        TEST_ASSERT_EQUAL_UINT32(i + 1u, a.counts[PF_LINK_SENT]);
        TEST_ASSERT_EQUAL_UINT32(i + 1u, b.counts[PF_LINK_CONTROL]);
        TEST_ASSERT_EQUAL_UINT32(i + 1u, b.counts[PF_LINK_LATEST]);
    }
    TEST_ASSERT_EQUAL_UINT64(0, pf_link_get_stats(a.link)->fragments_resent);
    TEST_ASSERT_TRUE(a.link->sender.tx_next < 1000);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_latest_never_goes_back_and_is_whole);
    RUN_TEST(test_newer_latest_replaces_the_one_that_waits);
    RUN_TEST(test_repeated_offer_asks_once_and_gets_the_answer_again);
    RUN_TEST(test_offers_beyond_the_slots_or_the_size_are_turned_down);
    RUN_TEST(test_partial_that_a_reset_peer_does_not_offer_gives_way);
    RUN_TEST(test_objects_wait_for_a_peer_that_takes_objects);
    RUN_TEST(test_partial_of_an_earlier_session_gives_way);
    RUN_TEST(test_cancelled_object_frees_both_ends);
    RUN_TEST(test_acknowledgements_that_cannot_be_are_malformed);
    RUN_TEST(test_fragment_that_was_only_late_is_not_repeated);
    RUN_TEST(test_loss_is_found_while_another_object_progresses);
    RUN_TEST(test_counters_wrap);
    return UNITY_END();
}
