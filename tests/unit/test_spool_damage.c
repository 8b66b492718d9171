/* The spool whose file the medium damages: what can be read of it goes on, whatever comes between. */
#include "spool_medium.h"

#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>

/* ---- a damaged file is replaced */

static void damage(const char *path, long at, size_t n)
{
    uint8_t junk[8192];
    FILE *f = fopen(path, "r+b");
    TEST_ASSERT_NOT_NULL(f);
    for (size_t i = 0; i < sizeof junk; i++)
        junk[i] = (uint8_t)(37 * i + 11);
    TEST_ASSERT_EQUAL_INT(0, fseek(f, at, SEEK_SET));
    TEST_ASSERT_EQUAL_size_t(n, fwrite(junk, 1, n, f));
    fclose(f);
}

/* Checks that what is in the spool is whole and in order; how many. */
static uint64_t count_whole(void)
{
    pf_spool_item item;
    uint64_t row = 0, n = 0, last = 0;
    for (; spool.ops->next(spool.self, row, &item) == PF_OK; row = item.row, n++) {
        uint64_t id = check_item(&item);
        TEST_ASSERT_TRUE(id > last);
        last = id;
    }
    return n;
}

/* As the daemon does: what has other bytes than its name says is removed, what cannot be read is asked for again. */
static void sift(void)
{
    pf_spool_item item;
    uint64_t row = 0;
    size_t n;
    pf_status status;
    for (int i = 0; i < 2000; i++) {
        status = spool.ops->next(spool.self, row, &item);
        if (status == PF_ERR_END)
            return;
        if (status != PF_OK)
            continue;
        status = spool.ops->read(spool.self, &item, read_bytes, sizeof read_bytes, &n);
        if (status == PF_ERR_CHECKSUM)
            TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, item.row));
        if (status != PF_ERR_IO)
            row = item.row;
    }
    TEST_FAIL_MESSAGE("no end of it");
}

/* Proves: whatever page of a spool is overwritten, the daemon gets one that takes objects, with those that could be
 * reached, and what it has is whole; the damaged file is kept under another name. What is no spool is not touched
 * (test_spool.c). */
static void test_a_damaged_file_is_set_aside_and_what_is_whole_is_saved(void)
{
    static uint8_t good[2 << 20];
    uint64_t worst = UINT64_MAX, value = 7;
    size_t size;
    open_spool("worn.db", 0);
    for (uint64_t id = 1; id <= 20; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", &value, sizeof value));
    close_spool();
    size = slurp(temporary_path("worn.db"), good, sizeof good);
    TEST_ASSERT_TRUE(size < sizeof good);
    for (size_t page = 0; page + 4096 <= size; page += page < 12 * 4096 ? 4096 : 11 * 4096) {
        const char *path = temporary_write("worn.db", good, size);
        damage(path, (long)(page == 0 ? 100 : page), page == 0 ? 300 : 4096);
        open_spool("worn.db", 0);
        sift(); /* may find it only now */
        uint64_t there = count_whole();
        worst = page >= 8 * 4096 && there < worst ? there : worst;
        TEST_ASSERT_EQUAL_INT(PF_OK, put(30));
        TEST_ASSERT_EQUAL_UINT64(there + 1, count_whole());
        if (page == 0) { /* it holds no object, only where they are */
            TEST_ASSERT_EQUAL_UINT64(20, there);
            TEST_ASSERT_NOT_NULL(strstr(spool.ops->healing(spool.self), "saved from it"));
            TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
        }
        close_spool();
        for (int i = 1; i < 4; i++) {
            char aside[64];
            (void)snprintf(aside, sizeof aside, "worn.db.damaged-%d", i);
            TEST_ASSERT_TRUE(i > 1 || page > 0 || access(temporary_path(aside), F_OK) == 0);
            (void)unlink(temporary_path(aside));
        }
    }
    TEST_ASSERT_TRUE(worst >= 15); /* a page of one object's bytes costs that one; one of the tree costs a few */
}

/* Proves: a page that goes bad while the spool is in use costs what lies in it, and the survey goes on; rows that
 * somebody holds keep their numbers. */
static void test_damage_found_in_use_is_healed(void)
{
    open_spool("used.db", 0);
    for (uint64_t id = 1; id <= 20; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    close_spool();
    open_spool("used.db", 0);
    for (long page = 2; page < 6; page++)
        damage(temporary_path("used.db"), page * 4096, 4096);
    for (uint64_t id = 21; id <= 24; id++)
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, put(id), spool.ops->error(spool.self));
    sift();
    TEST_ASSERT_TRUE(count_whole() >= 4);
}

/* Proves: a header that names a newer format, which SQLite may read but not write, is damage like any other where the
 * file can be written: the next object is stored, and what was there is saved. */
static void test_a_header_of_a_newer_format_is_damage(void)
{
    open_spool("newer.db", 0);
    for (uint64_t id = 1; id <= 3; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    close_spool();
    FILE *f = fopen(temporary_path("newer.db"), "r+b");
    TEST_ASSERT_NOT_NULL(f);
    TEST_ASSERT_EQUAL_INT(0, fseek(f, 18, SEEK_SET)); /* the write version */
    TEST_ASSERT_EQUAL_INT(3, fputc(3, f));
    TEST_ASSERT_EQUAL_INT(0, fclose(f));
    open_spool("newer.db", 0);
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, put(4), spool.ops->error(spool.self));
    TEST_ASSERT_EQUAL_INT(4, count_whole());
}

enum { COUNT = 80 }; /* more than SQLite keeps in memory */

/* A spool of COUNT objects that is in use, and whose file has lost every page from `first` up to `end` (0: the last).
 */
static void open_and_wear(const char *name, long first, long end)
{
    struct stat file;
    open_spool(name, 0);
    for (uint64_t id = 1; id <= COUNT; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put(id));
    close_spool();
    open_spool(name, 0);
    sift(); /* somebody holds them */
    TEST_ASSERT_EQUAL_INT(0, stat(temporary_path(name), &file));
    for (long page = first; 4096 * (page + 1) <= file.st_size && (end == 0 || page < end); page++)
        damage(temporary_path(name), 4096 * page, 4096);
    TEST_ASSERT_EQUAL_UINT64(0, stats().healed);
}

/* Proves: the row of an object that was lost with its page, which a courier may still hold, is given to no other: its
 * acknowledgement would remove that. */
static void test_rows_of_lost_objects_are_not_given_again(void)
{
    pf_spool_item item = {0};
    open_and_wear("rows.db", 1, 0);
    for (int i = 0; i < 3 && stats().healed == 0; i++)
        (void)spool.ops->next(spool.self, 0, &item);
    TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
    TEST_ASSERT_EQUAL_INT(PF_OK, put(COUNT + 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
    TEST_ASSERT_TRUE(item.row > COUNT);
}

/* Proves: whichever call finds the damage, it is mended when that call has ended. */
static void test_damage_is_mended_by_the_call_that_finds_it(void)
{
    pf_spool_item item;
    for (int call = 0; call < 2; call++) {
        char name[32];
        (void)snprintf(name, sizeof name, "call%d.db", call);
        open_and_wear(name, 1, 0);
        if (call == 0)
            TEST_ASSERT_EQUAL_INT(PF_ERR_IO, spool.ops->remove(spool.self, 2));
        else
            TEST_ASSERT_EQUAL_INT(PF_ERR_IO, spool.ops->next(spool.self, 0, &item));
        TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), "malformed"));
        TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
        close_spool();
    }
}

/* ---- what keeps a damaged file from being read through */

/* A spool of MANY small objects and the value "survey", with a page in its midst that cannot be read. Returns how many
 * can be saved. */
static uint64_t make_worn(const char *name)
{
    static uint64_t whole;
    static uint8_t worn[1 << 20];
    static size_t size;
    const uint64_t value = 7;
    if (size == 0) {
        open_spool("model.db", 0);
        for (uint64_t id = 1; id <= MANY; id++)
            TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", &value, sizeof value));
        close_spool();
        damage(temporary_path("model.db"), 12 * 4096, 4096);
        size = slurp(temporary_path("model.db"), worn, sizeof worn);
        open_spool("model.db", 0);
        sift();
        whole = stats().objects;
        TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
        TEST_ASSERT_TRUE(whole > MANY / 2 && whole < MANY);
        close_spool();
    }
    (void)temporary_write(name, worn, size);
    return whole;
}

static bool is_unread(const char *name)
{
    char unread[64];
    (void)snprintf(unread, sizeof unread, "%s.damaged-1.unread", name);
    return access(temporary_path(unread), F_OK) == 0;
}

/* Opening paths with the one and without the other fails; NULL: none does. */
static const char *no_such, *but_not;

static int open_or_not(const char *path, int flags, int mode)
{
    if (no_such != NULL && strstr(path, no_such) != NULL && (but_not == NULL || strstr(path, but_not) == NULL)) {
        errno = EMFILE;
        return -1;
    }
    return open(path, flags, mode);
}

/* Proves: a damaged file whose successor cannot be opened now (no descriptor, no memory) is read through as soon as it
 * can: nothing that can be read is lost, and every call until then fails in words. */
static void test_a_damaged_file_without_a_successor_is_read_later(void)
{
    static uint8_t worn[8 << 20];
    pf_spool_item item;
    size_t n;
    open_and_wear("reopen.db", 60, 300);
    (void)temporary_write("twin.db", worn, slurp(temporary_path("reopen.db"), worn, sizeof worn));
    hook("open", (sqlite3_syscall_ptr)open_or_not);
    no_such = "reopen.db";
    but_not = "damaged";
    for (uint64_t row = 1; row <= COUNT; row++)
        (void)spool.ops->read(spool.self, &(pf_spool_item){.row = row}, read_bytes, sizeof read_bytes, &n);
    for (int i = 0; i < 3; i++) {
        TEST_ASSERT_EQUAL_INT(PF_ERR_IO, spool.ops->next(spool.self, 0, &item));
        TEST_ASSERT_NOT_NULL(strstr(spool.ops->error(spool.self), "reopen.db"));
    }
    no_such = but_not = NULL;
    sift();
    hook("open", NULL);
    TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
    uint64_t there = count_whole();
    TEST_ASSERT_EQUAL_UINT64(there, stats().objects);
    close_spool();
    open_spool("twin.db", 0);
    sift();
    TEST_ASSERT_EQUAL_UINT64(count_whole(), there);
    TEST_ASSERT_TRUE(there > COUNT / 2);
}

/* Proves: a damaged file that cannot be opened now, or whose log cannot (no descriptor is left), is not taken for one
 * with nothing in it: it stays unread, in words, and the next opening reads it. */
static void test_a_damaged_file_that_cannot_be_opened_now_is_read_later(void)
{
    static const char *const names[] = {".unread", ".unread-wal"};
    bool is_there[MANY + 2];
    uint64_t value = 0;
    size_t n;
    for (int i = 0; i < 2; i++) {
        char name[32];
        (void)snprintf(name, sizeof name, "scarce%d.db", i);
        const uint64_t whole = make_worn(name);
        hook("open", (sqlite3_syscall_ptr)open_or_not);
        no_such = names[i];
        open_spool(name, 0);
        sift();
        TEST_ASSERT_EQUAL_UINT64(0, stats().objects);
        TEST_ASSERT_TRUE(is_unread(name));
        const char *healing = spool.ops->healing(spool.self);
        TEST_ASSERT_NOT_NULL_MESSAGE(strstr(healing, "the next start tries again: unable to open"), healing);
        close_spool();
        no_such = NULL;
        hook("open", NULL);
        open_spool(name, 0);
        TEST_ASSERT_EQUAL_UINT64(whole, list_ids(is_there));
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", &value, sizeof value, &n));
        TEST_ASSERT_FALSE(is_unread(name));
        close_spool();
    }
}

/* Proves: a damaged file is read without memory shared with other programs: a medium that can have none, or no
 * descriptor for it, costs nothing. */
static void test_a_damaged_file_is_read_without_shared_memory(void)
{
    bool is_there[MANY + 2];
    const uint64_t whole = make_worn("alone.db");
    hook("open", (sqlite3_syscall_ptr)open_or_not);
    no_such = "-shm";
    open_spool("alone.db", 0);
    sift();
    no_such = NULL;
    hook("open", NULL);
    TEST_ASSERT_EQUAL_UINT64(whole, list_ids(is_there));
    TEST_ASSERT_FALSE(is_unread("alone.db"));
}

static bool is_worn_out;

static ssize_t pread_or_not(int fd, void *bytes, size_t n, off_t at)
{
    if (is_worn_out && at >= 20 * 4096 && at < 21 * 4096) {
        errno = EIO;
        return -1;
    }
    return pread(fd, bytes, n, at);
}

/* Proves: a sector that the medium does not give any more costs what lies in it; the file is not read again for ever.
 */
static void test_a_sector_that_cannot_be_read_is_given_up(void)
{
    const uint64_t whole = make_worn("sector.db");
    hook("pread", (sqlite3_syscall_ptr)pread_or_not);
    hook("pread64", (sqlite3_syscall_ptr)pread_or_not);
    is_worn_out = true;
    open_spool("sector.db", 0);
    is_worn_out = false;
    hook("pread", NULL);
    hook("pread64", NULL);
    TEST_ASSERT_FALSE(is_unread("sector.db"));
    TEST_ASSERT_TRUE(stats().objects > whole / 2 && stats().objects < whole);
}

/* Proves: a disk that is full while a damaged file is read through costs nothing: what was copied is there and the rest
 * comes at the next opening, whatever rows and values the spool has got meanwhile; what was removed does not come back.
 */
static void test_a_disk_that_is_full_while_a_damaged_file_is_read_loses_nothing(void)
{
    bool is_there[MANY + 2];
    const uint64_t whole = make_worn("tight.db");
    pf_spool_item item;
    uint64_t value = 0;
    size_t n;
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_or_not);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_or_not);
    hook("fallocate", (sqlite3_syscall_ptr)fallocate_or_not);
    refuse_with = ENOSPC;
    allowed = 120; /* the new file's beginning, and a transaction or two */
    open_spool("tight.db", 0);
    refuse_with = 0;
    TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(spool.ops->healing(spool.self), "the next start tries again"),
                                 spool.ops->healing(spool.self));
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(spool.ops->healing(spool.self), "full"), spool.ops->healing(spool.self));
    const uint64_t first = stats().objects;
    TEST_ASSERT_TRUE(first >= 64 && first < whole);
    TEST_ASSERT_TRUE(is_unread("tight.db"));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", &value, sizeof value, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", NULL, 0)); /* it ends */
    TEST_ASSERT_EQUAL_INT(PF_OK, put_small(MANY + 1));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->next(spool.self, 0, &item));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->remove(spool.self, item.row));
    close_spool();
    open_spool("tight.db", 0);
    TEST_ASSERT_EQUAL_UINT64(whole, list_ids(is_there)); /* one went, one came */
    TEST_ASSERT_TRUE(is_there[MANY + 1]);
    TEST_ASSERT_FALSE(is_there[1]);
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->get(spool.self, "survey", &value, sizeof value, &n));
    TEST_ASSERT_FALSE(is_unread("tight.db"));
    close_spool();
    open_spool("tight.db", 0);
    TEST_ASSERT_EQUAL_UINT64(0, stats().healed);
    TEST_ASSERT_EQUAL_UINT64(whole, stats().objects);
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
    hook("fallocate", NULL);
}

static int alive_until;

static void count_down(void)
{
    if (--alive_until == 0)
        _exit(0);
}

/* Proves: a kill at any object of a damaged file that is being read through costs nothing, for the next opening goes
 * on; and that the caller hears often enough that it goes on (once an object). */
static void test_a_kill_while_a_damaged_file_is_read_loses_nothing(void)
{
    bool is_there[MANY + 2];
    const uint64_t whole = make_worn("cutshort.db");
    const pf_spool_config config = {.path = temporary_path("cutshort.db"), .alive = count_down};
    int kills = 0;
    for (; kills < 2 * MANY; kills++) {
        int status;
        (void)fflush(stdout);
        pid_t child = fork();
        TEST_ASSERT_TRUE(child >= 0);
        if (child == 0) {
            alive_until = 1 + 64 + kills % 7; /* a transaction further, each time */
            if (pf_spool_open(&spool, &config, error, sizeof error) != PF_OK)
                _exit(1);
            sift();
            _exit(2); /* all was read */
        }
        TEST_ASSERT_EQUAL_INT(child, waitpid(child, &status, 0));
        TEST_ASSERT_TRUE(WIFEXITED(status) && WEXITSTATUS(status) != 1);
        if (WEXITSTATUS(status) == 2)
            break;
    }
    TEST_ASSERT_TRUE(kills >= 3 && kills < MANY);
    open_spool("cutshort.db", 0);
    TEST_ASSERT_EQUAL_UINT64(whole, list_ids(is_there));
    TEST_ASSERT_FALSE(is_unread("cutshort.db"));
}

/* Proves: a kill between the new names of a damaged file and of its log costs nothing that is only in the log. */
static void test_a_kill_between_the_two_renames_loses_nothing(void)
{
    static uint8_t bytes[1 << 20];
    bool is_there[MANY + 2];
    open_spool("halfway.db", 0);
    for (uint64_t id = 1; id <= 40; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    (void)temporary_write("cut.db.damaged-2.unread", bytes, slurp(temporary_path("halfway.db"), bytes, sizeof bytes));
    (void)temporary_write("cut.db-wal", bytes, slurp(temporary_path("halfway.db-wal"), bytes, sizeof bytes));
    close_spool();
    open_spool("cut.db", 0);
    TEST_ASSERT_EQUAL_UINT64(40, list_ids(is_there));
    TEST_ASSERT_EQUAL_UINT64(1, stats().healed);
}

/* Gives what is to be an unread file of `name`: objects from `first` to `last`, a value, and another. */
static void make_unread(const char *name, int number, uint64_t first, uint64_t last, const char *key, uint64_t value,
                        const char *other, const int64_t rows[2])
{
    char model[32], unread[64];
    (void)snprintf(model, sizeof model, "%s-%d", name, number);
    (void)snprintf(unread, sizeof unread, "%s.damaged-%d.unread", name, number);
    open_spool(model, 0);
    for (uint64_t id = first; id <= last; id++)
        TEST_ASSERT_EQUAL_INT(PF_OK, put_small(id));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, key, &value, sizeof value));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, other, rows, 2 * sizeof *rows));
    close_spool();
    TEST_ASSERT_EQUAL_INT(0, rename(temporary_path(model), temporary_path(unread)));
}

/* Proves: of two damaged files that wait, the newer one's values win: a keyframe number is not used twice. A value that
 * the newer had taken from the older and then removed, a survey that had ended, does not come back; the objects of the
 * older come all, for those that the newer had taken may be lost with it. */
static void test_of_two_damaged_files_the_newer_has_the_last_word(void)
{
    static const int64_t rows[2] = {2, INT64_MAX};
    bool is_there[MANY + 2];
    uint64_t value = 0;
    int64_t other[2];
    size_t n;
    make_unread("two.db", 1, 1, 5, "survey", 1, "first", rows);
    make_unread("two.db", 2, 6, 9, "survey", 2, "second", rows);
    open_spool("two.db", 0);
    TEST_ASSERT_EQUAL_UINT64(9, list_ids(is_there));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", &value, sizeof value, &n));
    TEST_ASSERT_EQUAL_UINT64(2, value);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "first", other, sizeof other, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "second", other, sizeof other, &n));
    close_spool();
    make_unread("ended.db", 1, 1, 5, "survey", 1, "first", rows);
    make_unread("ended.db", 2, 6, 9, "next", 2, "salvage 1", rows);
    open_spool("ended.db", 0);
    TEST_ASSERT_EQUAL_UINT64(9, list_ids(is_there));
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->get(spool.self, "survey", &value, sizeof value, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "next", &value, sizeof value, &n));
    TEST_ASSERT_EQUAL_INT(PF_ERR_END, spool.ops->get(spool.self, "salvage 1", other, sizeof other, &n));
}

/* Proves: a file that is set aside while another waits gets the higher number, also where a lower one is free: the
 * highest is the newest. */
static void test_a_newer_damaged_file_gets_the_higher_number(void)
{
    static const int64_t rows[2] = {2, INT64_MAX};
    uint64_t value = 2;
    size_t n;
    make_unread("order.db", 5, 1, 5, "survey", 1, "first", rows);
    open_spool("order.db-model", 0);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->set(spool.self, "survey", &value, sizeof value));
    close_spool();
    damage(temporary_path("order.db-model"), 4096, 4096); /* the objects' table */
    TEST_ASSERT_EQUAL_INT(0, rename(temporary_path("order.db-model"), temporary_path("order.db")));
    hook("open", (sqlite3_syscall_ptr)open_or_not);
    no_such = ".unread";
    open_spool("order.db", 0);
    sift();
    no_such = NULL;
    hook("open", NULL);
    TEST_ASSERT_EQUAL_INT(0, access(temporary_path("order.db.damaged-6.unread"), F_OK));
    close_spool();
    open_spool("order.db", 0);
    TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->get(spool.self, "survey", &value, sizeof value, &n));
    TEST_ASSERT_EQUAL_UINT64(2, value);
    TEST_ASSERT_EQUAL_UINT64(5, stats().objects);
}

static struct {
    const char *read; /* its name when all of it has been read */
    bool is_synced;   /* with that name */
    int writes;       /* since */
} folder;

/* SQLite's calls land here too. */
int fsync(int fd)
{
    struct stat file;
    if (folder.read != NULL && fstat(fd, &file) == 0 && S_ISDIR(file.st_mode) && access(folder.read, F_OK) == 0) {
        folder.is_synced = true;
        folder.writes = 0;
    }
    return (int)syscall(SYS_fsync, fd);
}

static ssize_t pwrite_counted(int fd, const void *bytes, size_t n, off_t at)
{
    folder.writes++;
    return pwrite(fd, bytes, n, at);
}

/* Proves: how far a damaged file was read is forgotten only when its new name is on the disk: else a power cut would
 * bring back what was removed since. */
static void test_the_new_name_is_on_the_disk_before_the_progress_is_forgotten(void)
{
    (void)make_worn("renamed.db");
    hook("pwrite", (sqlite3_syscall_ptr)pwrite_counted);
    hook("pwrite64", (sqlite3_syscall_ptr)pwrite_counted);
    folder.read = strdup(temporary_path("renamed.db.damaged-1"));
    open_spool("renamed.db", 0);
    sift();
    TEST_ASSERT_TRUE(folder.is_synced);
    TEST_ASSERT_TRUE(folder.writes > 0);
    free((void *)folder.read);
    folder.read = NULL;
    hook("pwrite", NULL);
    hook("pwrite64", NULL);
}

int main(void)
{
    (void)setenv("TMPDIR", "/dev/shm", 1);
    temporary_make();
    UNITY_BEGIN();
    RUN_TEST(test_a_damaged_file_is_set_aside_and_what_is_whole_is_saved);
    RUN_TEST(test_damage_found_in_use_is_healed);
    RUN_TEST(test_a_header_of_a_newer_format_is_damage);
    RUN_TEST(test_rows_of_lost_objects_are_not_given_again);
    RUN_TEST(test_a_damaged_file_without_a_successor_is_read_later);
    RUN_TEST(test_a_damaged_file_that_cannot_be_opened_now_is_read_later);
    RUN_TEST(test_a_damaged_file_is_read_without_shared_memory);
    RUN_TEST(test_a_sector_that_cannot_be_read_is_given_up);
    RUN_TEST(test_a_disk_that_is_full_while_a_damaged_file_is_read_loses_nothing);
    RUN_TEST(test_a_kill_while_a_damaged_file_is_read_loses_nothing);
    RUN_TEST(test_the_new_name_is_on_the_disk_before_the_progress_is_forgotten);
    RUN_TEST(test_a_kill_between_the_two_renames_loses_nothing);
    RUN_TEST(test_of_two_damaged_files_the_newer_has_the_last_word);
    RUN_TEST(test_a_newer_damaged_file_gets_the_higher_number);
    RUN_TEST(test_damage_is_mended_by_the_call_that_finds_it);
    temporary_remove();
    return UNITY_END();
}
