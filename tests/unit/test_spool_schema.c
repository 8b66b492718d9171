/* The spool whose first page is damaged: it says which tables lie where, and is the same in every spool. */
#include "spool_medium.h"

#include <sys/syscall.h>

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
        "UPDATE sqlite_schema SET rootpage = 3 WHERE name = 'value'",
        "UPDATE sqlite_schema SET rootpage = 2 WHERE name = 'evictable'",
        "UPDATE sqlite_schema SET sql = replace(sql, '= 32', '= 33') WHERE name = 'object'",
        "UPDATE sqlite_schema SET sql = replace(sql, 'importance', 'importancf') WHERE name LIKE 'evictable%'",
        "DELETE FROM sqlite_schema",
        "DELETE FROM sqlite_schema; PRAGMA application_id = 0; PRAGMA user_version = 0",
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

/* ---- files that are not as this program makes them, and lose nothing by it */

static void run_sql(const char *name, const char *text)
{
    sqlite3 *db;
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(temporary_path(name), &db));
    TEST_ASSERT_EQUAL_INT_MESSAGE(SQLITE_OK, sqlite3_exec(db, text, NULL, NULL, NULL), sqlite3_errmsg(db));
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_close(db));
}

/* A spool of COUNT objects and "survey" = 7 in a file that was begun with `layout`; the ranks are made last or first,
 * so that the roots differ. */
enum { COUNT = 80 };
static void make_as(const char *name, const char *layout, bool ranks_first)
{
    static const char ranks[] = "CREATE TABLE evictable (row INTEGER PRIMARY KEY,importance INTEGER NOT NULL, number "
                                "INTEGER NOT NULL);CREATE INDEX evictable_order ON evictable (importance, row);";
    static const char tables[] = "CREATE TABLE object (row INTEGER PRIMARY KEY AUTOINCREMENT,kind INTEGER NOT NULL,"
                                 "name BLOB NOT NULL UNIQUE CHECK (length(name) = 32),bytes BLOB NOT NULL);"
                                 "CREATE TABLE value (key TEXT PRIMARY KEY, bytes BLOB NOT NULL) WITHOUT ROWID;"
                                 "PRAGMA application_id = 1346786128;PRAGMA user_version = 1;";
    const uint64_t value = 7;
    char all[2048];
    (void)snprintf(all, sizeof all, "%s%s%s", layout, ranks_first ? ranks : "", tables);
    run_sql(name, all);
    open_spool(name, 0);
    for (uint64_t id = 1; id <= COUNT; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", &value, sizeof value));
    close_spool();
}

static bool is_set_aside(const char *name)
{
    char aside[64];
    (void)snprintf(aside, sizeof aside, "%s.damaged-1", name);
    return access(temporary_path(aside), F_OK) == 0;
}

static void expect_all(const char *name, uint64_t healed)
{
    bool is_there[MANY + 2];
    open_spool(name, 0);
    TEST_ASSERT_EQUAL_UINT64_MESSAGE(healed, stats().healed, name);
    TEST_ASSERT_EQUAL_UINT64_MESSAGE(COUNT, list_ids(is_there), name);
    TEST_ASSERT_EQUAL_UINT64(7, value_of("survey"));
    TEST_ASSERT_EQUAL_INT(PF_OK, put_small(MANY));
    TEST_ASSERT_EQUAL_UINT64(COUNT + 1, list_ids(is_there));
    TEST_ASSERT_TRUE(is_set_aside(name) == (healed > 0));
    forget(name);
}

static const struct {
    const char *name, *layout;
    bool ranks_first;
} others[] = {{"loaded.db", "", true},
              {"vacuum.db", "PRAGMA auto_vacuum = FULL;", false},
              {"small.db", "PRAGMA page_size = 1024;", false},
              {"large.db", "PRAGMA page_size = 8192;", false}};
enum { OTHERS = sizeof others / sizeof others[0] };

/* Proves: a spool that was dumped and loaded again, so that its tables begin on other pages, one that SQLite keeps
 * compact, and ones of other pages are used as they are. */
static void test_a_spool_whose_tables_lie_elsewhere_is_used_as_it_is(void)
{
    for (int i = 0; i < OTHERS; i++) {
        make_as(others[i].name, others[i].layout, others[i].ranks_first);
        expect_all(others[i].name, 0);
    }
}

/* Proves: where such a one is damaged it is read through its own first page, which stays as it was: what lies in other
 * places than every spool's is saved. */
static void test_a_damaged_spool_whose_tables_lie_elsewhere_is_read_by_its_own_first_page(void)
{
    static uint8_t before[4096], after[4096];
    char aside[64];
    for (int i = 0; i < OTHERS; i++) {
        make_as(others[i].name, others[i].layout, others[i].ranks_first);
        rewrite_schema(others[i].name, "UPDATE sqlite_schema SET sql = replace(sql, 'importance', 'importancf') "
                                       "WHERE name LIKE 'evictable%'");
        (void)slurp(temporary_path(others[i].name), before, sizeof before);
        open_spool(others[i].name, 0);
        TEST_ASSERT_EQUAL_UINT64_MESSAGE(COUNT, stats().objects, others[i].name);
        TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
        TEST_ASSERT_EQUAL_UINT64(7, value_of("survey"));
        (void)snprintf(aside, sizeof aside, "%s.damaged-1", others[i].name);
        (void)slurp(temporary_path(aside), after, sizeof after);
        if (i > 0) /* the pages of the first are where a spool's are: it is read twice */
            TEST_ASSERT_EQUAL_MEMORY(before, after, 512);
        forget(others[i].name);
    }
}

/* Proves: a place where a table begins that is another page of that same table is damage: nothing is lost. */
static void test_a_root_on_another_page_of_its_table_is_damage(void)
{
    char text[128];
    int healed = 0;
    for (int root = 6; root <= 12; root++) {
        static uint8_t file[1 << 20];
        make_as("root.db", "", false);
        const size_t size = slurp(temporary_path("root.db"), file, sizeof file);
        TEST_ASSERT_TRUE(size >= 12 * 4096);
        (void)snprintf(text, sizeof text, "UPDATE sqlite_schema SET rootpage = %d WHERE name = 'object'", root);
        rewrite_schema("root.db", text);
        expect_all("root.db", 1);
        healed++;
    }
    TEST_ASSERT_EQUAL_INT(7, healed);
}

/* Proves: a first page of which nothing is left, be it zeros, ones or anything, costs nothing. */
static void test_a_lost_first_page_costs_nothing(void)
{
    static uint8_t file[1 << 20];
    make_as("page.db", "", false);
    const size_t size = slurp(temporary_path("page.db"), file, sizeof file);
    for (int kind = 0; kind < 4; kind++) {
        uint64_t random = 5;
        for (size_t i = 0; i < (kind == 3 ? 512 : 4096); i++)
            file[i] = (uint8_t)(kind == 1 ? 0xFF : kind == 2 ? temporary_random(&random) >> 32 : 0);
        (void)temporary_write("page.db", file, size);
        if (kind == 3) { /* a sector only */
            forget("page.db");
            make_as("page.db", "", false);
            FILE *f = fopen(temporary_path("page.db"), "r+b");
            TEST_ASSERT_NOT_NULL(f);
            TEST_ASSERT_EQUAL_size_t(512, fwrite(file, 1, 512, f));
            TEST_ASSERT_EQUAL_INT(0, fclose(f));
        }
        expect_all("page.db", 1);
    }
}

/* Proves: a damaged size of its pages costs nothing, be it one that SQLite takes, with or without a log behind the
 * file. */
static void test_a_damaged_size_of_its_pages_costs_nothing(void)
{
    static const uint8_t sizes[][2] = {{0x02, 0}, {0x04, 0}, {0x08, 0}, {0x20, 0},
                                       {0x40, 0}, {0x80, 0}, {0, 1},    {0, 0}};
    static uint8_t file[1 << 20], log[1 << 20];
    sqlite3 *db;
    make_as("size.db", "", false);
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(temporary_path("size.db"), &db));
    for (int has_log = 0; has_log < 2; has_log++) {
        if (has_log) /* a page in it that is not the first */
            TEST_ASSERT_EQUAL_INT(SQLITE_OK,
                                  sqlite3_exec(db, "UPDATE object SET kind = 3 WHERE row = 9", NULL, NULL, NULL));
        const size_t size = slurp(temporary_path("size.db"), file, sizeof file);
        const size_t log_size = has_log ? slurp(temporary_path("size.db-wal"), log, sizeof log) : 0;
        TEST_ASSERT_TRUE(has_log == (log_size > 4096));
        for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; i++) {
            memcpy(file + 16, sizes[i], 2);
            (void)temporary_write("other.db", file, size);
            if (has_log)
                (void)temporary_write("other.db-wal", log, log_size);
            expect_all("other.db", 1);
        }
    }
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_close(db));
}

/* Proves: what another program or a newer one made is left as it is, also where it is damaged. */
static void test_others_damaged_files_are_left_as_they_are(void)
{
    static const char rows[] = "WITH RECURSIVE n (i) AS (VALUES (1) UNION ALL SELECT i + 1 FROM n WHERE i < 300) "
                               "INSERT INTO thing SELECT i, zeroblob(200) FROM n;";
    static const char *const ids[] = {"PRAGMA application_id = 7;", "PRAGMA application_id = 1346786128;"};
    static uint8_t before[1 << 20], after[1 << 20];
    for (int kind = 0; kind < 4; kind++) {
        char text[512];
        pf_spool_config config = {.path = temporary_path("theirs.db")};
        (void)snprintf(text, sizeof text, "%sPRAGMA user_version = 2;CREATE TABLE thing (a, b);%s", ids[kind / 2],
                       rows);
        run_sql("theirs.db", text);
        size_t size = slurp(temporary_path("theirs.db"), before, sizeof before);
        if (kind % 2 == 0)
            size -= 2 * 4096; /* cut off */
        else
            before[100] ^= 8; /* no page that SQLite knows */
        (void)temporary_write("theirs.db", before, size);
        TEST_ASSERT_EQUAL_INT(kind < 2 ? PF_ERR_FORMAT : PF_ERR_VERSION,
                              pf_spool_open(&spool, &config, error, sizeof error));
        TEST_ASSERT_EQUAL_size_t(size, slurp(temporary_path("theirs.db"), after, sizeof after));
        TEST_ASSERT_EQUAL_MEMORY(before, after, size);
        TEST_ASSERT_FALSE(is_set_aside("theirs.db"));
        (void)unlink(temporary_path("theirs.db"));
    }
}

/* Proves: a spool to which a power cut left only some of what belongs to its ranks gets the rest, without a copy. */
static void test_ranks_in_part_are_completed(void)
{
    static const char *const less[] = {"DROP TRIGGER evictable_gone",
                                       "DROP TRIGGER evictable_gone; DROP INDEX evictable_order",
                                       "DROP INDEX evictable_order", "DROP TABLE evictable"};
    pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX];
    uint32_t count;
    for (size_t i = 0; i < sizeof less / sizeof less[0]; i++) {
        make_as("ranks.db", "", false);
        run_sql("ranks.db", less[i]);
        open_spool("ranks.db", 0);
        TEST_ASSERT_EQUAL_UINT64(COUNT, stats().objects);
        TEST_ASSERT_EQUAL_UINT64(0, stats().healed);
        uint8_t bytes[16] = {(uint8_t)i}, name[32];
        const pf_spool_rank rank = {1, 5};
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256(bytes, sizeof bytes, name));
        TEST_ASSERT_EQUAL_INT(
            PF_OK, spool.ops->exchange(spool.self, NULL, 0, 2, name, bytes, sizeof bytes, &rank, NULL, NULL, 0));
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->victims(spool.self, 0, 9, 16, victims, &count));
        TEST_ASSERT_EQUAL_UINT32(1, count);
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, victims[0].row));
        close_spool();
        sqlite3 *db;
        sqlite3_stmt *q;
        TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(temporary_path("ranks.db"), &db));
        TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_prepare_v2(db, "SELECT count(*) FROM evictable", -1, &q, NULL));
        TEST_ASSERT_EQUAL_INT(SQLITE_ROW, sqlite3_step(q));
        TEST_ASSERT_EQUAL_INT(0, sqlite3_column_int(q, 0)); /* the trigger is there */
        TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_finalize(q));
        TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_close(db));
        forget("ranks.db");
    }
}

static bool is_read_only;

/* The spool asks with it whether it may write; the tests' user may anything. */
int access(const char *path, int how)
{
    if (is_read_only && how == W_OK) {
        errno = EROFS;
        return -1;
    }
    return (int)syscall(SYS_access, path, how);
}

/* Proves: on a medium that cannot be written an object needs nothing but its table to be sent. */
static void test_what_cannot_be_written_needs_only_the_table_of_objects(void)
{
    static const char *const less[] = {
        "DROP TRIGGER evictable_gone", "DROP INDEX evictable_order", "DROP TABLE value",
        "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = replace(sql, 'importance', "
        "'importancf') WHERE name LIKE 'evictable%'"};
    bool is_there[MANY + 2];
    uint8_t value[8];
    size_t n;
    for (size_t i = 0; i < sizeof less / sizeof less[0]; i++) {
        make_as("fixed.db", "", false);
        run_sql("fixed.db", less[i]);
        is_read_only = true;
        open_spool("fixed.db", 0);
        TEST_ASSERT_EQUAL_UINT64_MESSAGE(COUNT, list_ids(is_there), less[i]);
        TEST_ASSERT_EQUAL_INT(i == 2 ? PF_ERR_END : PF_OK,
                              spool.ops->get(spool.self, "survey", value, sizeof value, &n));
        TEST_ASSERT_TRUE(put_small(MANY) != PF_OK);
        close_spool();
        is_read_only = false;
        forget("fixed.db");
    }
}

/* No write to a file that was set aside, but to its log, succeeds. */
static bool is_full;

static ssize_t pwrite_elsewhere(int fd, const void *bytes, size_t n, off_t at)
{
    char link[64], path[512];
    (void)snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    const ssize_t length = readlink(link, path, sizeof path - 1);
    path[length > 0 ? length : 0] = '\0';
    if (is_full && strstr(path, ".unread") != NULL) {
        errno = ENOSPC;
        return -1;
    }
    return pwrite(fd, bytes, n, at);
}

/* Proves: a card too full for a damaged file to take its own log in is told, costs nothing, and the next start goes on.
 */
static void test_a_card_too_full_for_a_damaged_files_log_is_told_and_costs_nothing(void)
{
    static uint8_t file[1 << 16], log[1 << 20];
    bool is_there[MANY + 2];
    (void)make_three("tight.db", file, sizeof file);
    sqlite3 *db;
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(temporary_path("tight.db"), &db));
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_exec(db,
                                                  "PRAGMA writable_schema = ON; DELETE FROM object WHERE row = 1;"
                                                  "UPDATE sqlite_schema SET name = 'objecu' WHERE name = 'object'",
                                                  NULL, NULL, NULL));
    (void)temporary_write("full.db", file, slurp(temporary_path("tight.db"), file, sizeof file));
    (void)temporary_write("full.db-wal", log, slurp(temporary_path("tight.db-wal"), log, sizeof log));
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_close(db));
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_elsewhere);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_elsewhere);
    is_full = true;
    open_spool("full.db", 0);
    is_full = false;
    TEST_ASSERT_EQUAL_UINT64(0, stats().objects);
    TEST_ASSERT_NOT_NULL_MESSAGE(
        strstr(spool.ops->healing(spool.self), "the next start tries again: database or disk is full"),
        spool.ops->healing(spool.self));
    close_spool();
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
    open_spool("full.db", 0);
    TEST_ASSERT_EQUAL_UINT64(2, list_ids(is_there));
    TEST_ASSERT_TRUE(is_there[2] && is_there[3] && !is_there[1]);
    TEST_ASSERT_EQUAL_UINT64(7, value_of("survey"));
    forget("full.db");
}

int main(void)
{
    (void)setenv("TMPDIR", "/dev/shm", 1);
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_changed_byte_in_the_first_page_costs_nothing);
    RUN_TEST(test_a_schema_of_other_tables_is_damage);
    RUN_TEST(test_a_damaged_schema_in_a_log_costs_nothing);
    RUN_TEST(test_a_spool_whose_tables_lie_elsewhere_is_used_as_it_is);
    RUN_TEST(test_a_damaged_spool_whose_tables_lie_elsewhere_is_read_by_its_own_first_page);
    RUN_TEST(test_a_root_on_another_page_of_its_table_is_damage);
    RUN_TEST(test_a_lost_first_page_costs_nothing);
    RUN_TEST(test_a_damaged_size_of_its_pages_costs_nothing);
    RUN_TEST(test_others_damaged_files_are_left_as_they_are);
    RUN_TEST(test_ranks_in_part_are_completed);
    RUN_TEST(test_what_cannot_be_written_needs_only_the_table_of_objects);
    RUN_TEST(test_a_card_too_full_for_a_damaged_files_log_is_told_and_costs_nothing);
    temporary_remove();
    return UNITY_END();
}
