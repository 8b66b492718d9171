/* The wheel encoder's decoder. Proves: motion is counted with its direction, bounces end where they began, lost edges
 * are noticed by their numbers and bridged only where the motion is clear, edges that overtake one another are put in
 * order, and a frame gets the count of its own moment. Does not prove: that a kernel numbers its edges (tests/hil). */
#include "gpio/quadrature.h"
#include "unity.h"

static pf_quadrature q;
static uint32_t number;

void setUp(void)
{
    pf_quadrature_init(&q, false, false);
    number = 0;
}

void tearDown(void) {}

/* The edge after `place` places forwards from 00, as hardware makes it. */
static void edge_at(int64_t place, int way)
{
    static const uint8_t state[4] = {0, 1, 3, 2};
    const uint8_t before = state[place & 3], after = state[(place + way) & 3], changed = before ^ after;
    const int line = changed >> 1 & 1;
    pf_quadrature_edge(&q, line, after >> line & 1, ++number);
}

static void turn(int64_t *place, int way, int edges)
{
    for (int i = 0; i < edges; i++) {
        edge_at(*place, way);
        *place += way;
    }
}

static void test_motion_is_counted_with_its_direction(void)
{
    int64_t place = 0;
    turn(&place, 1, 1001);
    TEST_ASSERT_EQUAL_INT64(1001, q.count);
    turn(&place, -1, 2003);
    TEST_ASSERT_EQUAL_INT64(-1002, q.count);
    TEST_ASSERT_EQUAL_UINT32(0, q.missed + q.repeated + q.illegal);
}

static void test_a_start_at_any_levels_counts_from_there(void)
{
    for (int start = 0; start < 4; start++) {
        static const uint8_t state[4] = {0, 1, 3, 2};
        int64_t place = start;
        pf_quadrature_init(&q, state[start] & 1, state[start] >> 1);
        turn(&place, 1, 9);
        turn(&place, -1, 4);
        TEST_ASSERT_EQUAL_INT64(5, q.count);
        TEST_ASSERT_EQUAL_UINT32(0, q.repeated + q.illegal);
    }
}

static void test_bounces_end_where_they_began(void)
{
    int64_t place = 0;
    turn(&place, 1, 10);
    for (int i = 0; i < 7; i++) { /* a contact that closes, opens, closes... */
        turn(&place, 1, 1);
        turn(&place, -1, 1);
    }
    turn(&place, 1, 1);
    TEST_ASSERT_EQUAL_INT64(11, q.count);
    TEST_ASSERT_EQUAL_UINT32(0, q.missed + q.repeated + q.illegal);
}

/* Edges that the kernel dropped while the wheel went on in one direction: counted as missed, and the count is right. */
static void test_lost_edges_of_a_steady_motion_are_bridged(void)
{
    for (int way = -1; way <= 1; way += 2) {
        for (int lost = 1; lost <= 40; lost++) {
            int64_t place = 0;
            setUp();
            turn(&place, way, 25);
            place += way * lost;
            number += (uint32_t)lost;
            turn(&place, way, 25);
            TEST_ASSERT_EQUAL_INT64(place, q.count);
            TEST_ASSERT_EQUAL_UINT32((uint32_t)lost, q.missed);
            TEST_ASSERT_EQUAL_UINT32(0, q.repeated + q.illegal);
        }
    }
}

/* The wheel turned round while edges were lost: the next edge contradicts a steady motion half of the time; then
 * nothing is made up, and what follows is decoded again. */
static void test_lost_edges_that_fit_no_steady_motion_are_not_made_up(void)
{
    int64_t place = 0;
    turn(&place, 1, 20);
    number += 2; /* forwards one more and back again */
    turn(&place, -1, 10);
    TEST_ASSERT_EQUAL_UINT32(2, q.missed);
    TEST_ASSERT_EQUAL_UINT32(1, q.illegal);
    int64_t before = q.count;
    turn(&place, -1, 8);
    TEST_ASSERT_EQUAL_INT64(before - 8, q.count);
    TEST_ASSERT_INT64_WITHIN(2, place, q.count);
}

static void test_an_edge_to_the_level_that_is_there_does_not_count(void)
{
    pf_quadrature_edge(&q, PF_QUADRATURE_A, true, 1);
    pf_quadrature_edge(&q, PF_QUADRATURE_A, true, 2);
    TEST_ASSERT_EQUAL_INT64(1, q.count);
    TEST_ASSERT_EQUAL_UINT32(1, q.repeated);
}

static void test_numbers_wrap(void)
{
    number = UINT32_MAX - 3;
    int64_t place = 0;
    turn(&place, 1, 20);
    TEST_ASSERT_EQUAL_INT64(20, q.count);
    TEST_ASSERT_EQUAL_UINT32(0, q.missed);
}

static void test_samples_count_steps_and_name_jumps(void)
{
    pf_quadrature_sample(&q, true, false);
    pf_quadrature_sample(&q, true, false);
    pf_quadrature_sample(&q, true, true);
    TEST_ASSERT_EQUAL_INT64(2, q.count);
    pf_quadrature_sample(&q, false, false);
    TEST_ASSERT_EQUAL_INT64(2, q.count);
    TEST_ASSERT_EQUAL_UINT32(1, q.illegal);
    pf_quadrature_sample(&q, false, true);
    TEST_ASSERT_EQUAL_INT64(1, q.count);
}

/* ---- order */

static uint32_t take_all(pf_edge_order *o, uint64_t now, uint32_t *numbers)
{
    pf_edge e;
    uint32_t n = 0;
    while (pf_edge_order_next(o, now, &e))
        numbers[n++] = e.number;
    return n;
}

static void test_edges_that_overtake_one_another_are_put_in_order(void)
{
    static const uint32_t come[] = {7, 8, 10, 9, 13, 12, 11, 14};
    pf_edge_order o = {0};
    uint32_t numbers[64], n = 0;
    for (uint32_t i = 0; i < 8; i++) {
        pf_edge_order_add(&o, &(pf_edge){.number = come[i], .time_ns = 1000});
        n += take_all(&o, 1000, numbers + n);
    }
    TEST_ASSERT_EQUAL_UINT32(8, n);
    for (uint32_t i = 0; i < 8; i++)
        TEST_ASSERT_EQUAL_UINT32(7 + i, numbers[i]);
    TEST_ASSERT_EQUAL_UINT32(0, o.late);
}

static void test_an_edge_that_does_not_come_is_waited_for_only_so_long(void)
{
    pf_edge_order o = {0};
    uint32_t numbers[64];
    pf_edge_order_add(&o, &(pf_edge){.number = 1, .time_ns = 1000});
    TEST_ASSERT_EQUAL_UINT32(1, take_all(&o, 1000, numbers));
    pf_edge_order_add(&o, &(pf_edge){.number = 3, .time_ns = 2000});
    TEST_ASSERT_EQUAL_UINT32(0, take_all(&o, 2000 + PF_EDGE_ORDER_WAIT_NS - 1, numbers));
    TEST_ASSERT_EQUAL_UINT32(1, take_all(&o, 2000 + PF_EDGE_ORDER_WAIT_NS, numbers));
    pf_edge_order_add(&o, &(pf_edge){.number = 2, .time_ns = 1500});
    TEST_ASSERT_EQUAL_UINT32(0, take_all(&o, UINT64_MAX, numbers));
    TEST_ASSERT_EQUAL_UINT32(1, o.late);
    for (uint32_t i = 0; i < PF_EDGE_ORDER_MAX; i++) /* a full window gives way at once */
        pf_edge_order_add(&o, &(pf_edge){.number = 6 + i, .time_ns = 3000});
    TEST_ASSERT_EQUAL_UINT32(PF_EDGE_ORDER_MAX, take_all(&o, 3000, numbers));
    TEST_ASSERT_EQUAL_UINT32(6, numbers[0]);
}

/* ---- history */

static void test_a_frame_gets_the_count_of_its_moment(void)
{
    static pf_history h;
    TEST_ASSERT_EQUAL_INT64(77, pf_history_at(&h, 5, 77));
    for (uint64_t i = 1; i <= 3 * PF_HISTORY; i++)
        pf_history_add(&h, 10 * i, (int64_t)i);
    TEST_ASSERT_EQUAL_INT64(3 * PF_HISTORY, pf_history_at(&h, UINT64_MAX, 0));
    TEST_ASSERT_EQUAL_INT64(3 * PF_HISTORY - 9, pf_history_at(&h, 10 * (3 * PF_HISTORY - 9) + 9, 0));
    TEST_ASSERT_EQUAL_INT64(3 * PF_HISTORY - 10, pf_history_at(&h, 10 * (3 * PF_HISTORY - 9) - 1, 0));
    TEST_ASSERT_EQUAL_INT64(2 * PF_HISTORY + 1, pf_history_at(&h, 1, 0)); /* the oldest that is remembered */
    pf_history_add(&h, 1, -5);                                            /* a clock that falls */
    TEST_ASSERT_EQUAL_INT64(-5, pf_history_at(&h, 30 * PF_HISTORY, 0));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_motion_is_counted_with_its_direction);
    RUN_TEST(test_a_start_at_any_levels_counts_from_there);
    RUN_TEST(test_bounces_end_where_they_began);
    RUN_TEST(test_lost_edges_of_a_steady_motion_are_bridged);
    RUN_TEST(test_lost_edges_that_fit_no_steady_motion_are_not_made_up);
    RUN_TEST(test_an_edge_to_the_level_that_is_there_does_not_count);
    RUN_TEST(test_numbers_wrap);
    RUN_TEST(test_samples_count_steps_and_name_jumps);
    RUN_TEST(test_edges_that_overtake_one_another_are_put_in_order);
    RUN_TEST(test_an_edge_that_does_not_come_is_waited_for_only_so_long);
    RUN_TEST(test_a_frame_gets_the_count_of_its_moment);
    return UNITY_END();
}
