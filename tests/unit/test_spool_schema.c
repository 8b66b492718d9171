/* The spool whose first page is damaged: it says which tables lie where, and is the same in every spool. */
#include "spool_medium.h"

static uint64_t value_of(const char *key)
{
    uint64_t value = 0;
    size_t n;
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, key, &value, sizeof value, &n));
    return value;
}

/* Three objects, "survey" = 7; closed. Returns the file's size. */
static size_t make_three(const char *name, uint8_t *file, size_t capacity)
{
    const uint64_t value = 7;
    open_spool(name, 0);
    for (uint64_t id = 1; id <= 3; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", &value, sizeof value));
    close_spool();
    return slurp(temporary_path(name), file, capacity);
}

static void forget(const char *name)
{
    char other[64];
    close_spool();
    (void)unlink(temporary_path(name));
    for (int i = 1; i < 4; i++) {
        (void)snprintf(other, sizeof other, "%s.damaged-%d", name, i);
        (void)unlink(temporary_path(other));
    }
}

/* Proves: no changed byte of the first page, be it in the name of a table, in where it begins, in what SQLite is told
 * about the file or in whose file it is, keeps the spool from opening, costs an object or a value, or hinders the next
 * object. Left out: the version, by which a newer program's spool is known. */
static void test_a_changed_byte_in_the_first_page_costs_nothing(void)
{
    static uint8_t file[1 << 16];
    const size_t size = make_three("byte.db", file, sizeof file);
    uint64_t healed = 0;
    for (size_t at = 0; at < 4096; at++) {
        if ((at >= 60 && at < 64) || (at >= 92 && file[at] == 0))
            continue;
        file[at] ^= (uint8_t)(1 << at % 8);
        (void)temporary_write("byte.db", file, size);
        file[at] ^= (uint8_t)(1 << at % 8);
        open_spool("byte.db", 0);
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, put_small(4), spool.ops->error(spool.self));
        bool is_there[MANY + 2];
        TEST_ASSERT_EQUAL_UINT64(4, list_ids(is_there));
        TEST_ASSERT_EQUAL_UINT64(7, value_of("survey"));
        TEST_ASSERT_TRUE(stats().healed == 0 || strstr(spool.ops->healing(spool.self), "saved from it") != NULL);
        healed += stats().healed;
        forget("byte.db");
    }
    TEST_ASSERT_TRUE(healed > 500); /* each byte that tells of a table */
}

/* Changes what a spool's schema says, past SQLite's own care. */
static void rewrite_schema(const char *name, const char *text)
{
    sqlite3 *db;
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(temporary_path(name), &db));
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_exec(db, "PRAGMA writable_schema = ON", NULL, NULL, NULL));
    TEST_ASSERT_EQUAL_INT_MESSAGE(SQLITE_OK, sqlite3_exec(db, text, NULL, NULL, NULL), sqlite3_errmsg(db));
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_close(db));
}

/* Proves: a schema that SQLite reads without complaint, but which names other tables, or other pages for them, than
 * a spool's is damage: all is saved, the file is set aside, the loss is told, and the objects keep their rows. */
static void test_a_schema_of_other_tables_is_damage(void)
{
    static const char *const wrong[] = {
        "UPDATE sqlite_schema SET name = 'objecu', tbl_name = 'objecu', sql = replace(sql, 'TABLE object', 'TABLE "
        "objecu') WHERE name = 'object'; DELETE FROM sqlite_schema WHERE type <> 'table'",
        "UPDATE sqlite_schema SET name = 'valuf', tbl_name = 'valuf', sql = replace(sql, 'TABLE value', 'TABLE valuf') "
        "WHERE name = 'value'",
        "UPDATE sqlite_schema SET rootpage = 4 WHERE name = 'object'",
        "UPDATE sqlite_schema SET rootpage = 2 WHERE name = 'evictable'",
        "UPDATE sqlite_schema SET sql = replace(sql, '= 32', '= 33') WHERE name = 'object'",
        "UPDATE sqlite_schema SET sql = replace(sql, 'importance', 'importancf') WHERE name LIKE 'evictable%'",
        "DELETE FROM sqlite_schema",
        "PRAGMA application_id = 7"};
    static uint8_t file[1 << 16];
    pf_spool_item item;
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++) {
        (void)make_three("names.db", file, sizeof file);
        open_spool("names.db", 0);
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, 1)); /* acknowledged: it does not come back */
        close_spool();
        rewrite_schema("names.db", wrong[i]);
        open_spool("names.db", 0);
        TEST_ASSERT_EQUAL_UINT64_MESSAGE(1, stats().healed, wrong[i]);
        TEST_ASSERT_NOT_NULL(strstr(spool.ops->healing(spool.self), "2 objects saved from it"));
        TEST_ASSERT_EQUAL_INT(0, access(temporary_path("names.db.damaged-1"), F_OK));
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(4));
        uint64_t row = 0;
        for (uint64_t expected = 2; expected <= 4; expected++, row = item.row) {
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, row, &item));
            TEST_ASSERT_EQUAL_UINT64(expected, item.row);
        }
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, row, &item));
        TEST_ASSERT_EQUAL_UINT64(7, value_of("survey"));
        forget("names.db");
    }
}

/* Proves: also where the damaged schema lies in the log of a spool that was killed, which SQLite puts before the file:
 * what the log has is saved too. */
static void test_a_damaged_schema_in_a_log_costs_nothing(void)
{
    static uint8_t file[1 << 16], log[1 << 20];
    static const uint8_t zeros[100] = {0};
    pf_spool_item item;
    (void)make_three("killed.db", file, sizeof file);
    sqlite3 *db;
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(temporary_path("killed.db"), &db));
    for (int kind = 0; kind < 2; kind++) {
        TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_exec(db,
                                                      "PRAGMA writable_schema = ON; DELETE FROM object WHERE row = 1;"
                                                      "UPDATE sqlite_schema SET name = 'objecu' WHERE name = 'object'",
                                                      NULL, NULL, NULL));
        const size_t size = slurp(temporary_path("killed.db"), file, sizeof file);
        const size_t log_size = slurp(temporary_path("killed.db-wal"), log, sizeof log);
        TEST_ASSERT_TRUE(log_size > 3 * 4096);
        if (kind == 1) /* and the file's own first page is no SQLite's */
            memcpy(file, zeros, 60);
        (void)temporary_write("left.db", file, size);
        (void)temporary_write("left.db-wal", log, log_size);
        open_spool("left.db", 0);
        TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
        TEST_ASSERT_EQUAL_UINT64(2, stats().objects);
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
        TEST_ASSERT_EQUAL_UINT64(2, item.row);
        TEST_ASSERT_EQUAL_UINT64(7, value_of("survey"));
        forget("left.db");
    }
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_close(db));
}

int main(void)
{
    (void)setenv("TMPDIR", "/dev/shm", 1);
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_changed_byte_in_the_first_page_costs_nothing);
    RUN_TEST(test_a_schema_of_other_tables_is_damage);
    RUN_TEST(test_a_damaged_schema_in_a_log_costs_nothing);
    temporary_remove();
    return UNITY_END();
}
