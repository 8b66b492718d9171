/* The spool where SQLite says that there is no memory: there is none, or a damaged row asks for more than there can be.
 */
#include "spool_medium.h"

/* Where in the file the name of object `id` of put_small() lies, beside its bytes. */
static uint8_t *find_name(uint8_t *file, size_t size, uint64_t id)
{
    uint8_t bytes[300], name[32];
    memset(bytes, (int)id, sizeof bytes);
    memcpy(bytes, &id, sizeof id);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256(bytes, sizeof bytes, name));
    uint8_t *at = file;
    while ((at = memmem(at, (size_t)(file + size - at), name, sizeof name)) != NULL)
        if (memcmp(at + sizeof name, bytes, sizeof bytes) == 0) /* not its entry in the index of names */
            return at;
        else
            at++;
    TEST_FAIL_MESSAGE("no such object");
    return NULL;
}

/* Gives its row a length that SQLite calls a lack of memory (2^32 - 1, whose count of pages wraps to 0) and a header
 * beyond its page. The row's number stays. */
static void damage_length(uint8_t *name, uint8_t row)
{
    enum { BEFORE_NAME = 10 }; /* length 2, row 1, header 6, kind 1 */
    const uint8_t wrong[] = {255, 255, 255, 255, 255, 255, 255, 255, 255, row, 0x97, 0x44};
    TEST_ASSERT_EQUAL_UINT8(row, name[2 - BEFORE_NAME]);
    memcpy(name - BEFORE_NAME, wrong, sizeof wrong);
}

/* Proves: a row whose length is damaged so that SQLite says "out of memory" is damage like any other: the spool opens,
 * the row alone is lost, the others keep their numbers. */
static void test_a_length_that_no_memory_holds_costs_its_row(void)
{
    static uint8_t file[1 << 16];
    pf_spool_item item;
    open_spool("length.db", 0);
    for (uint64_t id = 1; id <= 30; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    close_spool();
    const size_t size = slurp(temporary_path("length.db"), file, sizeof file);
    damage_length(find_name(file, size, 17), 17);
    (void)temporary_write("length.db", file, size);
    open_spool("length.db", 0);
    TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
    TEST_ASSERT_EQUAL_UINT64(29, stats().objects);
    TEST_ASSERT_NOT_NULL(strstr(spool.ops->healing(spool.self), "29 objects saved from it, the rest is in"));
    TEST_ASSERT_EQUAL_INT(PF_OK, put_small(31));
    uint64_t row = 0;
    for (uint64_t expected = 1; expected <= 31; expected++)
        if (expected != 17) {
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, row, &item));
            TEST_ASSERT_EQUAL_UINT64(expected, item.row);
            row = item.row;
        }
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, row, &item));
    forget("length.db");
}

enum { STEP = 2000, ENOUGH = 400000 };

/* Opens and closes with so much more memory for SQLite, no more. */
static pf_status open_within(const char *name, int64_t memory)
{
    const pf_spool_config config = {.path = temporary_path(name)};
    (void)sqlite3_hard_heap_limit64(sqlite3_memory_used() + memory);
    const pf_status status = pf_spool_open(&spool, &config, error, sizeof error);
    if (status == PF_OK)
        close_spool();
    (void)sqlite3_hard_heap_limit64(0);
    return status;
}

static bool is_aside(const char *name, const char *how)
{
    char other[64];
    (void)snprintf(other, sizeof other, "%s.damaged-1%s", name, how);
    return access(temporary_path(other), F_OK) == 0;
}

/* Proves: where there really is no memory, however far that lets an opening come, a file is not taken for a damaged
 * one. */
static void test_a_lack_of_memory_is_no_damage(void)
{
    uint32_t refused = 0;
    bool is_there[MANY + 2];
    open_spool("short.db", 0);
    for (uint64_t id = 1; id <= 30; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    close_spool();
    for (int64_t memory = STEP; memory < ENOUGH; memory += STEP) {
        refused += open_within("short.db", memory) != PF_OK;
        TEST_ASSERT_FALSE(is_aside("short.db", "") || is_aside("short.db", ".unread"));
    }
    TEST_ASSERT_TRUE(refused > 10 && refused < ENOUGH / STEP - 10);
    open_spool("short.db", 0);
    TEST_ASSERT_EQUAL_UINT64(30, list_ids(is_there));
    forget("short.db");
}

/* Proves: nor is anything lost from a damaged one that memory is too short to read through: a later opening goes on. */
static void test_a_lack_of_memory_while_a_damaged_file_is_read_loses_nothing(void)
{
    static uint8_t file[1 << 16];
    uint32_t refused = 0, halfway = 0;
    bool is_there[MANY + 2];
    open_spool("worn.db", 0);
    for (uint64_t id = 1; id <= 60; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    close_spool();
    const size_t size = slurp(temporary_path("worn.db"), file, sizeof file);
    file[(find_name(file, size, 30) - file) / 4096 * 4096] = 0; /* a page of the table, no longer of any kind */
    (void)temporary_write("worn.db", file, size);
    open_spool("worn.db", 0);
    const uint64_t readable = list_ids(is_there);
    TEST_ASSERT_TRUE(readable >= 40 && readable < 60 && !is_there[30]);
    forget("worn.db");
    for (int64_t memory = STEP; memory < ENOUGH; memory += STEP) {
        (void)temporary_write("worn.db", file, size);
        refused += open_within("worn.db", memory) != PF_OK;
        halfway += is_aside("worn.db", ".unread");
        open_spool("worn.db", 0);
        TEST_ASSERT_EQUAL_UINT64(readable, list_ids(is_there));
        forget("worn.db");
    }
    TEST_ASSERT_TRUE(refused > 10 && halfway > 10 && halfway < ENOUGH / STEP - 10);
}

int main(void)
{
    (void)setenv("TMPDIR", "/dev/shm", 1);
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_length_that_no_memory_holds_costs_its_row);
    RUN_TEST(test_a_lack_of_memory_is_no_damage);
    RUN_TEST(test_a_lack_of_memory_while_a_damaged_file_is_read_loses_nothing);
    temporary_remove();
    return UNITY_END();
}
