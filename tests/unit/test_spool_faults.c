/* The spool on media that fail. */
#include "spool_medium.h"

#include <fcntl.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>

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

/* ---- the clock, which a test can put forward ---- */

static long seconds_ahead;

int clock_gettime(clockid_t which, struct timespec *t)
{
    const int code = (int)syscall(SYS_clock_gettime, which, t);
    t->tv_sec += seconds_ahead;
    return code;
}

/* ---- the disk, which is as full as it says when it refuses ---- */

static fsblkcnt_t room_left = 1 << 20; /* while it does not, in blocks */

int statvfs(const char *path, struct statvfs *disk)
{
    (void)path;
    *disk = (struct statvfs){.f_bsize = 4096, .f_frsize = 4096, .f_bavail = refuse_with == ENOSPC ? 0 : room_left};
    return 0;
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

static uint64_t reports, highest_id;

/* Takes the child's next report in. False: there is none, and none will come. */
static bool take_report(int pipe_fd)
{
    report r;
    if (read(pipe_fd, &r, sizeof r) != sizeof r)
        return false;
    TEST_ASSERT_TRUE(r.id < IDS_MAX - 1);
    state[r.id] = r.what;
    if (r.id > highest_id)
        highest_id = r.id;
    reports++;
    return true;
}

/* Proves: whatever was reported as stored is there and intact after kill -9 at any time, what was reported as removed
 * stays removed, and the value set with an object is the last object's.
 * Does not prove: a power cut, where the medium may lie about what it has written. */
static void test_kill_at_any_time_loses_nothing(void)
{
    uint64_t random = 42;
    for (int cut = 0; cut < 60; cut++) {
        int ends[2];
        TEST_ASSERT_EQUAL_INT(0, pipe(ends));
        fflush(stdout);
        pid_t child = fork();
        TEST_ASSERT_TRUE(child >= 0);
        if (child == 0) {
            close(ends[0]);
            store_for_ever(ends[1], highest_id + 1);
        }
        close(ends[1]);
        for (int i = 0; cut % 2 == 1 && i < 3; i++) /* however slow the machine: it comes to something */
            TEST_ASSERT_TRUE_MESSAGE(take_report(ends[0]), "the child failed by itself");
        struct timespec t = {0, (long)(temporary_random(&random) % 40000000u)};
        nanosleep(&t, NULL);
        TEST_ASSERT_EQUAL_INT(0, kill(child, SIGKILL));
        while (take_report(ends[0]))
            ;
        int status;
        TEST_ASSERT_EQUAL_INT(child, waitpid(child, &status, 0));
        TEST_ASSERT_TRUE_MESSAGE(WIFSIGNALED(status), "the child failed by itself");
        close(ends[0]);
        uint64_t last = check_after_cut(highest_id);
        if (last > highest_id) { /* it was under way, and made it */
            highest_id = last;
            state[last] = 'P';
        }
    }
    TEST_ASSERT_TRUE_MESSAGE(reports > 60, "the child hardly ran");
}

/* Opens a damaged file and takes everything out of it that it gives: the answer may be an error, never wrong bytes. */
static void drain_damaged(const char *path)
{
    pf_spool_config config = {.path = path};
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
        status = spool.ops->read(spool.self, &item, read_bytes, sizeof read_bytes, &n);
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

/* ---- killed at every write: what lies on the disk before each is looked at by another process */

static struct {
    uint64_t stored, removed, writes, lost; /* reported so far */
    bool is_watching;
    char path[256], cut[256];
} cuts;

static void copy_file(const char *from, const char *to)
{
    static uint8_t bytes[1 << 16];
    (void)unlink(to);
    int in = open(from, O_RDONLY | O_CLOEXEC), out = open(to, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
    ssize_t n;
    while (in >= 0 && out >= 0 && (n = read(in, bytes, sizeof bytes)) > 0)
        if (syscall(SYS_write, out, bytes, (size_t)n) != n)
            break;
    if (in >= 0)
        (void)close(in);
    (void)close(out);
}

/* As after a kill at this moment: the ids there are removed + 1 (or + 2, under way) .. stored (or + 1). */
static int look_at_cut(const char *path, uint64_t stored, uint64_t removed)
{
    pf_spool_config config = {.path = path};
    pf_spool_item item;
    uint64_t row = 0, first = 0, last = 0, id;
    size_t n;
    if (pf_spool_open(&spool, &config, error, sizeof error) != PF_OK)
        return 1;
    for (; spool.ops->next(spool.self, row, &item) == PF_OK; row = item.row) {
        if (spool.ops->read(spool.self, &item, read_bytes, sizeof read_bytes, &n) != PF_OK)
            return 2;
        memcpy(&id, read_bytes, sizeof id);
        if (last != 0 && id != last + 1)
            return 3;
        first = first == 0 ? id : first;
        last = id;
    }
    spool.ops->close(spool.self);
    if (last == 0)
        return stored > removed + 1 ? 4 : 0;
    return first < removed + 1 || first > removed + 2 || last < stored || last > stored + 1 ? 5 : 0;
}

static void look(void)
{
    char path[256], wal[300], cut[256], cut_wal[300], stored[24], removed[24];
    int status = 0;
    if (!cuts.is_watching)
        return;
    cuts.writes++;
    (void)snprintf(path, sizeof path, "%s", cuts.path);
    (void)snprintf(cut, sizeof cut, "%s", cuts.cut);
    (void)snprintf(wal, sizeof wal, "%s-wal", path);
    (void)snprintf(cut_wal, sizeof cut_wal, "%s-wal", cut);
    (void)snprintf(stored, sizeof stored, "%llu", (unsigned long long)cuts.stored);
    (void)snprintf(removed, sizeof removed, "%llu", (unsigned long long)cuts.removed);
    copy_file(path, cut);
    copy_file(wal, cut_wal);
    pid_t child = fork();
    if (child == 0) {
        (void)execl("/proc/self/exe", "test_spool_faults", cut, stored, removed, (char *)NULL);
        _exit(9);
    }
    if (child < 0 || waitpid(child, &status, 0) != child || status != 0)
        cuts.lost++;
}

static ssize_t pwrite_looked_at(int fd, const void *bytes, size_t n, off_t at)
{
    look();
    return pwrite(fd, bytes, n, at);
}

/* Proves: a kill before any single write that SQLite makes, over 1,000 records (12 unless PIPEFISH_TEST_LONG) of which
 * two in three are removed on the way, loses nothing that was reported as stored, and brings nothing back that was
 * reported as removed. */
static void test_killed_at_every_write_nothing_acknowledged_is_lost(void)
{
    const uint64_t records = getenv("PIPEFISH_TEST_LONG") != NULL ? 1000 : 12;
    pf_spool_item item;
    (void)snprintf(cuts.path, sizeof cuts.path, "%s", temporary_path("cuts.db"));
    (void)snprintf(cuts.cut, sizeof cuts.cut, "%s", temporary_path("cut.db"));
    open_spool("cuts.db", 0);
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_looked_at);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_looked_at);
    cuts.is_watching = true;
    for (uint64_t id = 1; id <= records; id++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
        cuts.stored = id;
        if (id % 3 == 0)
            continue;
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, item.row));
        cuts.removed++;
    }
    cuts.is_watching = false;
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
    close_spool();
    printf("killed at %llu writes of %llu records, lost %llu\n", (unsigned long long)cuts.writes,
           (unsigned long long)records, (unsigned long long)cuts.lost);
    TEST_ASSERT_TRUE(cuts.writes > records);
    TEST_ASSERT_EQUAL_UINT64(0, cuts.lost);
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

static ssize_t pwrite_in_place(int fd, const void *bytes, size_t n, off_t at)
{
    struct stat s;
    if (refuse_with != 0 && fstat(fd, &s) == 0 && at + (off_t)n > s.st_size) {
        errno = refuse_with;
        return -1;
    }
    return pwrite(fd, bytes, n, at);
}

static void remove_in_order(uint64_t id, uint64_t last)
{
    pf_spool_item item;
    for (; id <= last; id++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
        TEST_ASSERT_EQUAL_UINT64(id, check_item(&item));
        const pf_status status = spool.ops->remove(spool.self, item.row);
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, status, spool.ops->error(spool.self));
    }
}

/* Proves: on a disk that others have filled to the last byte, or up to a user's own limit, all that is in the spool can
 * be removed, and what needs no more room than that left can be stored: the log, which had a few pages only, begins
 * anew. What does not fit is refused with the reason, and costs nothing that is there. */
static void test_a_disk_filled_by_others_lets_go_of_everything(void)
{
    enum { OBJECTS = 40 };
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_in_place);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_in_place);
    for (int round = 0; round < 2; round++) {
        forget("others.db");
        open_spool("others.db", 0);
        for (uint64_t id = 1; id <= OBJECTS; id++)
            TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
        close_spool();
        open_spool("others.db", 0);
        remove_in_order(1, 4); /* the log's length */
        refuse_with = round == 0 ? ENOSPC : EDQUOT;
        remove_in_order(5, OBJECTS);
        uint64_t id = OBJECTS + 1;
        pf_status status = PF_OK;
        for (; id < 1000 && (status = put(id)) == PF_OK; id++) {
        }
        TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, status);
        const char *why = round == 0 ? "disk is full" : strerror(EDQUOT);
        TEST_ASSERT_NOT_NULL_MESSAGE(strstr(spool.ops->error(spool.self), why), spool.ops->error(spool.self));
        if (round == 1) /* which the disk's room says nothing of: the log may have taken what the file cannot */
            refuse_with = 0;
        remove_in_order(OBJECTS + 1, id - 1);
        TEST_ASSERT_EQUAL_UINT64(0, stats().objects);
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(1));
        refuse_with = 0;
        close_spool();
        open_spool("others.db", 0);
        TEST_ASSERT_EQUAL_UINT64(1, stats().objects);
    }
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
}

/* Proves: once a disk has become too full for more, the file takes what so far only the log has, while there is room
 * for that: when the rest of the disk is filled all the same, everything can still be removed. With less room than that
 * nothing is begun: it would take the last bytes, which removing needs. */
static void test_a_disk_that_becomes_full_slowly_lets_go_of_everything(void)
{
    static uint8_t file[1 << 20];
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_in_place);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_in_place);
    open_spool("slowly.db", 0);
    for (uint64_t id = 1; id <= 20; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    const size_t small = slurp(temporary_path("slowly.db"), file, sizeof file);
    room_left = 2;
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(21));
    TEST_ASSERT_EQUAL_size_t_MESSAGE(small, slurp(temporary_path("slowly.db"), file, sizeof file), "the last room");
    room_left = 512;
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(21));
    refuse_with = ENOSPC;
    remove_in_order(1, 20);
    TEST_ASSERT_EQUAL_UINT64(0, stats().objects);
    refuse_with = 0;
    room_left = 1 << 20;
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
}

/* Proves: on a disk too full for an empty spool one is opened all the same: it says that it is full, and what is put
 * once there is room is stored for good; a damaged one found there waits, and is read then. A user's own limit is such
 * a disk too, and named. What the disk's room does not tell is tried once a second, not at each call: that reads all of
 * it. */
static void test_a_spool_on_a_disk_that_is_full_opens_and_begins_once_there_is_room(void)
{
    static uint8_t file[1 << 20];
    pf_spool_item item;
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_or_not);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_or_not);
    for (int round = 0; round < 4; round++) {
        const bool is_damaged = round & 1;
        forget("begun.db");
        if (is_damaged) {
            open_spool("begun.db", 0);
            TEST_ASSERT_EQUAL_INT(PF_OK, put(1));
            close_spool();
            const size_t n = slurp(temporary_path("begun.db"), file, sizeof file);
            memset(file + 40, 0x5A, 100);
            (void)temporary_write("begun.db", file, n);
        }
        refuse_with = round & 2 ? EDQUOT : ENOSPC;
        open_spool("begun.db", 0);
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, 0, &item));
        const uint64_t errors = stats().errors;
        refused_writes = 0;
        TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(2));
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, 0, &item));
        TEST_ASSERT_EQUAL_UINT64_MESSAGE(0, refused_writes, "tried again at once");
        TEST_ASSERT_TRUE(stats().errors > errors);
        TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), "cannot be written: "));
        TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), strerror(refuse_with)));
        seconds_ahead++;
        TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, put(2));
        TEST_ASSERT_TRUE_MESSAGE((refused_writes > 0) == (refuse_with == EDQUOT),
                                 "the disk itself says when it is full");
        seconds_ahead++;
        refuse_with = 0;
        TEST_ASSERT_EQUAL_INT(PF_OK, put(2));
        close_spool();
        open_spool("begun.db", 0);
        uint64_t row = 0;
        for (uint64_t id = is_damaged ? 1 : 2; id <= 2; id++, row = item.row) {
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, row, &item));
            TEST_ASSERT_EQUAL_UINT64(id, check_item(&item));
        }
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->next(spool.self, row, &item));
    }
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
}

int main(int argc, char **argv)
{
    if (argc == 4) /* look() has begun it */
        return look_at_cut(argv[1], strtoull(argv[2], NULL, 10), strtoull(argv[3], NULL, 10));
    /* In memory: a kill does not undo what was written, and on a busy disk thousands of syncs take minutes. */
    (void)setenv("TMPDIR", "/dev/shm", 1);
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_every_change_is_synced);
    RUN_TEST(test_kill_at_any_time_loses_nothing);
    RUN_TEST(test_damaged_spool_never_gives_wrong_bytes);
    RUN_TEST(test_full_medium);
    RUN_TEST(test_killed_at_every_write_nothing_acknowledged_is_lost);
    RUN_TEST(test_a_medium_that_refuses_writes_loses_nothing);
    RUN_TEST(test_a_disk_filled_by_others_lets_go_of_everything);
    RUN_TEST(test_a_disk_that_becomes_full_slowly_lets_go_of_everything);
    RUN_TEST(test_a_spool_on_a_disk_that_is_full_opens_and_begins_once_there_is_room);
    temporary_remove();
    return UNITY_END();
}
