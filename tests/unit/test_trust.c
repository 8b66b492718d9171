#include "pipefish/drivers/trust.h"
#include "tls/gate.h"
#include "unity.h"

#include <arpa/inet.h>
#include <stdio.h>
#include <string.h>

#define SECOND UINT64_C(1000000000)

static pf_peers peers;
static char error[128];

void setUp(void)
{
    memset(&peers, 0, sizeof peers);
    memset(error, 0, sizeof error);
}

void tearDown(void) {}

static void key_of(unsigned seed, uint8_t key[32])
{
    for (unsigned i = 0; i < 32; i++)
        key[i] = (uint8_t)(seed * 7 + i * 13 + (seed >> 8));
}

/* Proves: what is printed is read again, hosts, roles and names, to the fullest table. */
static void test_a_full_table_survives_its_text(void)
{
    static char text[PF_PEERS_BYTES];
    pf_peers again;
    for (unsigned i = 0; i < PF_PEERS_MAX; i++) {
        uint8_t key[32];
        char name[PF_PEER_NAME_MAX];
        key_of(i, key);
        (void)snprintf(name, sizeof name, "%047u", i);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_peers_set(&peers, key, (pf_role)(PF_ROLE_REVOKED + i % 4), name));
    }
    size_t n = pf_peers_print(&peers, text, sizeof text);
    TEST_ASSERT_EQUAL_size_t(strlen(text), n);
    TEST_ASSERT_LESS_THAN_size_t(sizeof text - 1, n);
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_peers_parse(&again, text, n, error, sizeof error), error);
    TEST_ASSERT_EQUAL_MEMORY(&peers, &again, sizeof peers);
    uint8_t key[32];
    key_of(PF_PEERS_MAX, key);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_peers_set(&peers, key, PF_ROLE_VIEWER, "one more"));
}

/* Proves: a key that was revoked stays so, another is changed in its place. */
static void test_revocation_is_for_ever(void)
{
    uint8_t key[32], other[32];
    key_of(1, key);
    key_of(2, other);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_peers_set(&peers, key, PF_ROLE_VIEWER, "a"));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_peers_set(&peers, key, PF_ROLE_CALIBRATOR, "b"));
    TEST_ASSERT_EQUAL_UINT32(1, peers.count);
    TEST_ASSERT_EQUAL_INT(PF_ROLE_CALIBRATOR, pf_peers_find(&peers, key)->role);
    TEST_ASSERT_EQUAL_STRING("b", pf_peers_find(&peers, key)->name);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_peers_set(&peers, key, PF_ROLE_REVOKED, "lost"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, pf_peers_set(&peers, key, PF_ROLE_VIEWER, "found"));
    TEST_ASSERT_NULL(pf_peers_find(&peers, other));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_peers_set(&peers, other, PF_ROLE_NONE, "x"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_peers_set(&peers, other, PF_ROLE_VIEWER, "x\ny"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_peers_set(&peers, other, PF_ROLE_VIEWER, ""));
}

static pf_status parse(const char *text)
{
    return pf_peers_parse(&peers, text, strlen(text), error, sizeof error);
}

/* Proves: comments and empty lines are left out, a last line needs no end, and each damage is told with its line. */
static void test_lines_of_the_file(void)
{
#define KEY "00112233445566778899aabbccddeeff00112233445566778899AABBCCDDEEFF"
    TEST_ASSERT_EQUAL_INT(PF_OK, parse("# ours\n\noperator " KEY " Anna's laptop"));
    TEST_ASSERT_EQUAL_UINT32(1, peers.count);
    TEST_ASSERT_EQUAL_HEX8(0xff, peers.peer[0].key[31]);
    TEST_ASSERT_EQUAL_STRING("Anna's laptop", peers.peer[0].name);
    static const char *const bad[] = {
        "\noperator\n",
        "\noperator " KEY "\n",
        "\noperator " KEY "  x\n",
        "\nking " KEY " x\n",
        "\n operator " KEY " x\n",
        "\nnone " KEY " x\n",
        "\noperator 0" KEY " x\n",
        "\noperator " KEY " x\t\n",
        "\noperator " KEY " x\r\n",
    };
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_ERR_FORMAT, parse(bad[i]), bad[i]);
        TEST_ASSERT_EQUAL_INT_MESSAGE(0, strncmp(error, "line 2: ", 8), error);
    }
    /* Cut anywhere, a line is none, except where only its name is shorter. */
    static const char whole[] = "viewer " KEY " x";
    for (size_t n = 1; n + 1 < sizeof whole; n++)
        TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, pf_peers_parse(&peers, whole, n, error, sizeof error));
}

static pf_address numeric(const char *text)
{
    pf_address a;
    memset(&a, 0, sizeof a);
    if (inet_pton(AF_INET, text, &a.v4.sin_addr) == 1)
        a.v4.sin_family = AF_INET;
    else if (inet_pton(AF_INET6, text, &a.v6.sin6_addr) == 1)
        a.v6.sin6_family = AF_INET6;
    return a;
}

/* The device is at fe80::5 on its cable and at 2001:db8:1::5 in the house. */
static void address_of(const char *text, uint8_t address[16])
{
    const pf_address peer = numeric(text), own = numeric(strncmp(text, "fe80", 4) == 0 ? "fe80::5" : "2001:db8:1::5");
    pf_gate_address(&peer, &own, address);
}

/* Proves: five failures in a minute shut one address and no other, for the rest of that minute. */
static void test_the_gate_shuts_after_five_failures_and_opens_again(void)
{
    pf_gate gate;
    uint8_t a[16], b[16];
    memset(&gate, 0, sizeof gate);
    address_of("10.0.0.1", a);
    address_of("10.0.0.2", b);
    for (unsigned i = 0; i < PF_GATE_FAILURES; i++) {
        TEST_ASSERT_TRUE(pf_gate_is_open(&gate, a, i * SECOND));
        pf_gate_note_failure(&gate, a, i * SECOND);
    }
    TEST_ASSERT_FALSE(pf_gate_is_open(&gate, a, 59 * SECOND));
    TEST_ASSERT_TRUE(pf_gate_is_open(&gate, b, 59 * SECOND));
    TEST_ASSERT_TRUE(pf_gate_is_open(&gate, a, 60 * SECOND));
    pf_gate_note_failure(&gate, a, 61 * SECOND); /* the count begins anew */
    TEST_ASSERT_TRUE(pf_gate_is_open(&gate, a, 61 * SECOND));
}

/* Proves: a flood from many addresses does not open the gate for one that is shut, and an IPv6 subscriber counts once.
 */
static void test_a_flood_of_addresses_does_not_wash_out_one_that_is_shut(void)
{
    pf_gate gate;
    uint8_t bad[16], other[16], same[16];
    char text[40];
    memset(&gate, 0, sizeof gate);
    address_of("2001:db8:1:2::1", bad);
    address_of("2001:db8:1:2:ffff::9", same);
    TEST_ASSERT_EQUAL_MEMORY(bad, same, 16);
    address_of("::ffff:10.0.0.1", same);
    address_of("10.0.0.1", other);
    TEST_ASSERT_EQUAL_MEMORY(other, same, 16);
    for (unsigned i = 0; i < PF_GATE_FAILURES; i++)
        pf_gate_note_failure(&gate, bad, SECOND);
    for (unsigned i = 0; i < 1000; i++) {
        (void)snprintf(text, sizeof text, "10.1.%u.%u", i / 250, i % 250);
        address_of(text, other);
        pf_gate_note_failure(&gate, other, 2 * SECOND);
    }
    TEST_ASSERT_FALSE(pf_gate_is_open(&gate, bad, 3 * SECOND));
}

/* Proves: who fails on purpose does not shut the device to his neighbours, who have the first half of their addresses
 * in common with him and with the device. */
static void test_a_neighbour_on_the_link_is_another_address(void)
{
    static const char *const pairs[][2] = {{"2001:db8:1::66", "2001:db8:1::7"}, {"fe80::66", "fe80::7"}};
    for (size_t i = 0; i < 2; i++) {
        pf_gate gate;
        uint8_t bad[16], good[16];
        memset(&gate, 0, sizeof gate);
        address_of(pairs[i][0], bad);
        address_of(pairs[i][1], good);
        for (unsigned k = 0; k < PF_GATE_FAILURES; k++)
            pf_gate_note_failure(&gate, bad, SECOND);
        TEST_ASSERT_FALSE(pf_gate_is_open(&gate, bad, 2 * SECOND));
        TEST_ASSERT_TRUE(pf_gate_is_open(&gate, good, 2 * SECOND));
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_a_full_table_survives_its_text);
    RUN_TEST(test_revocation_is_for_ever);
    RUN_TEST(test_lines_of_the_file);
    RUN_TEST(test_the_gate_shuts_after_five_failures_and_opens_again);
    RUN_TEST(test_a_flood_of_addresses_does_not_wash_out_one_that_is_shut);
    RUN_TEST(test_a_neighbour_on_the_link_is_another_address);
    return UNITY_END();
}
