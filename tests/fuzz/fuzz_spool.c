/* The spool's recovery from whatever a power cut or a worn medium has left of its file and its log, and its salvage of
 * what a file that it sets aside still has. The files live in memory (a file system of SQLite's own kind, and what the
 * spool asks of the system's by name), so an input costs no disk. The input's first byte chooses what lies there: a
 * spool as kill -9 leaves it, with its log, or one that was closed; a valid header before bytes of the input's own;
 * whether the log's checksums are repaired, so that damage behind them is reached; whether it cannot be written at
 * first; and after how many reads the first program that opens it is told of an error that passes. The rest are changes
 * and cuts. Invariants: opening ends, well or with an error in words; an object that is handed out has the bytes of its
 * name, and rows ascend; what is stored in undamaged files without an error is there after opening again, and they lose
 * nothing, also by errors that pass; what cannot be written is read; after any damage the next object
 * is stored; damage to pages that hold no objects, only an index of them, costs none.
 */
#include "pipefish/drivers/sha256.h"
#include "pipefish/drivers/spool.h"

#include <errno.h>
#include <limits.h>
#include <sanitizer/asan_interface.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { FILES = 10, CAPACITY = 1 << 19, OBJECTS = 6, OBJECT_MAX = 6000, WALK_MAX = 64, NAME_MAX_BYTES = 48 };
enum { DATABASE = 0, LOG = 1 };
enum { CLOSED = 1, REPAIRED = 2, RAW = 4, READ_ONLY = 8, READS_SHIFT = 4 };

typedef struct image {
    uint8_t bytes[CAPACITY];
    size_t n;
    bool is_there;
    char name[NAME_MAX_BYTES]; /* "": a temporary one, which goes when it is closed */
} image;

#define PATH "/spool.db"

static image disk[FILES], crashed[2], closed;
static bool is_read_only;
static int reads_left = INT_MAX;
static uint32_t aside; /* files of a name other than the spool's and its log's */
static uint8_t names[OBJECTS][32];
static uint64_t index_pages; /* of the closed spool: bits, page 1 is bit 0 */

static void require(bool holds)
{
    if (!holds)
        abort();
}

/* ---- SQLite's memory, guarded as the sanitizer's own is, and four times as quick: each piece lies between poisoned
 * ones, and is poisoned when it is freed until the input has ended */

enum { HEAP = 1 << 25, GUARD = 16 };

static _Alignas(16) uint8_t heap[HEAP];
static size_t heap_used, heap_kept; /* kept: what SQLite took when it began */
static int32_t pieces, pieces_kept;

__attribute__((no_sanitize("address"))) static int piece_size(void *piece)
{
    return *(const int *)(const void *)((const uint8_t *)piece - GUARD);
}

__attribute__((no_sanitize("address"))) static void *take_piece(int n)
{
    size_t size = ((size_t)n + 15) / 16 * 16 + GUARD;
    if (size > HEAP - heap_used)
        return NULL;
    uint8_t *piece = heap + heap_used + GUARD;
    *(int *)(void *)(piece - GUARD) = n;
    heap_used += size;
    pieces++;
    ASAN_UNPOISON_MEMORY_REGION(piece, (size_t)n);
    return piece;
}

static void free_piece(void *piece)
{
    pieces--;
    ASAN_POISON_MEMORY_REGION(piece, (size_t)piece_size(piece));
}

static void *change_piece(void *piece, int n)
{
    int had = piece_size(piece);
    void *other = take_piece(n);
    if (other != NULL) {
        memcpy(other, piece, (size_t)(had < n ? had : n));
        free_piece(piece);
    }
    return other;
}

static int round_up(int n)
{
    return (n + 7) / 8 * 8;
}

static int open_heap(void *nothing)
{
    (void)nothing;
    ASAN_POISON_MEMORY_REGION(heap, sizeof heap);
    return SQLITE_OK;
}

static void close_heap(void *nothing)
{
    (void)nothing;
}

static void reset_heap(void)
{
    require(pieces == pieces_kept); /* nothing was leaked */
    ASAN_POISON_MEMORY_REGION(heap + heap_kept, heap_used - heap_kept);
    heap_used = heap_kept;
}

/* ---- a file system in memory: SQLite's interface */

typedef struct file {
    sqlite3_file base;
    image *image;
} file;

static int close_file(sqlite3_file *f)
{
    image *i = ((file *)f)->image;
    if (i->name[0] == '\0')
        i->is_there = false;
    return SQLITE_OK;
}

static int read_file(sqlite3_file *f, void *to, int n, sqlite3_int64 at)
{
    const image *i = ((file *)f)->image;
    if (reads_left != INT_MAX && reads_left-- <= 0)
        return SQLITE_IOERR_NOMEM;
    size_t have = (size_t)at < i->n ? i->n - (size_t)at : 0, take = have < (size_t)n ? have : (size_t)n;
    memset(to, 0, (size_t)n);
    memcpy(to, i->bytes + (take ? at : 0), take);
    return take == (size_t)n ? SQLITE_OK : SQLITE_IOERR_SHORT_READ;
}

static int write_file(sqlite3_file *f, const void *from, int n, sqlite3_int64 at)
{
    image *i = ((file *)f)->image;
    if (is_read_only)
        return SQLITE_IOERR_WRITE;
    if (at + n > CAPACITY)
        return SQLITE_FULL;
    if ((size_t)at > i->n)
        memset(i->bytes + i->n, 0, (size_t)at - i->n);
    memcpy(i->bytes + at, from, (size_t)n);
    if ((size_t)(at + n) > i->n)
        i->n = (size_t)(at + n);
    return SQLITE_OK;
}

static int cut_file(sqlite3_file *f, sqlite3_int64 n)
{
    image *i = ((file *)f)->image;
    if (is_read_only)
        return SQLITE_IOERR_TRUNCATE;
    if ((size_t)n < i->n)
        i->n = (size_t)n;
    return SQLITE_OK;
}

static int sync_file(sqlite3_file *f, int flags)
{
    (void)f;
    (void)flags;
    return SQLITE_OK;
}

static int size_of_file(sqlite3_file *f, sqlite3_int64 *n)
{
    *n = (sqlite3_int64)((file *)f)->image->n;
    return SQLITE_OK;
}

static int lock_file(sqlite3_file *f, int how)
{
    (void)f;
    (void)how;
    return SQLITE_OK;
}

static int is_locked(sqlite3_file *f, int *is)
{
    (void)f;
    *is = 0;
    return SQLITE_OK;
}

static int control_file(sqlite3_file *f, int what, void *argument)
{
    (void)f;
    (void)what;
    (void)argument;
    return SQLITE_NOTFOUND;
}

static int sector_size(sqlite3_file *f)
{
    (void)f;
    return 4096;
}

static int characteristics(sqlite3_file *f)
{
    (void)f;
    return 0;
}

/* The index of a log, which a connection that does not lock its file for good has outside itself: salvage's, one at a
 * time. */

enum { INDEX_PARTS = 4, INDEX_PART = 1 << 15 };

static _Alignas(16) uint8_t log_index[INDEX_PARTS][INDEX_PART];
static int index_parts;

static int map_index(sqlite3_file *f, int part, int size, int extend, void volatile **at)
{
    (void)f;
    *at = NULL;
    if (size != INDEX_PART || part >= INDEX_PARTS)
        return SQLITE_IOERR_SHMMAP;
    for (; part >= index_parts && extend; index_parts++)
        memset(log_index[index_parts], 0, INDEX_PART);
    if (part < index_parts)
        *at = log_index[part];
    return SQLITE_OK;
}

static int lock_index(sqlite3_file *f, int at, int n, int how)
{
    (void)f;
    (void)at;
    (void)n;
    (void)how;
    return SQLITE_OK;
}

static void order_index(sqlite3_file *f)
{
    (void)f;
}

static int unmap_index(sqlite3_file *f, int is_last)
{
    (void)f;
    (void)is_last;
    index_parts = 0;
    return SQLITE_OK;
}

static const sqlite3_io_methods methods = {.iVersion = 2,
                                           .xClose = close_file,
                                           .xRead = read_file,
                                           .xWrite = write_file,
                                           .xTruncate = cut_file,
                                           .xSync = sync_file,
                                           .xFileSize = size_of_file,
                                           .xLock = lock_file,
                                           .xUnlock = lock_file,
                                           .xCheckReservedLock = is_locked,
                                           .xFileControl = control_file,
                                           .xSectorSize = sector_size,
                                           .xDeviceCharacteristics = characteristics,
                                           .xShmMap = map_index,
                                           .xShmLock = lock_index,
                                           .xShmBarrier = order_index,
                                           .xShmUnmap = unmap_index};

static bool is_ours(const char *path)
{
    return strncmp(path, PATH, sizeof PATH - 1) == 0;
}

static image *find_image(const char *path)
{
    const char *rest = path + sizeof PATH - 1;
    if (!is_ours(path))
        return NULL;
    if (aside == 0 && rest[0] == '.') /* asked a hundred times an input */
        return NULL;
    for (image *i = disk; i < disk + FILES; i++)
        if (i->is_there && strcmp(i->name, path) == 0)
            return i;
    return NULL;
}

static void name_image(image *i, const char *path)
{
    aside -= i->name[0] != '\0' && i->name[sizeof PATH - 1] == '.';
    (void)snprintf(i->name, sizeof i->name, "%s", path);
    aside += i->name[0] != '\0' && i->name[sizeof PATH - 1] == '.';
}

static void forget(image *i)
{
    name_image(i, "");
    i->is_there = false;
}

static image *make_image(const char *path)
{
    image *i = disk;
    while (i < disk + FILES && i->is_there)
        i++;
    if (i == disk + FILES)
        return NULL;
    i->n = 0;
    i->is_there = true;
    name_image(i, path);
    return i;
}

static int open_file(sqlite3_vfs *vfs, const char *path, sqlite3_file *f, int flags, int *out)
{
    image *i = path != NULL ? find_image(path) : NULL;
    (void)vfs;
    if (i == NULL && flags & SQLITE_OPEN_CREATE && (path == NULL || !is_read_only))
        i = make_image(path != NULL && strstr(path, "-journal") == NULL ? path : "");
    f->pMethods = NULL;
    if (i == NULL)
        return SQLITE_CANTOPEN;
    ((file *)f)->image = i;
    f->pMethods = &methods;
    if (out != NULL)
        *out = flags;
    return SQLITE_OK;
}

static int delete_file(sqlite3_vfs *vfs, const char *path, int sync)
{
    image *i = find_image(path);
    (void)vfs;
    (void)sync;
    if (is_read_only)
        return SQLITE_IOERR_DELETE;
    if (i != NULL)
        forget(i);
    return SQLITE_OK;
}

static int access_file(sqlite3_vfs *vfs, const char *path, int flags, int *is)
{
    (void)vfs;
    (void)flags;
    *is = find_image(path) != NULL;
    return SQLITE_OK;
}

static int full_path(sqlite3_vfs *vfs, const char *path, int n, char *out)
{
    (void)vfs;
    (void)sqlite3_snprintf(n, out, "%s", path);
    return SQLITE_OK;
}

static int random_bytes(sqlite3_vfs *vfs, int n, char *out)
{
    (void)vfs;
    memset(out, 7, (size_t)n);
    return n;
}

static int sleep_a_while(sqlite3_vfs *vfs, int us)
{
    (void)vfs;
    return us;
}

static int tell_time(sqlite3_vfs *vfs, double *now)
{
    (void)vfs;
    *now = 2460000.5;
    return SQLITE_OK;
}

static sqlite3_vfs memory = {.iVersion = 1,
                             .szOsFile = sizeof(file),
                             .mxPathname = 256,
                             .zName = "memory",
                             .xOpen = open_file,
                             .xDelete = delete_file,
                             .xAccess = access_file,
                             .xFullPathname = full_path,
                             .xRandomness = random_bytes,
                             .xSleep = sleep_a_while,
                             .xCurrentTime = tell_time},
                   unlocked; /* takes the place of the system's */

/* ---- the same files by name, for the spool itself: the linker gives its calls to these (--wrap) */

int __real_access(const char *path, int how);
int __wrap_access(const char *path, int how);
int __real_rename(const char *from, const char *to);
int __wrap_rename(const char *from, const char *to);
FILE *__real_fopen(const char *path, const char *how);
FILE *__wrap_fopen(const char *path, const char *how);
int __real_stat(const char *path, struct stat *told);
int __wrap_stat(const char *path, struct stat *told);
bool __wrap_pf_file_sync_folder(const char *path);

int __wrap_access(const char *path, int how)
{
    if (!is_ours(path) && strcmp(path, "/") != 0)
        return __real_access(path, how);
    errno = how == W_OK && is_read_only ? EROFS : ENOENT;
    return errno != EROFS && (!is_ours(path) || find_image(path) != NULL) ? 0 : -1;
}

int __wrap_rename(const char *from, const char *to)
{
    if (!is_ours(from))
        return __real_rename(from, to);
    image *i = find_image(from), *old = find_image(to);
    if (is_read_only) {
        errno = EROFS;
        return -1;
    }
    require(strlen(to) < NAME_MAX_BYTES);
    if (i == NULL)
        return -1;
    if (old != NULL)
        forget(old);
    name_image(i, to);
    return 0;
}

FILE *__wrap_fopen(const char *path, const char *how)
{
    if (!is_ours(path))
        return __real_fopen(path, how);
    image *i = find_image(path);
    return i != NULL && i->n > 0 ? fmemopen(i->bytes, i->n, how) : NULL;
}

int __wrap_stat(const char *path, struct stat *told)
{
    if (!is_ours(path))
        return __real_stat(path, told);
    const image *i = find_image(path);
    *told = (struct stat){.st_size = i != NULL ? (off_t)i->n : 0};
    return i != NULL ? 0 : -1;
}

bool __wrap_pf_file_sync_folder(const char *path)
{
    return is_ours(path);
}

/* ---- spools */

static bool open_spool(pf_spool *spool)
{
    const pf_spool_config config = {.path = PATH, .quota = CAPACITY / 4};
    char error[512] = "";
    pf_status status = pf_spool_open(spool, &config, error, sizeof error);
    require(status == PF_OK || status == PF_ERR_FORMAT || status == PF_ERR_VERSION || status == PF_ERR_IO ||
            status == PF_ERR_SPACE);
    require((status == PF_OK) == (error[0] == '\0'));
    return status == PF_OK;
}

static size_t make_object(uint32_t id, uint8_t *bytes, uint8_t name[32])
{
    size_t n = 200 + 900 * (size_t)(id % OBJECTS);
    for (size_t i = 0; i < n; i++)
        bytes[i] = (uint8_t)(id * 31 + i * 7);
    require(pf_sha256(bytes, n, name) == PF_OK);
    return n;
}

static pf_status put_over(const pf_spool *spool, uint32_t id, const pf_spool_victim *victims, uint32_t count,
                          uint8_t name[32])
{
    static uint8_t bytes[OBJECT_MAX];
    const pf_spool_rank rank = {id % 3, id};
    size_t n = make_object(id, bytes, name);
    return spool->ops->exchange(spool->self, victims, count, 2, name, bytes, n, id % 2 ? &rank : NULL, "survey", &id,
                                sizeof id);
}

static pf_status put(const pf_spool *spool, uint32_t id, uint8_t name[32])
{
    return put_over(spool, id, NULL, 0, name);
}

/* How many objects come out, each checked; whether `name` is among them. */
static uint32_t walk(const pf_spool *spool, const uint8_t *name, bool *is_there)
{
    static uint8_t bytes[OBJECT_MAX];
    uint8_t hash[32];
    pf_spool_item item = {.row = 0};
    uint32_t intact = 0;
    uint64_t row = 0;
    *is_there = false;
    for (uint32_t i = 0; i < WALK_MAX && spool->ops->next(spool->self, row, &item) == PF_OK; i++) {
        size_t n = 0;
        require(item.row > row);
        row = item.row;
        if (spool->ops->read(spool->self, &item, bytes, sizeof bytes, &n) != PF_OK)
            continue;
        require(n <= sizeof bytes && pf_sha256(bytes, n, hash) == PF_OK && memcmp(hash, item.name, 32) == 0);
        intact++;
        *is_there = *is_there || memcmp(hash, name, 32) == 0;
    }
    return intact;
}

static void find_indices(void)
{
    sqlite3 *db = NULL;
    sqlite3_stmt *q = NULL;
    require(sqlite3_open_v2(PATH, &db, SQLITE_OPEN_READWRITE, NULL) == SQLITE_OK);
    require(sqlite3_prepare_v2(db, "SELECT rootpage FROM sqlite_schema WHERE type = 'index'", -1, &q, NULL) ==
            SQLITE_OK);
    while (sqlite3_step(q) == SQLITE_ROW)
        index_pages |= UINT64_C(1) << (sqlite3_column_int(q, 0) - 1);
    sqlite3_finalize(q);
    require(sqlite3_close(db) == SQLITE_OK && index_pages != 0);
}

static void begin(void)
{
    static const sqlite3_mem_methods memory_methods = {.xMalloc = take_piece,
                                                       .xFree = free_piece,
                                                       .xRealloc = change_piece,
                                                       .xSize = piece_size,
                                                       .xRoundup = round_up,
                                                       .xInit = open_heap,
                                                       .xShutdown = close_heap};
    pf_spool spool;
    require(sqlite3_config(SQLITE_CONFIG_SINGLETHREAD) == SQLITE_OK);
    require(sqlite3_config(SQLITE_CONFIG_MEMSTATUS, 0) == SQLITE_OK);
    require(sqlite3_config(SQLITE_CONFIG_LOOKASIDE, 0, 0) == SQLITE_OK);
    require(sqlite3_config(SQLITE_CONFIG_MALLOC, &memory_methods) == SQLITE_OK);
    require(sqlite3_vfs_register(&memory, 1) == SQLITE_OK);
    unlocked = memory;
    unlocked.zName = "unix-none";
    require(sqlite3_vfs_unregister(sqlite3_vfs_find("unix-none")) == SQLITE_OK);
    require(sqlite3_vfs_register(&unlocked, 0) == SQLITE_OK);
    require(open_spool(&spool));
    for (uint32_t id = 0; id < OBJECTS; id++)
        require(put(&spool, id, names[id]) == PF_OK);
    require(spool.ops->remove(spool.self, 1) == PF_OK);
    require(strcmp(disk[DATABASE].name, PATH) == 0 && strcmp(disk[LOG].name, PATH "-wal") == 0);
    crashed[DATABASE] = disk[DATABASE];
    crashed[LOG] = disk[LOG];
    spool.ops->close(spool.self);
    closed = disk[DATABASE];
    find_indices();
    heap_kept = heap_used;
    pieces_kept = pieces;
}

/* ---- what the input does to them */

static uint32_t get_be(const uint8_t *b)
{
    return (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3];
}

static void put_be(uint8_t *b, uint32_t v)
{
    for (int i = 0; i < 4; i++)
        b[i] = (uint8_t)(v >> (24 - 8 * i));
}

/* SQLite's checksum of a log, of little-endian words. */
static void sum(uint32_t s[2], const uint8_t *b, size_t n)
{
    for (size_t i = 0; i + 8 <= n; i += 8) {
        uint32_t x[2];
        memcpy(x, b + i, sizeof x);
        s[0] += x[0] + s[1];
        s[1] += x[1] + s[0];
    }
}

/* Makes the log's checksums and salts right for whatever is in its frames. */
static void repair_log(image *log)
{
    uint8_t *b = log->bytes;
    uint32_t page = 4096, s[2] = {0, 0};
    if (log->n < 32)
        return;
    put_be(b, 0x377F0682);
    put_be(b + 4, 3007000);
    put_be(b + 8, page);
    sum(s, b, 24);
    put_be(b + 24, s[0]);
    put_be(b + 28, s[1]);
    for (size_t at = 32; at + 24 + page <= log->n; at += 24 + page) {
        memcpy(b + at + 8, b + 16, 8);
        sum(s, b + at, 8);
        sum(s, b + at + 24, page);
        put_be(b + at + 16, s[0]);
        put_be(b + at + 20, s[1]);
        require(get_be(b + at + 16) == s[0]);
    }
}

/* Changes of six bytes: which file and what, where (24 bits), value, how many. Returns whether anything was changed;
 * *pages: in which pages, 0 if not in any in particular. */
static bool damage(const uint8_t *data, size_t size, uint64_t *pages)
{
    bool has_changed = false, is_anywhere = false;
    *pages = 0;
    for (; size >= 6; data += 6, size -= 6) {
        image *i = &disk[data[0] & 1];
        size_t at = (size_t)data[1] | (size_t)data[2] << 8 | (size_t)data[3] << 16;
        if (!i->is_there || i->n == 0)
            continue;
        at %= i->n;
        if (data[0] & 2) /* the cell pointers and headers of pages are where it hurts */
            at = at / 4096 * 4096 + at % 64;
        if ((data[0] & 0xF0) == 0xF0 || at / 4096 != (at + 7) / 4096 || at / 4096 >= 64)
            is_anywhere = true;
        else
            *pages |= UINT64_C(1) << at / 4096;
        if ((data[0] & 0xF0) == 0xF0)
            i->n = at; /* cut short */
        else
            for (size_t k = 0; k <= data[5] % 8u && at + k < i->n; k++)
                i->bytes[at + k] = (uint8_t)(data[0] & 4 ? i->bytes[at + k] ^ data[4] : data[4]);
        has_changed = true;
    }
    *pages = is_anywhere ? 0 : *pages;
    return has_changed;
}

static void lay(const image *from, const char *name)
{
    image *i = make_image(name);
    require(i != NULL);
    memcpy(i->bytes, from->bytes, from->n);
    i->n = from->n;
}

/* A program that can write nothing: it hands out what is there, and takes nothing. */
static void read_only(bool is_whole)
{
    pf_spool spool;
    uint8_t name[32] = {0};
    bool is_there;
    is_read_only = true;
    if (open_spool(&spool)) {
        uint32_t intact = walk(&spool, name, &is_there);
        require(!is_whole || intact == OBJECTS - 1);
        require(put(&spool, 100, name) != PF_OK && spool.ops->remove(spool.self, 2) != PF_OK);
        require(spool.ops->keep_all(spool.self) != PF_OK && spool.ops->error(spool.self)[0] != '\0');
        spool.ops->close(spool.self);
    } else {
        require(!is_whole);
    }
    is_read_only = false;
}

/* A program whose reads fail after so many, for a moment. */
static void fail_for_a_moment(int reads)
{
    pf_spool spool;
    uint8_t name[32] = {0};
    bool is_there;
    reads_left = reads;
    if (open_spool(&spool)) {
        (void)walk(&spool, name, &is_there);
        (void)put(&spool, 200, name);
        spool.ops->close(spool.self);
    }
    reads_left = INT_MAX;
}

static void try_files(const uint8_t *data, size_t size)
{
    pf_spool spool;
    pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX];
    uint8_t name[32] = {0}, value[64];
    uint32_t count;
    size_t n;
    bool is_there, is_spared, is_whole = true;
    uint64_t pages = 0;
    for (uint32_t i = 0; i < FILES; i++)
        forget(&disk[i]);
    const uint8_t how = data[0];
    lay(how & CLOSED ? &closed : &crashed[DATABASE], PATH);
    if (!(how & CLOSED))
        lay(&crashed[LOG], PATH "-wal");
    if (how & RAW) {
        size_t length = size - 1 < CAPACITY - 100 ? size - 1 : CAPACITY - 100;
        memcpy(disk[DATABASE].bytes + 100, data + 1, length);
        is_whole = length == 0;
    } else {
        is_whole = !damage(data + 1, size - 1, &pages);
    }
    if (how & REPAIRED && disk[LOG].is_there)
        repair_log(&disk[LOG]);
    is_spared = is_whole || (how & CLOSED && pages != 0 && (pages & ~index_pages) == 0);
    if (how & READ_ONLY)
        read_only(is_whole);
    if (how >> READS_SHIFT)
        fail_for_a_moment(4 * (how >> READS_SHIFT));
    if (!open_spool(&spool)) {
        require(!is_whole);
        return;
    }
    uint32_t intact = walk(&spool, name, &is_there);
    require(!is_whole || intact >= OBJECTS - 1);
    (void)spool.ops->get(spool.self, "survey", value, sizeof value, &n);
    (void)spool.ops->set(spool.self, "other", data, size < 40 ? size : 40);
    uint32_t left = OBJECTS - 2; /* at least: row 1 was removed, and row 2 will be */
    if (spool.ops->victims(spool.self, 0, 9, 1000, victims, &count) == PF_OK && how & CLOSED)
        left += (put_over(&spool, 99, victims, count, name) == PF_OK) - count;
    else
        (void)spool.ops->keep_all(spool.self);
    (void)spool.ops->remove(spool.self, 2);
    pf_status status = put(&spool, 100 + how % 7u, name);
    require(!is_whole || status == PF_OK);
    if (status != PF_OK) /* damage that was found in storing; the next survey is stored */
        status = put(&spool, 100 + how % 7u, name);
    require(status == PF_OK || status == PF_ERR_SPACE);
    spool.ops->close(spool.self);
    left += status == PF_OK;
    if (open_spool(&spool)) {
        intact = walk(&spool, name, &is_there);
        require(!is_spared || (is_there && intact >= left));
        spool.ops->close(spool.self);
    } else {
        require(!is_spared);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (!closed.is_there)
        begin();
    if (size >= 1)
        try_files(data, size);
    reset_heap();
    return 0;
}
