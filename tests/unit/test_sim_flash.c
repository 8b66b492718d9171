/* The emulated flash memory does what its header says: its rules, and what each kind of power cut leaves. */
#include "pipefish/drivers/sim_flash.h"
#include "unity.h"

#include <string.h>

static pf_sim_flash *sim;
static pf_flash flash;
static uint8_t workspace[64 * 1024], bytes[4 * 256];

void tearDown(void) {}
void setUp(void)
{
    pf_sim_flash_config config = {.erase_size = 256, .program_size = 16, .sectors = 4, .seed = 3};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sim_flash_init(&sim, &flash, &config, workspace, sizeof workspace));
}

static pf_status program(uint32_t at, uint8_t value, uint32_t n)
{
    uint8_t data[256];
    memset(data, value, sizeof data);
    return flash.ops->program(flash.self, at, data, n);
}

static void look(void)
{
    TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->read(flash.self, 0, bytes, sizeof bytes));
}

static void test_the_rules_of_flash_memory_are_kept(void)
{
    look();
    TEST_ASSERT_EACH_EQUAL_HEX8(0xFF, bytes, sizeof bytes);
    TEST_ASSERT_EQUAL_INT(PF_OK, program(16, 0x11, 32));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, program(32, 0x11, 16)); /* not erased */
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, program(72, 0x11, 16)); /* not aligned */
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, program(64, 0x11, 8));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, program(240, 0x11, 32)); /* over a sector's end */
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, program(1024, 0x11, 16));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, flash.ops->erase(flash.self, 4));
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, flash.ops->read(flash.self, 1020, bytes, 5));
    TEST_ASSERT_EQUAL_UINT64(7, pf_sim_flash_get_stats(sim)->violations);
    TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->erase(flash.self, 0));
    TEST_ASSERT_EQUAL_INT(PF_OK, program(32, 0x22, 16));
    TEST_ASSERT_EQUAL_UINT32(1, pf_sim_flash_erases(sim, 0));
    TEST_ASSERT_EQUAL_UINT32(0, pf_sim_flash_erases(sim, 1));
    look();
    TEST_ASSERT_EQUAL_HEX8(0xFF, bytes[16]);
    TEST_ASSERT_EQUAL_HEX8(0x22, bytes[32]);
}

/* Three programs, the first one flushed; power fails at the third. What the second and the third left, as seen over
 * many seeds: bit 0 = not at all, bit 1 = whole, bit 2 = anything else. */
static void cut_thirds(pf_sim_cut kind, uint32_t seen[2])
{
    seen[0] = seen[1] = 0;
    for (uint64_t seed = 0; seed < 300; seed++) {
        setUp();
        pf_sim_flash_seed(sim, seed);
        pf_sim_flash_cut_after(sim, 3, kind);
        TEST_ASSERT_EQUAL_INT(PF_OK, program(0, 0x5A, 64));
        TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->flush(flash.self));
        TEST_ASSERT_EQUAL_INT(PF_OK, program(256, 0x5A, 64));
        TEST_ASSERT_EQUAL_INT(PF_ERR_IO, program(512, 0x5A, 64));
        TEST_ASSERT_TRUE(pf_sim_flash_is_off(sim));
        TEST_ASSERT_EQUAL_INT(PF_ERR_IO, flash.ops->read(flash.self, 0, bytes, 1));
        TEST_ASSERT_EQUAL_INT(PF_ERR_IO, flash.ops->flush(flash.self));
        pf_sim_flash_power_on(sim);
        look();
        TEST_ASSERT_EACH_EQUAL_HEX8(0x5A, bytes, 64);
        for (uint32_t i = 0; i < 2; i++) {
            uint32_t whole = 0, none = 0;
            for (uint32_t j = 0; j < 64; j++) {
                whole += bytes[256 * (i + 1) + j] == 0x5A;
                none += bytes[256 * (i + 1) + j] == 0xFF;
            }
            seen[i] |= none == 64 ? 1 : whole == 64 ? 2 : 4;
        }
        for (uint32_t i = 0; i < sizeof bytes; i++) /* outside of the operations nothing happens */
            if (i % 256 >= 64)
                TEST_ASSERT_EQUAL_HEX8(0xFF, bytes[i]);
    }
}

static void test_what_each_kind_of_cut_leaves(void)
{
    uint32_t seen[2];
    cut_thirds(PF_SIM_CUT_CLEAN, seen);
    TEST_ASSERT_EQUAL_UINT32(2, seen[0]);
    TEST_ASSERT_EQUAL_UINT32(1, seen[1]);
    cut_thirds(PF_SIM_CUT_TORN, seen);
    TEST_ASSERT_EQUAL_UINT32(2, seen[0]);
    TEST_ASSERT_TRUE(seen[1] & 2 && seen[1] & 4);
    cut_thirds(PF_SIM_CUT_REORDERED, seen);
    TEST_ASSERT_EQUAL_UINT32(3, seen[0]); /* the second may be missing although the third is there */
    TEST_ASSERT_EQUAL_UINT32(3, seen[1]);
    cut_thirds(PF_SIM_CUT_TAIL, seen);
    TEST_ASSERT_EQUAL_UINT32(2, seen[0]);
    TEST_ASSERT_EQUAL_UINT32(4, seen[1]);
}

/* Proves: an erase that power cuts is undone, partly done or noise, as its kind says. */
static void test_cut_erases(void)
{
    for (uint32_t kind = 0; kind < PF_SIM_CUTS; kind++) {
        uint32_t old = 0, erased = 0, rest = 0;
        for (uint64_t seed = 0; seed < 100; seed++) {
            setUp();
            pf_sim_flash_seed(sim, seed);
            TEST_ASSERT_EQUAL_INT(PF_OK, program(0, 0x00, 256));
            TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->flush(flash.self));
            pf_sim_flash_cut_after(sim, 0, (pf_sim_cut)kind);
            TEST_ASSERT_EQUAL_INT(PF_ERR_IO, flash.ops->erase(flash.self, 0));
            pf_sim_flash_power_on(sim);
            look();
            uint32_t zeros = 0, ones = 0;
            for (uint32_t i = 0; i < 256; i++) {
                zeros += bytes[i] == 0x00;
                ones += bytes[i] == 0xFF;
            }
            old += zeros == 256;
            erased += ones == 256;
            rest += zeros < 256 && ones < 256;
        }
        if (kind == PF_SIM_CUT_CLEAN)
            TEST_ASSERT_EQUAL_UINT32(100, old);
        else if (kind == PF_SIM_CUT_REORDERED)
            TEST_ASSERT_TRUE(old > 20 && erased > 20 && rest == 0);
        else
            TEST_ASSERT_TRUE(rest > 80);
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_the_rules_of_flash_memory_are_kept);
    RUN_TEST(test_what_each_kind_of_cut_leaves);
    RUN_TEST(test_cut_erases);
    return UNITY_END();
}
