#include "spool_objects.h"

#include <errno.h>
#include <pthread.h>
#include <sched.h>
#include <sqlite3.h>
#include <sys/mount.h>
#include <sys/stat.h>

/* Proves: objects come out in the order they went in, under their names, once each, also after reopening; removing and
 * the counters agree. */
static void test_first_in_first_out(void)
{
    uint64_t bytes = 0, row = 0, id = 1;
    pf_spool_item item;
    open_spool("order.db", 0);
    for (; id <= 20; id++) {
        bytes += make_object(id);
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    }
    TEST_ASSERT_EQUAL_INT(PF_OK, put(7)); /* again: stored once */
    TEST_ASSERT_EQUAL_UINT64(20, stats().objects);
    TEST_ASSERT_EQUAL_UINT64(20, stats().stored);
    TEST_ASSERT_EQUAL_UINT64(bytes, stats().bytes);
    close_spool();
    open_spool("order.db", 0);
    TEST_ASSERT_EQUAL_UINT64(20, stats().objects);
    TEST_ASSERT_EQUAL_UINT64(bytes, stats().bytes);
    for (id = 1; spool.ops->next(spool.self, row, &item) == PF_OK; id++) {
        TEST_ASSERT_TRUE(item.row > row);
        TEST_ASSERT_EQUAL_UINT32(2, item.kind);
        TEST_ASSERT_EQUAL_UINT64(id, check_item(&item));
        row = item.row;
        if (id % 2 == 0)
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, row));
    }
    TEST_ASSERT_EQUAL_UINT64(21, id);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, row)); /* gone already */
    TEST_ASSERT_EQUAL_UINT64(10, stats().objects);
    TEST_ASSERT_EQUAL_UINT64(10, stats().acknowledged);
    size_t n;
    TEST_ASSERT_EQUAL_INT(PF_ERR_END,
                          spool.ops->read(spool.self, &(pf_spool_item){.row = row}, read_bytes, sizeof read_bytes, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, UINT64_MAX, &item));
    /* A row is never used again, though the last one was removed. */
    TEST_ASSERT_EQUAL_INT(PF_OK, put(100));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, row, &item));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->read(spool.self, &item, read_bytes, item.size - 1, &n));
    TEST_ASSERT_TRUE(spool.ops->error(spool.self)[0] != '\0');
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, spool.ops->put(spool.self, 2, object_name, object_bytes, 0));
}

/* Proves: values are kept, replaced and deleted, and belong to the same transaction as the object. */
static void test_values(void)
{
    char value[16];
    size_t n = 0;
    open_spool("values.db", OBJECT_MAX);
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->get(spool.self, "survey", value, sizeof value, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", "one", 3));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", "three", 5));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->get(spool.self, "survey", value, 4, &n));
    close_spool();
    open_spool("values.db", OBJECT_MAX);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", value, sizeof value, &n));
    TEST_ASSERT_EQUAL_size_t(5, n);
    TEST_ASSERT_EQUAL_MEMORY("three", value, 5);
    size_t size = make_object(1);
    TEST_ASSERT_EQUAL_INT(PF_OK,
                          spool.ops->put_and_set(spool.self, 2, object_name, object_bytes, size, "survey", "4", 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", value, sizeof value, &n));
    TEST_ASSERT_EQUAL_MEMORY("4", value, 1);
    /* An object that does not fit takes its value with it. */
    static const uint8_t big[OBJECT_MAX];
    pf_sha256(big, sizeof big, object_name);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE,
                          spool.ops->put_and_set(spool.self, 2, object_name, big, sizeof big, "survey", "5", 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", value, sizeof value, &n));
    TEST_ASSERT_EQUAL_MEMORY("4", value, 1);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", NULL, 0));
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->get(spool.self, "survey", value, sizeof value, &n));
}

/* Proves: the quota is held to the byte, is an error that is counted, and room comes back with an acknowledgement; what
 * is stored already is fine whatever the quota. */
static void test_quota(void)
{
    pf_spool_item item;
    uint64_t quota = 0;
    for (uint64_t id = 1; id <= 5; id++)
        quota += make_object(id);
    open_spool("quota.db", quota);
    for (uint64_t id = 1; id <= 5; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    TEST_ASSERT_EQUAL_UINT64(quota, stats().bytes);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(6));
    TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), "quota"));
    TEST_ASSERT_EQUAL_UINT64(1, stats().errors);
    TEST_ASSERT_EQUAL_UINT64(5, stats().objects);
    TEST_ASSERT_EQUAL_INT(PF_OK, put(3));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, item.row));
    TEST_ASSERT_EQUAL_INT(PF_OK, put(1));
    close_spool();
    open_spool("quota.db", quota - 1);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(6));
    /* Larger than the whole quota: it never fits, and nobody must wait for that. */
    close_spool();
    open_spool("small.db", make_object(6) - 1);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, put(6));
    TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), "quota"));
}

/* ---- several threads ---- */

static void *store_some(void *first)
{
    for (uint64_t i = 0; i < 25; i++) {
        uint8_t bytes[3000], name[32];
        uint64_t id = *(uint64_t *)first + i;
        memset(bytes, (int)id, sizeof bytes);
        memcpy(bytes, &id, sizeof id);
        pf_spool_item item;
        if (pf_sha256(bytes, sizeof bytes, name) != PF_OK ||
            spool.ops->put(spool.self, 2, name, bytes, sizeof bytes) != PF_OK ||
            spool.ops->next(spool.self, i, &item) == PF_ERR_IO || spool.ops->error(spool.self)[0] != '\0')
            return first;
    }
    return NULL;
}

/* Proves: threads may call at the same time; nothing is lost. */
static void test_threads(void)
{
    pthread_t threads[4];
    uint64_t first[4] = {1000, 2000, 3000, 4000};
    open_spool("threads.db", 0);
    for (int i = 0; i < 4; i++)
        TEST_ASSERT_EQUAL_INT(0, pthread_create(&threads[i], NULL, store_some, &first[i]));
    for (int i = 0; i < 4; i++) {
        void *failed;
        pthread_join(threads[i], &failed);
        TEST_ASSERT_NULL(failed);
    }
    TEST_ASSERT_EQUAL_UINT64(100, stats().objects);
    TEST_ASSERT_EQUAL_UINT64(300000, stats().bytes);
}

/* ---- files that are no spools, and damaged ones ---- */

static void refused(const char *path, pf_status expected, const char *word)
{
    pf_spool_config config = {.path = path};
    error[0] = '\0';
    TEST_ASSERT_EQUAL_INT_MESSAGE(expected, pf_spool_open(&spool, &config, error, sizeof error), error);
    TEST_ASSERT_NULL(spool.self);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, path), error);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, word), error);
}

static void run_sql(const char *path, const char *text)
{
    sqlite3 *db;
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_open(path, &db));
    TEST_ASSERT_EQUAL_INT(SQLITE_OK, sqlite3_exec(db, text, NULL, NULL, NULL));
    sqlite3_close(db);
}

/* Proves: another program's file is refused in words and not changed by a byte; a newer spool is told from it. */
static void test_wrong_files_are_refused_and_untouched(void)
{
    static uint8_t before[65536], after[65536];
    char text[4096];
    memset(text, 'x', sizeof text);
    const char *plain = temporary_write("text.db", text, sizeof text);
    refused(plain, PF_ERR_FORMAT, "not an SQLite file");
    TEST_ASSERT_EQUAL_size_t(sizeof text, slurp(plain, after, sizeof after));
    TEST_ASSERT_EQUAL_MEMORY(text, after, sizeof text);
    const char *foreign = temporary_path("foreign.db");
    run_sql(foreign, "CREATE TABLE photos (a); INSERT INTO photos VALUES (1)");
    size_t n = slurp(foreign, before, sizeof before);
    refused(foreign, PF_ERR_FORMAT, "another program");
    TEST_ASSERT_EQUAL_size_t(n, slurp(foreign, after, sizeof after));
    TEST_ASSERT_EQUAL_MEMORY(before, after, n);
    open_spool("newer.db", 0);
    close_spool();
    run_sql(temporary_path("newer.db"), "PRAGMA user_version = 2");
    refused(temporary_path("newer.db"), PF_ERR_VERSION, "version 2");
    refused(temporary_root, PF_ERR_IO, strerror(EISDIR));
    refused(temporary_path("no/such/folder.db"), PF_ERR_IO, strerror(ENOENT));
    open_spool("empty.db", 0); /* an empty file, as a cut during creation may leave it, is a new spool */
    close_spool();
    temporary_write("empty.db", "", 0);
    open_spool("empty.db", 0);
    TEST_ASSERT_EQUAL_INT(PF_OK, put(1));
}

/* Proves: two daemons cannot share a spool. */
static void test_second_opener_is_refused(void)
{
    pf_spool second = {NULL, NULL};
    open_spool("shared.db", 0);
    pf_spool_config config = {.path = temporary_path("shared.db")};
    pf_status status = pf_spool_open(&second, &config, error, sizeof error);
    if (second.self != NULL)
        second.ops->close(second.self);
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, status);
    TEST_ASSERT_NOT_NULL(strstr(error, "another program uses it"));
}

/* ---- what has to go */

static pf_status put_ranked(uint64_t id, uint32_t importance, const pf_spool_victim *victims, uint32_t count)
{
    const pf_spool_rank rank = {importance, (uint32_t)id};
    size_t n = make_object(id);
    return spool.ops->exchange(spool.self, victims, count, 2, object_name, object_bytes, n, &rank, "last", &id,
                               sizeof id);
}

/* Proves: victims are the least important, of equals the oldest, as few as are enough, none of those without a rank,
 * above the given importance or up to the given row; an exchange is one transaction, also when it fails; ranks outlive
 * reopening and go with their objects; a file of a program without ranks gets them. */
static void test_victims_are_the_least_important_then_the_oldest(void)
{
    static const uint32_t importance[] = {3, 1, 0, 1, 0}; /* of ids 1..5; 6 has none */
    pf_spool_victim v[PF_SPOOL_VICTIMS_MAX];
    uint32_t count;
    uint64_t bytes = 0;
    open_spool("ranks.db", 0);
    close_spool();
    run_sql(temporary_path("ranks.db"), "DROP TRIGGER evictable_gone; DROP TABLE evictable");
    for (uint64_t id = 1; id <= 6; id++)
        bytes += make_object(id);
    open_spool("ranks.db", bytes);
    for (uint64_t id = 1; id <= 5; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_ranked(id, importance[id - 1], NULL, 0));
    TEST_ASSERT_EQUAL_INT(PF_OK, put(6));
    close_spool();
    open_spool("ranks.db", bytes);
    static const uint32_t order[] = {3, 5, 2, 4, 1};
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->victims(spool.self, 0, 9, (size_t)bytes, v, &count));
    size_t all = (size_t)(bytes - make_object(6));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->victims(spool.self, 0, 9, all, v, &count));
    TEST_ASSERT_EQUAL_UINT32(5, count);
    for (uint32_t i = 0; i < 5; i++)
        TEST_ASSERT_EQUAL_UINT32(order[i], v[i].number);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->victims(spool.self, 3, 9, 1, v, &count)); /* ids 1..3 are rows 1..3 */
    TEST_ASSERT_EQUAL_UINT32(1, count);
    TEST_ASSERT_EQUAL_UINT32(5, v[0].number);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->victims(spool.self, 0, 0, 1, v, &count));
    TEST_ASSERT_EQUAL_UINT32(3, v[0].number);
    /* One that would not fit even so: nothing has gone. */
    static const uint8_t big[OBJECT_MAX];
    pf_sha256(big, sizeof big, object_name);
    if (sizeof big > make_object(3)) {
        pf_sha256(big, sizeof big, object_name);
        TEST_ASSERT_EQUAL_INT(
            PF_ERR_SPACE, spool.ops->exchange(spool.self, v, 1, 2, object_name, big, sizeof big, NULL, "last", "", 0));
        TEST_ASSERT_EQUAL_UINT64(6, stats().objects);
        TEST_ASSERT_EQUAL_UINT64(bytes, stats().bytes);
    }
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->victims(spool.self, 0, 2, make_object(7), v, &count));
    TEST_ASSERT_EQUAL_INT(PF_OK, put_ranked(7, 2, v, count));
    TEST_ASSERT_EQUAL_UINT64(count, stats().evicted);
    TEST_ASSERT_EQUAL_UINT64(7 - count, stats().objects);
    TEST_ASSERT_TRUE(stats().bytes <= bytes);
    close_spool();
    open_spool("ranks.db", bytes);
    TEST_ASSERT_EQUAL_UINT64(7 - count, stats().objects);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->victims(spool.self, 0, 9, 1, v, &count));
    TEST_ASSERT_TRUE(v[0].number != 1 && v[0].number != 3);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->keep_all(spool.self));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->victims(spool.self, 0, 9, 1, v, &count));
}

/* Whether `path` is read-only from now on: for root as a file system of its own, else by permissions. */
static bool set_read_only(const char *folder, bool is_read_only)
{
    if (geteuid() == 0)
        return mount(NULL, folder, NULL, MS_REMOUNT | (is_read_only ? MS_RDONLY : 0u), NULL) == 0;
    return chmod(folder, is_read_only ? 0555 : 0755) == 0;
}

static void copy_file(const char *from, const char *to)
{
    static uint8_t bytes[4 << 20];
    FILE *in = fopen(from, "rb"), *out = fopen(to, "wb");
    TEST_ASSERT_TRUE(in != NULL && out != NULL);
    size_t n = fread(bytes, 1, sizeof bytes, in);
    TEST_ASSERT_TRUE(n > 0 && n < sizeof bytes && fwrite(bytes, 1, n, out) == n);
    (void)fclose(in);
    (void)fclose(out);
}

/* Everything that is there can be read, nothing is taken, and nothing is removed. */
static void check_read_only(uint64_t objects)
{
    pf_spool_item item = {0};
    pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX];
    uint32_t count = 0;
    uint64_t found = 0;
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(99));
    TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), "cannot be written"));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->set(spool.self, "a", "b", 1));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->keep_all(spool.self));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->victims(spool.self, 0, UINT32_MAX, 1, victims, &count));
    while (spool.ops->next(spool.self, item.row, &item) == PF_OK) {
        (void)check_item(&item);
        TEST_ASSERT_EQUAL_INT(PF_ERR_IO, spool.ops->remove(spool.self, item.row));
        found++;
    }
    TEST_ASSERT_EQUAL_UINT64(objects, found);
    TEST_ASSERT_EQUAL_UINT64(objects, stats().objects);
}

/* Proves: on a medium that is read-only already when the spool is opened, every object can be read, those in the log of
 * a spool that was never closed too; an empty folder is an empty spool; and once it can be written it is, without being
 * opened again. */
static void test_read_only_medium(void)
{
    static const char *const names[] = {"closed # 50%.db", "cut.db", "none.db"};
    static const uint64_t objects[] = {3, 4, 0};
    char folder[512], path[600], inside[64];
    (void)snprintf(folder, sizeof folder, "%s", temporary_path("medium"));
    TEST_ASSERT_EQUAL_INT(0, mkdir(folder, 0755));
    if (geteuid() == 0 && (unshare(CLONE_NEWNS) != 0 || mount(NULL, "/", NULL, MS_REC | MS_PRIVATE, NULL) != 0 ||
                           mount("tmpfs", folder, "tmpfs", 0, NULL) != 0))
        TEST_IGNORE_MESSAGE(
            "nothing may be mounted here, and root may write everywhere: read-only media are NOT tested");
    open_spool("source.db", 0);
    for (uint64_t id = 1; id <= 4; id++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
        if (id != 3)
            continue;
        close_spool();
        (void)snprintf(path, sizeof path, "%s/%s", folder, names[0]);
        copy_file(temporary_path("source.db"), path);
        open_spool("source.db", 0);
    }
    (void)snprintf(path, sizeof path, "%s/%s", folder, names[1]);
    copy_file(temporary_path("source.db"), path);
    (void)snprintf(path, sizeof path, "%s/%s-wal", folder, names[1]);
    copy_file(temporary_path("source.db-wal"), path);
    close_spool();
    for (size_t i = 0; i < sizeof names / sizeof names[0]; i++) {
        (void)snprintf(inside, sizeof inside, "medium/%s", names[i]);
        TEST_ASSERT_TRUE(set_read_only(folder, true));
        open_spool(inside, 0);
        check_read_only(objects[i]);
        TEST_ASSERT_TRUE(set_read_only(folder, false));
        pf_spool_item item;
        if (objects[i] > 0) {
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, item.row));
        }
        TEST_ASSERT_EQUAL_INT(PF_OK, put(99));
        close_spool();
        open_spool(inside, 0);
        TEST_ASSERT_EQUAL_UINT64(objects[i] > 0 ? objects[i] : 1, stats().objects);
        close_spool();
    }
    if (geteuid() == 0)
        TEST_ASSERT_EQUAL_INT(0, umount(folder));
}

static uint64_t lives;

static void count_life(void)
{
    lives++;
}

/* Proves: while a large spool is opened the caller hears that it goes on, the more often the larger it is (a slow card
 * takes half a minute for what the default quota holds; the watchdog waits less): at least once in 500 objects. */
static void test_opening_a_large_spool_is_heard(void)
{
    const pf_spool_config config = {.path = temporary_path("large.db"), .alive = count_life};
    uint64_t heard[2];
    uint8_t name[32];
    for (uint64_t half = 0; half < 2; half++) {
        open_spool("large.db", 0);
        for (uint64_t id = 1000 * half; id < 1000 * (half + 1); id++) {
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256((const uint8_t *)&id, sizeof id, name));
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->put(spool.self, 2, name, &id, sizeof id));
        }
        close_spool();
        lives = 0;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_spool_open(&spool, &config, error, sizeof error));
        heard[half] = lives;
        TEST_ASSERT_EQUAL_UINT64(1000 * (half + 1), stats().objects);
        TEST_ASSERT_EQUAL_UINT64(8000 * (half + 1), stats().bytes);
        close_spool();
    }
    TEST_ASSERT_TRUE(heard[0] >= 2 && heard[1] >= heard[0] + 2);
}

int main(void)
{
    (void)setenv("TMPDIR", "/dev/shm", 1); /* on a busy disk hundreds of syncs take a minute */
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_first_in_first_out);
    RUN_TEST(test_opening_a_large_spool_is_heard);
    RUN_TEST(test_values);
    RUN_TEST(test_quota);
    RUN_TEST(test_threads);
    RUN_TEST(test_read_only_medium);
    RUN_TEST(test_wrong_files_are_refused_and_untouched);
    RUN_TEST(test_second_opener_is_refused);
    RUN_TEST(test_victims_are_the_least_important_then_the_oldest);
    temporary_remove();
    return UNITY_END();
}
