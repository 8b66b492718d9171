/* The A/B store of profiles on an emulated flash memory.
 *
 * Proves: whatever the moment and the kind of a power cut, and of a second one while the device recovers from it, what
 * is loaded is the old profile or the new one, never neither; the next write succeeds; and the store keeps to the rules
 * of flash memory. Wear spreads; flipped bits never bring another profile.
 * Does not prove: behaviour of a memory that says "flushed" and lies. */
#include "pipefish/drivers/sim_flash.h"
#include "pipefish/profile.h"
#include "pipefish/profile_store.h"
#include "unity.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

void setUp(void) {}
void tearDown(void) {}

static const struct {
    uint32_t erase_size, program_size, sectors;
} GEOMETRY[] = {
    {4096, 256, 6},      /* serial NOR flash */
    {128 * 1024, 32, 4}, /* a microcontroller's own */
    {512, 1, 34},        /* EEPROM */
    {8192, 8, 4},        /* a small one's own */
};
#define GEOMETRIES (sizeof GEOMETRY / sizeof GEOMETRY[0])

/* The one under test, and two to come back to. */
enum { TEST = 0, PREPARED = 1, CUT_ONCE = 2, SIMS = 3 };
static pf_sim_flash *sims[SIMS], *sim;
static pf_flash flash;
static uint8_t workspaces[SIMS][2 << 20], scratch[4096];
static pf_profile_store store;

static void make_flash_of(uint32_t erase_size, uint32_t program_size, uint32_t sectors, bool is_dirty)
{
    pf_sim_flash_config config = {.erase_size = erase_size,
                                  .program_size = program_size,
                                  .sectors = sectors,
                                  .seed = 1,
                                  .starts_dirty = is_dirty};
    for (int i = SIMS - 1; i >= 0; i--)
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_sim_flash_init(&sims[i], &flash, &config, workspaces[i], sizeof workspaces[i]));
    sim = sims[TEST];
    TEST_ASSERT_TRUE(pf_profile_store_scratch_size(&flash) > 0 &&
                     pf_profile_store_scratch_size(&flash) <= sizeof scratch);
}

static void make_flash(size_t geometry)
{
    make_flash_of(GEOMETRY[geometry].erase_size, GEOMETRY[geometry].program_size, GEOMETRY[geometry].sectors, false);
}

/* Profiles are told apart by number: their bytes are a function of it. 0 = none. */
#define LARGEST 8192u

static size_t bytes_of(int number, uint8_t *bytes)
{
    static const size_t size[] = {0, 700, 1500, 2500, 1, 1324, 900, 600, LARGEST};
    size_t n = size[number];
    uint32_t state = (uint32_t)number;
    for (size_t i = 0; i < n; i++) {
        state = state * 1664525u + 1013904223u;
        bytes[i] = (uint8_t)(state >> 24);
    }
    return n;
}

/* The number of the profile that is loaded; 0 = none, -1 = unknown bytes. */
static int loaded(bool *is_trial)
{
    static uint8_t bytes[LARGEST], expected[LARGEST];
    size_t n = 0;
    pf_status status = pf_profile_store_load(&store, bytes, sizeof bytes, &n, is_trial);
    if (status == PF_ERR_END)
        return 0;
    if (status != PF_OK)
        return -1;
    for (int number = 1; number <= 8; number++)
        if (bytes_of(number, expected) == n && memcmp(bytes, expected, n) == 0)
            return number;
    return -1;
}

static pf_status write_number(int number, uint8_t starts)
{
    static uint8_t bytes[LARGEST];
    size_t n = bytes_of(number, bytes);
    return pf_profile_store_write(&store, bytes, n, starts);
}

static void reopen(void)
{
    pf_sim_flash_power_on(sim);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_open(&store, &flash, scratch));
}

/* ------------------------------------------------------------------------------------------ without faults */

/* Proves: the life of a profile: trial, confirmation, expiry, going back; on every geometry, and on a memory that was
 * never erased. */
static void test_trial_confirm_and_revert(void)
{
    for (size_t g = 0; g < 2 * GEOMETRIES; g++) {
        bool is_trial = false;
        make_flash_of(GEOMETRY[g / 2].erase_size, GEOMETRY[g / 2].program_size, GEOMETRY[g / 2].sectors, g % 2);
        reopen();
        TEST_ASSERT_EQUAL_INT(0, loaded(NULL));
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, pf_profile_store_confirm(&store));
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, pf_profile_store_revert(&store));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_start(&store));

        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1, 2)); /* two starts on trial, then gone: there was none before */
        for (int start = 0; start < 3; start++) {
            TEST_ASSERT_EQUAL_INT(1, loaded(&is_trial));
            TEST_ASSERT_TRUE(is_trial);
            reopen();
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_start(&store));
        }
        TEST_ASSERT_EQUAL_INT(0, loaded(NULL));

        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(2, 0));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        reopen();
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_start(&store));
        TEST_ASSERT_EQUAL_INT(2, loaded(&is_trial));
        TEST_ASSERT_FALSE(is_trial);

        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(3, 5));
        TEST_ASSERT_EQUAL_INT(3, loaded(NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_revert(&store));
        TEST_ASSERT_EQUAL_INT(2, loaded(NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(4, 5)); /* over the dropped one, then over a trial */
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(5, 5));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        TEST_ASSERT_EQUAL_INT(5, loaded(NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_revert(&store)); /* to the one before, and forth */
        TEST_ASSERT_EQUAL_INT(2, loaded(NULL));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_revert(&store));
        TEST_ASSERT_EQUAL_INT(5, loaded(NULL));
        reopen();
        TEST_ASSERT_EQUAL_INT(5, loaded(&is_trial));
        TEST_ASSERT_FALSE(is_trial);
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(8, 0));
        TEST_ASSERT_EQUAL_INT(8, loaded(&is_trial));
        TEST_ASSERT_TRUE(is_trial);
        TEST_ASSERT_EQUAL_UINT64(0, pf_sim_flash_get_stats(sim)->violations);
    }
}

/* Proves: both slots and both logs wear alike, and the store's own counts are the memory's. */
static void test_wear_is_spread_and_counted(void)
{
    for (size_t g = 0; g < GEOMETRIES; g++) {
        make_flash(g);
        reopen();
        for (int i = 0; i < 200; i++) {
            TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1 + i % 5, 1));
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        }
        reopen();
        uint32_t a = 2, b = a + (flash.sectors - 2) / 2;
        TEST_ASSERT_EQUAL_UINT32(100, pf_sim_flash_erases(sim, a));
        TEST_ASSERT_EQUAL_UINT32(100, pf_sim_flash_erases(sim, b));
        TEST_ASSERT_EQUAL_UINT32(100, store.state.slot_erases[0]);
        TEST_ASSERT_EQUAL_UINT32(100, store.state.slot_erases[1]);
        for (uint32_t log = 0; log < 2; log++)
            TEST_ASSERT_EQUAL_UINT32(pf_sim_flash_erases(sim, log), store.state.log_erases[log]);
        TEST_ASSERT_EQUAL_UINT32(pf_sim_flash_erases(sim, 0), pf_sim_flash_erases(sim, 1));
        TEST_ASSERT_EQUAL_UINT64(0, pf_sim_flash_get_stats(sim)->violations);
    }
}

/* Proves: geometries that cannot hold a store, and misuse, are refused. */
static void test_refusals(void)
{
    static const struct {
        uint32_t erase_size, program_size, sectors;
        bool fits;
    } item[] = {{4096, 256, 6, true},    {4096, 256, 5, false},     {4096, 0, 6, false},   {4096, 100, 6, false},
                {512, 1, 33, false},     {32, 32, 1000, false},     {64, 64, 258, true},   {4096, 4096, 6, true},
                {1u << 25, 1, 4, false}, {1u << 24, 1, 300, false}, {4096, 8192, 6, false}};
    uint8_t byte = 0;
    size_t n;
    for (size_t i = 0; i < sizeof item / sizeof item[0]; i++) {
        pf_flash f = {NULL, NULL, item[i].erase_size, item[i].program_size, item[i].sectors};
        TEST_ASSERT_EQUAL(item[i].fits, pf_profile_store_scratch_size(&f) > 0);
        if (!item[i].fits)
            TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_store_open(&store, &f, scratch));
    }
    make_flash(0);
    reopen();
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_store_write(&store, &byte, 0, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_store_write(&store, workspaces[1], LARGEST + 1, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_store_write(&store, NULL, 1, 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1, 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_profile_store_load(&store, scratch, 100, &n, NULL));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_store_open(&store, &flash, NULL));

    uint8_t record[64]; /* a newer program's: its profiles must not be overwritten */
    TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->read(flash.self, 0, record, sizeof record));
    record[4] = 2;
    uint32_t crc = pf_crc32c(0, record, 60);
    for (int i = 0; i < 4; i++)
        record[60 + i] = (uint8_t)(crc >> (8 * i));
    memset(scratch, 0xFF, 256);
    memcpy(scratch, record, sizeof record);
    TEST_ASSERT_EQUAL_INT(PF_OK, flash.ops->program(flash.self, 256, scratch, 256));
    TEST_ASSERT_EQUAL_INT(PF_ERR_VERSION, pf_profile_store_open(&store, &flash, scratch));
}

/* Proves: a sector that has died makes the write fail, and the profile that was there stays. */
static void test_a_bad_sector_is_an_error_and_loses_nothing(void)
{
    for (uint32_t bad = 1; bad <= 6; bad++) {
        make_flash(0);
        reopen();
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1, 1));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        pf_sim_flash_break(sim, bad - 1);
        reopen();
        TEST_ASSERT_EQUAL_INT(1, loaded(NULL));
        pf_status status = write_number(2, 1);
        reopen();
        if (bad <= 2) /* a log: the other one may have the record already */
            TEST_ASSERT_TRUE(status == PF_ERR_IO && (loaded(NULL) == 1 || loaded(NULL) == 2));
        else /* 3 and 4 are the slot in use */
            TEST_ASSERT_TRUE(bad <= 4 ? status == PF_OK && loaded(NULL) == 2
                                      : status == PF_ERR_IO && loaded(NULL) == 1);
    }
}

/* Proves: what the memory stored wrongly without a word is noticed by reading it back, in the profile and in
 * each copy of the record. */
static void test_silent_errors_of_the_memory_are_noticed(void)
{
    uint32_t noticed = 0;
    for (uint64_t operation = 0; operation < 20; operation++) {
        make_flash_of(512, 4, 34, false);
        reopen();
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1, 1));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        pf_sim_flash_seed(sim, operation);
        pf_sim_flash_spoil_after(sim, 16 + operation);
        pf_status status = write_number(2, 1); /* 16 erases, 6 programs, a flush, then twice the record and a flush */
        noticed += status == PF_ERR_IO;
        TEST_ASSERT_TRUE(status == (operation < 10 ? PF_ERR_IO : PF_OK));
        reopen();
        TEST_ASSERT_TRUE(loaded(NULL) == 1 || (loaded(NULL) == 2 && operation > 6));
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(3, 1));
        TEST_ASSERT_EQUAL_INT(3, loaded(NULL));
    }
    TEST_ASSERT_EQUAL_UINT32(10, noticed);
}

/* ---------------------------------------------------------------------------------------------- power cuts */

typedef enum step { END, WRITE_2, WRITE_3, WRITE_4, START, CONFIRM, REVERT, LOAD } step;

/* Profiles come on trial to be confirmed, taken back, or dropped by a start; trials are written over, and what was
 * active before comes back. The third begins with an empty store. */
static const step STORY[][12] = {
    {WRITE_2, START, LOAD, CONFIRM, WRITE_3, CONFIRM, REVERT, LOAD, START},
    {WRITE_2, START, REVERT, WRITE_3, START, LOAD, WRITE_4, WRITE_2, CONFIRM},
    {WRITE_2, WRITE_3, START, LOAD, WRITE_4, START, START, LOAD},
};
#define STORIES (sizeof STORY / sizeof STORY[0])
#define STEPS   12

static pf_status do_step(step s)
{
    switch (s) {
    case WRITE_2:
        return write_number(2, 1);
    case WRITE_3:
        return write_number(3, 0);
    case WRITE_4:
        return write_number(4, 1);
    case START:
        if (pf_profile_store_open(&store, &flash, scratch) != PF_OK)
            return PF_ERR_IO;
        return pf_profile_store_start(&store);
    case CONFIRM:
        return pf_profile_store_confirm(&store);
    case REVERT:
        return pf_profile_store_revert(&store);
    case LOAD:
    case END:
        break;
    }
    return loaded(NULL) >= 0 ? PF_OK : PF_ERR_CHECKSUM;
}

/* What may be loaded after a cut: what was loaded before the step, what is loaded after it, and where a profile on
 * trial is being replaced also the confirmed one, for the trial ends before its place is erased. */
typedef struct outcomes {
    int before, after, confirmed;
} outcomes;

static int confirmed(void)
{
    pf_profile_store kept = store;
    store.state.trial = PF_PROFILE_STORE_NONE;
    int number = loaded(NULL);
    store = kept;
    return number;
}

/* Runs the story without a cut. */
static void learn(const step *story, outcomes *o)
{
    for (int i = 0; i < STEPS && story[i] != END; i++) {
        bool is_trial = false;
        o[i].before = loaded(&is_trial);
        bool is_replaced = is_trial && (story[i] == WRITE_2 || story[i] == WRITE_3 || story[i] == WRITE_4);
        o[i].confirmed = is_replaced ? confirmed() : o[i].before;
        pf_status status = do_step(story[i]);
        TEST_ASSERT_TRUE_MESSAGE(status == PF_OK || status == PF_ERR_END, "a step failed without a cut");
        o[i].after = loaded(NULL);
    }
}

/* A device with profile 1 confirmed (or nothing), whose logs have room for `records` more: they are erased during the
 * story, early or late. */
static void prepare(size_t geometry, size_t story, uint32_t records)
{
    make_flash(geometry);
    reopen();
    if (story == 2)
        return;
    TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1, 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
    TEST_ASSERT_EQUAL_INT(PF_OK, write_number(5, 1));
    while (store.per_sector - store.next[0] > records) /* a start of a trial is a record */
        if (pf_profile_store_start(&store) != PF_OK || store.state.trial == PF_PROFILE_STORE_NONE)
            TEST_ASSERT_EQUAL_INT(PF_OK, write_number(5, 255));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_revert(&store));
}

static uint64_t cuts; /* that happened */

static bool is_among(int number, const outcomes *o)
{
    return number >= 0 && (number == o->before || number == o->after || number == o->confirmed);
}

/* Whether every slot that the record names holds what it says. */
static bool is_whole(void)
{
    bool is_trial = false, has_trial = store.state.trial != PF_PROFILE_STORE_NONE;
    int number = loaded(&is_trial);
    pf_profile_store kept = store;
    if (store.state.previous != PF_PROFILE_STORE_NONE) {
        store.state.active = store.state.previous;
        number = confirmed() < 0 ? -1 : number;
        store = kept;
    }
    return number >= 0 && confirmed() >= 0 && (!has_trial || is_trial);
}

static void fail_at(const char *what, const uint64_t place[6])
{
    char text[200];
    (void)snprintf(text, sizeof text, "%s: geometry %d, story %d, kinds %d %d, cuts at operations %d and %d", what,
                   (int)place[0], (int)place[1], (int)place[2], (int)place[3], (int)place[4], (int)place[5]);
    TEST_FAIL_MESSAGE(text);
}

/* Power is back after the first cut; the device starts, and takes profile 6. If power fails again at operation
 * `second`, it does so once more and takes profile 7. False: it did not fail. */
static bool recover(const outcomes *o, uint64_t second, uint32_t kind, const uint64_t place[6])
{
    pf_sim_flash_power_on(sim);
    if (pf_profile_store_open(&store, &flash, scratch) != PF_OK || !is_among(loaded(NULL), o))
        fail_at("neither the old nor the new profile", place);
    if (!is_whole())
        fail_at("the record names a slot that is not whole", place);
    outcomes again = {.before = loaded(NULL), .after = 6, .confirmed = confirmed()};
    pf_sim_flash_cut_after(sim, second, (pf_sim_cut)kind);
    bool is_done = do_step(START) == PF_OK && write_number(6, 1) == PF_OK && pf_profile_store_confirm(&store) == PF_OK;
    bool is_cut = pf_sim_flash_is_off(sim);
    if (is_cut) {
        cuts++;
        pf_sim_flash_power_on(sim);
        if (pf_profile_store_open(&store, &flash, scratch) != PF_OK || !is_among(loaded(NULL), &again))
            fail_at("after the second cut neither the old nor the new profile", place);
        is_done = pf_profile_store_start(&store) == PF_OK && write_number(7, 1) == PF_OK &&
                  pf_profile_store_confirm(&store) == PF_OK;
    }
    if (!is_done || loaded(NULL) != (is_cut ? 7 : 6))
        fail_at("the next write does not succeed", place);
    if (pf_sim_flash_get_stats(sim)->violations != 0)
        fail_at("a rule of flash memory was broken", place);
    return is_cut;
}

/* Every cut of a story, and after each one every cut of the recovery whose number is a multiple of `stride`. */
static void cut_everywhere(size_t geometry, size_t story, uint32_t kind, uint32_t second_kind, uint64_t stride)
{
    outcomes o[STEPS];
    prepare(geometry, story, 3 + 2 * kind);
    pf_sim_flash_copy(sims[PREPARED], sim);
    learn(STORY[story], o);
    for (uint64_t first = 0;; first++) {
        uint64_t place[6] = {geometry, story, kind, second_kind, first, UINT64_MAX};
        pf_sim_flash_copy(sim, sims[PREPARED]);
        pf_sim_flash_seed(sim, first * 1000 + kind);
        reopen();
        pf_sim_flash_cut_after(sim, first, (pf_sim_cut)kind);
        int i = 0;
        while (i < STEPS && STORY[story][i] != END && !pf_sim_flash_is_off(sim))
            (void)do_step(STORY[story][i++]);
        if (!pf_sim_flash_is_off(sim))
            break;
        cuts++;
        pf_sim_flash_copy(sims[CUT_ONCE], sim);
        (void)recover(&o[i - 1], UINT64_MAX, kind, place);
        for (uint64_t second = first % stride;; second += stride) {
            place[5] = second;
            pf_sim_flash_copy(sim, sims[CUT_ONCE]);
            pf_sim_flash_seed(sim, first * 1000 + second);
            if (!recover(&o[i - 1], second, second_kind, place))
                break;
        }
    }
}

/* PIPEFISH_TEST_LONG takes every pair, the second cut of the same kind and of another; otherwise every seventh second
 * cut, a different one after each first. */
static void test_every_cut_and_every_pair_of_cuts(void)
{
    bool is_long = getenv("PIPEFISH_TEST_LONG") != NULL;
    clock_t begin = clock(); /* processor time */
    for (size_t geometry = 0; geometry < GEOMETRIES; geometry++)
        for (uint32_t story = 0; story < STORIES; story++)
            for (uint32_t kind = 0; kind < PF_SIM_CUTS; kind++) {
                uint32_t other = (kind + 1 + story) % PF_SIM_CUTS;
                cut_everywhere(geometry, story, kind, is_long || geometry % 2 ? kind : other, is_long ? 1 : 7);
                if (is_long)
                    cut_everywhere(geometry, story, kind, other, 1);
            }
    (void)printf("power cuts: %llu in %.1f s\n", (unsigned long long)cuts, (double)(clock() - begin) / CLOCKS_PER_SEC);
    TEST_ASSERT_TRUE(cuts >= (is_long ? 100000 : 10000));
}

/* ------------------------------------------------------------------------------------------- flipped bits */

static uint8_t real_bytes[2][PF_PROFILE_BINARY_MAX];
static size_t real_n[2];
static pf_profile real[2];

static void make_profiles(void)
{
    for (int i = 0; i < 2; i++) {
        pf_profile *p = &real[i];
        memset(p, 0, sizeof *p);
        p->camera.width = 1280;
        p->camera.height = 960;
        p->camera.f_u = p->camera.f_v = 300 + i;
        p->camera.c_u = 640;
        p->camera.c_v = 480;
        p->camera.theta_max = 1.6;
        p->free_count = 9;
        for (uint32_t j = 0; j < p->free_count; j++) {
            p->free_param[j] = (uint8_t)j;
            p->covariance[j * (j + 1) / 2 + j] = 1e-3;
        }
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_encode(p, real_bytes[i], PF_PROFILE_BINARY_MAX, &real_n[i], NULL));
    }
}

/* What a device would use: 0 or 1, or -1 = none, with the store's and the profile's own checks passed. */
static int in_use(void)
{
    static uint8_t bytes[LARGEST];
    static pf_profile profile;
    size_t n = 0;
    if (pf_profile_store_open(&store, &flash, scratch) != PF_OK ||
        pf_profile_store_load(&store, bytes, sizeof bytes, &n, NULL) != PF_OK ||
        pf_profile_decode(bytes, n, &profile, NULL) != PF_OK)
        return -1;
    for (int i = 0; i < 2; i++)
        if (n == real_n[i] && memcmp(bytes, real_bytes[i], n) == 0)
            return i;
    return 2;
}

/* Proves: with 1 to 8 flipped bits anywhere, the device has the profile that it had, or, if the bits are in the
 * profile, none (one that is on trial: the confirmed one); never an altered one, and never one that had been replaced.
 * One flipped bit outside the profile does no harm at all. */
static void test_flipped_bits_bring_no_other_profile(void)
{
    uint32_t rounds = getenv("PIPEFISH_TEST_LONG") ? 1000000 : 20000, state = 7, harmless = 0, refused = 0;
    make_profiles();
    for (uint32_t is_trial = 0; is_trial < 2; is_trial++) {
        make_flash(3);
        reopen();
        for (int i = 0; i < 2; i++) { /* 0 first, then 1: 0 lies intact in the other slot */
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_write(&store, real_bytes[i], real_n[i], 1));
            if (i == 0 || !is_trial)
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        }
        uint32_t size = flash.erase_size * flash.sectors, slot = 1, at = (2 + slot) * flash.erase_size;
        TEST_ASSERT_EQUAL_INT(1, in_use());
        for (uint32_t round = 0; round < rounds / 2; round++) {
            uint64_t bits[8];
            uint32_t n = 1 + round % 8, in_profile = 0, in_logs = 0;
            for (uint32_t i = 0; i < n; i++) {
                state = state * 1664525u + 1013904223u;
                bits[i] = (uint64_t)(state >> 3) % (8u * size);
                if (round % 2) /* aim at what matters: the profile, or the used part of the logs */
                    bits[i] = 8u * (round % 4 == 1 ? at : (i % 2) * flash.erase_size) +
                              bits[i] % (8 * (round % 4 == 1 ? real_n[1] : 64u * store.next[0]));
                in_profile += bits[i] / 8 >= at && bits[i] / 8 < at + real_n[1];
                in_logs += bits[i] / 8 < 2 * flash.erase_size;
                pf_sim_flash_flip(sim, bits[i]);
            }
            int number = in_use();
            if (number != 1) {
                TEST_ASSERT_TRUE_MESSAGE(number == -1 || (number == 0 && is_trial && in_profile > 0) ||
                                             (in_logs > 1 && number != 2),
                                         "another profile was accepted");
                TEST_ASSERT_TRUE_MESSAGE(in_profile > 0 || in_logs > 1, "bits that do not matter did harm");
                refused++;
            } else {
                harmless++;
            }
            for (uint32_t i = 0; i < n; i++)
                pf_sim_flash_flip(sim, bits[i]);
        }
        TEST_ASSERT_EQUAL_INT(1, in_use());
    }
    (void)printf("flipped bits: %u rounds, refused %u, harmless %u\n", rounds, refused, harmless);
    TEST_ASSERT_TRUE(refused > rounds / 5 && harmless > rounds / 5);
}

/* Proves: a damaged copy of the record is written again at the next start, so that it may be the other one's turn. */
static void test_a_damaged_record_is_repaired(void)
{
    for (uint32_t log = 0; log < 2; log++) {
        make_flash(0);
        reopen();
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(1, 1));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
        for (uint32_t turn = 0; turn < 2; turn++) {
            uint32_t damaged = (log + turn) % 2;
            pf_sim_flash_flip(sim, 8 * (damaged * flash.erase_size + (store.next[damaged] - 1) * 256u + 13));
            reopen();
            TEST_ASSERT_EQUAL_UINT8(0, store.state.active);
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_start(&store));
        }
        TEST_ASSERT_EQUAL_INT(1, loaded(NULL));
    }
}

/* Proves: a damaged profile is not given out, nor is the one before it, until somebody says so; a new one can be
 * written. */
static void test_a_damaged_profile_is_refused_and_can_be_replaced(void)
{
    size_t n = 0;
    make_flash(0);
    reopen();
    for (int number = 1; number <= 2; number++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, write_number(number, 1));
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_confirm(&store));
    }
    pf_sim_flash_flip(sim, 8 * 4 * 4096 + 77);
    reopen();
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_start(&store));
    TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, pf_profile_store_load(&store, workspaces[1], LARGEST, &n, NULL));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_revert(&store));
    TEST_ASSERT_EQUAL_INT(1, loaded(NULL));
    TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, pf_profile_store_revert(&store));
    TEST_ASSERT_EQUAL_INT(PF_OK, write_number(3, 1));
    pf_sim_flash_flip(sim, 8 * 4 * 4096 + 77);
    TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, pf_profile_store_confirm(&store));
    TEST_ASSERT_EQUAL_INT(1, loaded(NULL));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_store_start(&store));
    TEST_ASSERT_EQUAL_UINT8(PF_PROFILE_STORE_NONE, store.state.trial);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_trial_confirm_and_revert);
    RUN_TEST(test_wear_is_spread_and_counted);
    RUN_TEST(test_refusals);
    RUN_TEST(test_a_bad_sector_is_an_error_and_loses_nothing);
    RUN_TEST(test_silent_errors_of_the_memory_are_noticed);
    RUN_TEST(test_a_damaged_record_is_repaired);
    RUN_TEST(test_a_damaged_profile_is_refused_and_can_be_replaced);
    RUN_TEST(test_flipped_bits_bring_no_other_profile);
    RUN_TEST(test_every_cut_and_every_pair_of_cuts);
    return UNITY_END();
}
