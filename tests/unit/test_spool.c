#include "pipefish/drivers/sha256.h"
#include "pipefish/drivers/spool.h"
#include "temporary.h"
#include "unity.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <sqlite3.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>

static pf_spool spool;
static char error[512];

void setUp(void) {}

static void close_spool(void)
{
    if (spool.self != NULL)
        spool.ops->close(spool.self);
    spool.self = NULL;
}

void tearDown(void)
{
    close_spool();
}

static void open_spool(const char *name, uint64_t quota)
{
    pf_spool_config config = {temporary_path(name), quota};
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_spool_open(&spool, &config, error, sizeof error), error);
}

/* Object `id`: its bytes follow from the id alone, the first eight are the id. */
#define OBJECT_MAX 60000u
static uint8_t object_bytes[OBJECT_MAX], object_name[32], read_bytes[OBJECT_MAX];

static size_t make_object(uint64_t id)
{
    uint64_t random = id;
    size_t n = 16 + temporary_random(&random) % (OBJECT_MAX - 16);
    n -= n % 8;
    for (size_t i = 0; i < n; i += 8) {
        uint64_t word = temporary_random(&random);
        memcpy(object_bytes + i, &word, 8);
    }
    memcpy(object_bytes, &id, sizeof id);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256(object_bytes, n, object_name));
    return n;
}

static pf_status put(uint64_t id)
{
    size_t n = make_object(id);
    return spool.ops->put(spool.self, 2, object_name, object_bytes, n);
}

static pf_spool_stats stats(void)
{
    pf_spool_stats s;
    spool.ops->stats(spool.self, &s);
    return s;
}

/* Reads an item, checks that it is byte for byte the object it says it is, and returns its id. */
static uint64_t check_item(const pf_spool_item *item)
{
    uint64_t id;
    size_t n = 0;
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->read(spool.self, item->row, read_bytes, sizeof read_bytes, &n));
    TEST_ASSERT_EQUAL_size_t(item->size, n);
    memcpy(&id, read_bytes, sizeof id);
    TEST_ASSERT_EQUAL_size_t(make_object(id), n);
    TEST_ASSERT_EQUAL_MEMORY(object_bytes, read_bytes, n);
    TEST_ASSERT_EQUAL_MEMORY(object_name, item->name, 32);
    return id;
}

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
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->read(spool.self, row, read_bytes, sizeof read_bytes, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, UINT64_MAX, &item));
    /* A row is never used again, though the last one was removed. */
    TEST_ASSERT_EQUAL_INT(PF_OK, put(100));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, row, &item));
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, spool.ops->read(spool.self, item.row, read_bytes, item.size - 1, &n));
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

/* ---- syncs: SQLite's calls land here, the program's symbols come first ---- */

static unsigned long syncs;

int fsync(int fd)
{
    syncs++;
    return (int)syscall(SYS_fsync, fd);
}

int fdatasync(int fd)
{
    syncs++;
    return (int)syscall(SYS_fdatasync, fd);
}

/* Proves: each store and each removal is told to the medium before it is reported; a kill would not show that. */
static void test_every_change_is_synced(void)
{
    pf_spool_item item;
    open_spool("synced.db", 0);
    for (uint64_t id = 1; id <= 10; id++) {
        unsigned long before = syncs;
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
        TEST_ASSERT_TRUE_MESSAGE(syncs > before, "put");
        before = syncs;
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "id", &id, sizeof id));
        TEST_ASSERT_TRUE_MESSAGE(syncs > before, "set");
    }
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
    unsigned long before = syncs;
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, item.row));
    TEST_ASSERT_TRUE_MESSAGE(syncs > before, "remove");
}

/* ---- kill -9 ---- */

typedef struct report {
    uint64_t id;
    char what; /* 'P'ut and stored, 'r'emoving now, 'R'emoved */
} report;

#define WAITING_MAX 12u

/* The child: stores and removes for ever, and reports each step after (or, for a removal, also before) it. */
static void store_for_ever(int pipe_fd, uint64_t id)
{
    report r;
    memset(&r, 0, sizeof r);
    open_spool("killed.db", 0);
    for (;; id++) {
        size_t n = make_object(id);
        r = (report){.id = id, .what = 'P'};
        if (spool.ops->put_and_set(spool.self, 2, object_name, object_bytes, n, "last", &id, sizeof id) != PF_OK ||
            write(pipe_fd, &r, sizeof r) != sizeof r)
            _exit(1);
        while (stats().objects > WAITING_MAX) {
            pf_spool_item item;
            if (spool.ops->next(spool.self, 0, &item) != PF_OK)
                _exit(1);
            r = (report){.id = check_item(&item), .what = 'r'};
            if (write(pipe_fd, &r, sizeof r) != sizeof r || spool.ops->remove(spool.self, item.row) != PF_OK)
                _exit(1);
            r.what = 'R';
            if (write(pipe_fd, &r, sizeof r) != sizeof r)
                _exit(1);
        }
    }
}

#define IDS_MAX 200000u
static char state[IDS_MAX]; /* 0, 'P', 'r' or 'R' by id: the last report */

/* What the spool must hold after a cut. Returns the highest id it holds. */
static uint64_t check_after_cut(uint64_t highest_reported)
{
    static bool is_there[IDS_MAX];
    uint64_t row = 0, highest = 0, last = 0;
    size_t n;
    pf_spool_item item;
    memset(is_there, 0, sizeof is_there);
    open_spool("killed.db", 0);
    while (spool.ops->next(spool.self, row, &item) == PF_OK) {
        uint64_t id = check_item(&item);
        TEST_ASSERT_TRUE_MESSAGE(id > highest, "twice, or out of order");
        TEST_ASSERT_TRUE_MESSAGE(state[id] != 'R', "removed, and back again");
        is_there[id] = true;
        highest = id;
        row = item.row;
    }
    for (uint64_t id = 1; id <= highest_reported; id++)
        TEST_ASSERT_TRUE_MESSAGE(state[id] != 'P' || is_there[id], "reported as stored, and lost");
    TEST_ASSERT_TRUE_MESSAGE(highest <= highest_reported + 1, "more than the one under way");
    pf_status got = spool.ops->get(spool.self, "last", &last, sizeof last, &n);
    TEST_ASSERT_TRUE(highest_reported == 0 || got == PF_OK);
    TEST_ASSERT_TRUE_MESSAGE(last >= highest_reported && (highest == 0 || last == highest),
                             "value and object are not one transaction");
    close_spool();
    return last;
}

/* Proves: whatever was reported as stored is there and intact after kill -9 at any time, what was reported as removed
 * stays removed, and the value set with an object is the last object's.
 * Does not prove: a power cut, where the medium may lie about what it has written. */
static void test_kill_at_any_time_loses_nothing(void)
{
    uint64_t random = 42, highest = 0, reports = 0;
    for (int cut = 0; cut < 60; cut++) {
        int ends[2];
        TEST_ASSERT_EQUAL_INT(0, pipe(ends));
        fflush(stdout);
        pid_t child = fork();
        TEST_ASSERT_TRUE(child >= 0);
        if (child == 0) {
            close(ends[0]);
            store_for_ever(ends[1], highest + 1);
        }
        close(ends[1]);
        struct timespec t = {0, (long)(temporary_random(&random) % 40000000u)};
        nanosleep(&t, NULL);
        TEST_ASSERT_EQUAL_INT(0, kill(child, SIGKILL));
        report r;
        while (read(ends[0], &r, sizeof r) == sizeof r) {
            TEST_ASSERT_TRUE(r.id < IDS_MAX - 1);
            state[r.id] = r.what;
            if (r.id > highest)
                highest = r.id;
            reports++;
        }
        int status;
        TEST_ASSERT_EQUAL_INT(child, waitpid(child, &status, 0));
        TEST_ASSERT_TRUE_MESSAGE(WIFSIGNALED(status), "the child failed by itself");
        close(ends[0]);
        uint64_t last = check_after_cut(highest);
        if (last > highest) { /* it was under way, and made it */
            highest = last;
            state[last] = 'P';
        }
    }
    TEST_ASSERT_TRUE_MESSAGE(reports > 60, "the child hardly ran");
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
    pf_spool_config config = {path, 0};
    error[0] = '\0';
    TEST_ASSERT_EQUAL_INT_MESSAGE(expected, pf_spool_open(&spool, &config, error, sizeof error), error);
    TEST_ASSERT_NULL(spool.self);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, path), error);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, word), error);
}

static size_t slurp(const char *path, uint8_t *bytes, size_t capacity)
{
    FILE *f = fopen(path, "rb");
    TEST_ASSERT_NOT_NULL(f);
    size_t n = fread(bytes, 1, capacity, f);
    fclose(f);
    return n;
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
    refused(temporary_root, PF_ERR_IO, "open");
    refused(temporary_path("no/such/folder.db"), PF_ERR_IO, "open");
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
    pf_spool_config config = {temporary_path("shared.db"), 0};
    pf_status status = pf_spool_open(&second, &config, error, sizeof error);
    if (second.self != NULL)
        second.ops->close(second.self);
    TEST_ASSERT_EQUAL_INT(PF_ERR_IO, status);
    TEST_ASSERT_NOT_NULL(strstr(error, "another program uses it"));
}

/* Opens a damaged file and takes everything out of it that it gives: the answer may be an error, never wrong bytes. */
static void drain_damaged(const char *path)
{
    pf_spool_config config = {path, 0};
    error[0] = '\0';
    pf_status status = pf_spool_open(&spool, &config, error, sizeof error);
    if (status != PF_OK) {
        TEST_ASSERT_TRUE_MESSAGE(status == PF_ERR_FORMAT || status == PF_ERR_IO || status == PF_ERR_VERSION, error);
        TEST_ASSERT_NOT_NULL(strstr(error, path));
        return;
    }
    pf_spool_item item;
    uint64_t row = 0;
    size_t n;
    for (int i = 0; i < 100 && spool.ops->next(spool.self, row, &item) == PF_OK; i++) {
        status = spool.ops->read(spool.self, item.row, read_bytes, sizeof read_bytes, &n);
        if (status == PF_OK)
            (void)check_item(&item);
        else
            TEST_ASSERT_TRUE(spool.ops->error(spool.self)[0] != '\0');
        row = item.row;
    }
    close_spool();
}

/* Proves: a spool cut short, or with bytes changed anywhere, gives errors or intact objects, never wrong bytes. */
static void test_damaged_spool_never_gives_wrong_bytes(void)
{
    static uint8_t good[1 << 20], bad[1 << 20];
    uint64_t random = 3;
    open_spool("good.db", 0);
    for (uint64_t id = 1; id <= 8; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    close_spool();
    size_t n = slurp(temporary_path("good.db"), good, sizeof good);
    TEST_ASSERT_TRUE(n > 4096 && n < sizeof good);
    for (size_t cut = 0; cut < n; cut += 1 + n / 61)
        drain_damaged(temporary_write("cut.db", good, cut));
    for (int round = 0; round < 150; round++) {
        memcpy(bad, good, n);
        size_t range = round % 3 == 0 ? 100 : round % 3 == 1 ? 20000 : n; /* header, inner pages, anywhere */
        for (int k = 0; k < 8; k++)
            bad[temporary_random(&random) % range] = (uint8_t)temporary_random(&random);
        drain_damaged(temporary_write("bad.db", bad, n));
    }
}

/* Proves: when the medium takes no more, the error is reported and counted, what was stored stays, and it goes on when
 * there is space again. The limit of a file's size stands for the full medium. */
static void test_full_medium(void)
{
    struct rlimit old, small;
    signal(SIGXFSZ, SIG_IGN);
    open_spool("full.db", 0);
    TEST_ASSERT_EQUAL_INT(PF_OK, put(1));
    TEST_ASSERT_EQUAL_INT(0, getrlimit(RLIMIT_FSIZE, &old));
    small = old;
    small.rlim_cur = 300000;
    TEST_ASSERT_EQUAL_INT(0, setrlimit(RLIMIT_FSIZE, &small));
    uint64_t id = 2;
    pf_status status = PF_OK;
    while (status == PF_OK && id < 100)
        status = put(id++);
    uint64_t failed = id - 1, errors = stats().errors, objects = stats().objects;
    TEST_ASSERT_EQUAL_INT(0, setrlimit(RLIMIT_FSIZE, &old));
    TEST_ASSERT_TRUE(status == PF_ERR_IO || status == PF_ERR_SPACE);
    TEST_ASSERT_EQUAL_UINT64(1, errors);
    TEST_ASSERT_EQUAL_UINT64(failed - 1, objects);
    TEST_ASSERT_EQUAL_INT(PF_OK, put(failed));
    close_spool();
    open_spool("full.db", 0);
    pf_spool_item item;
    uint64_t row = 0;
    for (id = 1; id <= failed; id++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, row, &item));
        TEST_ASSERT_EQUAL_UINT64(id, check_item(&item));
        row = item.row;
    }
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

/* ---- a medium that refuses: SQLite's own way to put other system calls in place */

static int refuse_with;  /* errno of every write; 0 = none fails */
static uint64_t allowed; /* writes before that */

static bool refuses(void)
{
    if (refuse_with == 0 || (allowed > 0 && allowed--))
        return false;
    errno = refuse_with;
    return true;
}

static ssize_t write_or_not(int fd, const void *bytes, size_t n)
{
    return refuses() ? -1 : write(fd, bytes, n);
}

static ssize_t pwrite_or_not(int fd, const void *bytes, size_t n, off_t at)
{
    return refuses() ? -1 : pwrite(fd, bytes, n, at);
}

static int fallocate_or_not(int fd, off_t at, off_t n)
{
    return refuses() ? errno : posix_fallocate(fd, at, n);
}

static int ftruncate_or_not(int fd, off_t n)
{
    return refuses() ? -1 : ftruncate(fd, n);
}

static void hook(const char *name, sqlite3_syscall_ptr call)
{
    sqlite3_vfs *vfs = sqlite3_vfs_find(NULL);
    (void)vfs->xSetSystemCall(vfs, name, call);
}

/* Proves: on a medium that is full, read-only or broken from any write on, nothing that was reported as stored is lost,
 * nothing that was reported as removed comes back, each failure is said and counted, and all goes on once it takes
 * writes again; also when the program ends meanwhile. */
static void test_a_medium_that_refuses_writes_loses_nothing(void)
{
    static const int errors[] = {ENOSPC, EROFS, EIO};
    hook("write", (sqlite3_syscall_ptr)write_or_not);
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_or_not);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_or_not);
    hook("fallocate", (sqlite3_syscall_ptr)fallocate_or_not);
    hook("ftruncate", (sqlite3_syscall_ptr)ftruncate_or_not);
    uint64_t refused = 0;
    for (uint64_t round = 0; round < 3 * 40; round++) {
        char name[32];
        bool is_there[40] = {false};
        uint64_t errors_before, row = 0, n = 0;
        pf_spool_item item;
        (void)snprintf(name, sizeof name, "refuse%u.db", (unsigned)round);
        open_spool(name, 0);
        refuse_with = 0;
        for (uint64_t id = 1; id <= 8; id++)
            is_there[id] = put(id) == PF_OK;
        errors_before = stats().errors;
        allowed = round / 3 * 3;
        refuse_with = errors[round % 3];
        for (uint64_t id = 9; id <= 24; id++) {
            pf_status status = put(id);
            is_there[id] = status == PF_OK;
            TEST_ASSERT_TRUE(status == PF_OK || status == PF_ERR_SPACE || status == PF_ERR_IO);
            if (status != PF_OK)
                TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), name));
            refused += status != PF_OK;
            if (id % 4 == 0 && spool.ops->next(spool.self, 0, &item) == PF_OK) {
                uint64_t oldest = check_item(&item);
                if (spool.ops->remove(spool.self, item.row) == PF_OK)
                    is_there[oldest] = false;
            }
        }
        TEST_ASSERT_TRUE(stats().errors >= errors_before + (is_there[24] ? 0 : 1));
        if (round % 2 == 0) { /* it ends while nothing can be written */
            close_spool();
            refuse_with = 0;
            open_spool(name, 0);
        }
        refuse_with = 0;
        for (uint64_t id = 30; id < 34; id++) {
            TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
            is_there[id] = true;
        }
        close_spool();
        open_spool(name, 0);
        for (; spool.ops->next(spool.self, row, &item) == PF_OK; row = item.row, n++) {
            uint64_t id = check_item(&item);
            TEST_ASSERT_TRUE_MESSAGE(is_there[id], "removed, or refused, and there");
            is_there[id] = false;
        }
        for (uint64_t id = 0; id < 40; id++)
            TEST_ASSERT_FALSE_MESSAGE(is_there[id], "reported as stored, and lost");
        TEST_ASSERT_EQUAL_UINT64(n, stats().objects);
        close_spool();
    }
    TEST_ASSERT_TRUE(refused > 500);
    for (size_t i = 0; i < 5; i++)
        hook(((const char *[]){"write", "pwrite", "pwrite64", "fallocate", "ftruncate"})[i], NULL);
}

int main(void)
{
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_first_in_first_out);
    RUN_TEST(test_values);
    RUN_TEST(test_quota);
    RUN_TEST(test_every_change_is_synced);
    RUN_TEST(test_kill_at_any_time_loses_nothing);
    RUN_TEST(test_threads);
    RUN_TEST(test_wrong_files_are_refused_and_untouched);
    RUN_TEST(test_second_opener_is_refused);
    RUN_TEST(test_damaged_spool_never_gives_wrong_bytes);
    RUN_TEST(test_full_medium);
    RUN_TEST(test_victims_are_the_least_important_then_the_oldest);
    RUN_TEST(test_a_medium_that_refuses_writes_loses_nothing);
    temporary_remove();
    return UNITY_END();
}
