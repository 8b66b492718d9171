#include "memory_files.h"

#include <errno.h>
#include <limits.h>
#include <sanitizer/asan_interface.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

memory_medium medium = {.reads_left = INT_MAX};

static uint32_t aside; /* files of a name other than the spool's and its log's */

void require(bool holds)
{
    if (!holds)
        abort();
}

/* ---- SQLite's memory, guarded as the sanitizer's own is, and quicker, which makes twice as many inputs of it: each
 * piece lies between poisoned ones, and is poisoned when it is freed until memory_reset(), but that there is room for
 * large ones again: the spool asks for more than any object takes, to see whether there is memory */

enum { HEAP = 1 << 28, GUARD = 16, LARGE = 1 << 20 };

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
    if (size > HEAP - heap_used || medium.reads_left < 0)
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
    const int n = piece_size(piece);
    pieces--;
    ASAN_POISON_MEMORY_REGION(piece, (size_t)n);
    if (n > LARGE && (uint8_t *)piece + ((size_t)n + 15) / 16 * 16 == heap + heap_used)
        heap_used = (size_t)((uint8_t *)piece - heap) - GUARD;
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

void memory_reset(void)
{
    require(pieces == pieces_kept); /* nothing was leaked */
    ASAN_POISON_MEMORY_REGION(heap + heap_kept, heap_used - heap_kept);
    heap_used = heap_kept;
}

/* ---- a file system in memory: SQLite's interface */

typedef struct file {
    sqlite3_file base;
    memory_file *content;
} file;

static int close_file(sqlite3_file *f)
{
    memory_file *i = ((file *)f)->content;
    if (i->name[0] == '\0')
        i->is_there = false;
    return SQLITE_OK;
}

static int read_file(sqlite3_file *f, void *to, int n, sqlite3_int64 at)
{
    const memory_file *i = ((file *)f)->content;
    if (medium.reads_left != INT_MAX && medium.reads_left-- <= 0)
        return SQLITE_IOERR_NOMEM;
    size_t have = (size_t)at < i->n ? i->n - (size_t)at : 0, take = have < (size_t)n ? have : (size_t)n;
    memcpy(to, i->bytes + (take ? at : 0), take);
    memset((uint8_t *)to + take, 0, (size_t)n - take);
    return take == (size_t)n ? SQLITE_OK : SQLITE_IOERR_SHORT_READ;
}

static int write_file(sqlite3_file *f, const void *from, int n, sqlite3_int64 at)
{
    memory_file *i = ((file *)f)->content;
    if (medium.is_read_only)
        return SQLITE_IOERR_WRITE;
    if (at + n > MEMORY_FILE_MAX) {
        medium.was_full = true;
        return SQLITE_FULL;
    }
    if ((size_t)at > i->n)
        memset(i->bytes + i->n, 0, (size_t)at - i->n);
    memcpy(i->bytes + at, from, (size_t)n);
    if ((size_t)(at + n) > i->n)
        i->n = (size_t)(at + n);
    return SQLITE_OK;
}

static int cut_file(sqlite3_file *f, sqlite3_int64 n)
{
    memory_file *i = ((file *)f)->content;
    if (medium.is_read_only)
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
    *n = (sqlite3_int64)((file *)f)->content->n;
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
    for (size_t i = 0; i < sizeof SPOOL_PATH - 1; i++) /* asked too often for strncmp(), which the fuzzer listens to */
        if (path[i] != SPOOL_PATH[i])
            return false;
    return true;
}

static memory_file *find_file(const char *path)
{
    const char *rest = path + sizeof SPOOL_PATH - 1;
    if (!is_ours(path))
        return NULL;
    if (aside == 0 && rest[0] == '.') /* asked a hundred times an input */
        return NULL;
    for (memory_file *i = medium.file; i < medium.file + MEMORY_FILES; i++)
        if (i->is_there && strcmp(i->name, path) == 0)
            return i;
    return NULL;
}

static void name_file(memory_file *i, const char *path)
{
    aside -= i->name[0] != '\0' && i->name[sizeof SPOOL_PATH - 1] == '.';
    (void)snprintf(i->name, sizeof i->name, "%s", path);
    aside += i->name[0] != '\0' && i->name[sizeof SPOOL_PATH - 1] == '.';
}

void memory_forget(memory_file *i)
{
    name_file(i, "");
    i->is_there = false;
}

memory_file *memory_make(const char *path)
{
    memory_file *i = medium.file;
    while (i < medium.file + MEMORY_FILES && i->is_there)
        i++;
    if (i == medium.file + MEMORY_FILES)
        return NULL;
    i->n = 0;
    i->is_there = true;
    name_file(i, path);
    return i;
}

static int open_file(sqlite3_vfs *vfs, const char *path, sqlite3_file *f, int flags, int *out)
{
    memory_file *i = path != NULL ? find_file(path) : NULL;
    (void)vfs;
    if (i == NULL && flags & SQLITE_OPEN_CREATE && (path == NULL || !medium.is_read_only))
        i = memory_make(path != NULL && strstr(path, "-journal") == NULL ? path : "");
    f->pMethods = NULL;
    if (i == NULL)
        return SQLITE_CANTOPEN;
    ((file *)f)->content = i;
    f->pMethods = &methods;
    if (out != NULL)
        *out = flags;
    return SQLITE_OK;
}

static int delete_file(sqlite3_vfs *vfs, const char *path, int sync)
{
    memory_file *i = find_file(path);
    (void)vfs;
    (void)sync;
    if (medium.is_read_only)
        return SQLITE_IOERR_DELETE;
    if (i != NULL)
        memory_forget(i);
    return SQLITE_OK;
}

static int access_file(sqlite3_vfs *vfs, const char *path, int flags, int *is)
{
    (void)vfs;
    (void)flags;
    *is = find_file(path) != NULL;
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
    errno = how == W_OK && medium.is_read_only ? EROFS : ENOENT;
    return errno != EROFS && (!is_ours(path) || find_file(path) != NULL) ? 0 : -1;
}

int __wrap_rename(const char *from, const char *to)
{
    if (!is_ours(from))
        return __real_rename(from, to);
    memory_file *i = find_file(from), *old = find_file(to);
    if (medium.is_read_only) {
        errno = EROFS;
        return -1;
    }
    require(strlen(to) < MEMORY_NAME_MAX);
    if (i == NULL)
        return -1;
    if (old != NULL)
        memory_forget(old);
    name_file(i, to);
    return 0;
}

enum { FIRST_PAGE = 4096 }; /* what the spool writes by name */

FILE *__wrap_fopen(const char *path, const char *how)
{
    if (!is_ours(path))
        return __real_fopen(path, how);
    memory_file *i = find_file(path);
    if (i != NULL && strchr(how, '+') != NULL && i->n < FIRST_PAGE) { /* which fmemopen() cannot make longer */
        memset(i->bytes + i->n, 0, FIRST_PAGE - i->n);
        i->n = FIRST_PAGE;
    }
    return i != NULL && i->n > 0 ? fmemopen(i->bytes, i->n, how) : NULL;
}

int __wrap_stat(const char *path, struct stat *told)
{
    if (!is_ours(path))
        return __real_stat(path, told);
    const memory_file *i = find_file(path);
    *told = (struct stat){.st_size = i != NULL ? (off_t)i->n : 0};
    return i != NULL ? 0 : -1;
}

bool __wrap_pf_file_sync_folder(const char *path)
{
    return is_ours(path);
}

void memory_begin(void)
{
    static const sqlite3_mem_methods memory_methods = {.xMalloc = take_piece,
                                                       .xFree = free_piece,
                                                       .xRealloc = change_piece,
                                                       .xSize = piece_size,
                                                       .xRoundup = round_up,
                                                       .xInit = open_heap,
                                                       .xShutdown = close_heap};
    require(sqlite3_config(SQLITE_CONFIG_SINGLETHREAD) == SQLITE_OK);
    require(sqlite3_config(SQLITE_CONFIG_MEMSTATUS, 0) == SQLITE_OK);
    require(sqlite3_config(SQLITE_CONFIG_LOOKASIDE, 0, 0) == SQLITE_OK);
    require(sqlite3_config(SQLITE_CONFIG_MALLOC, &memory_methods) == SQLITE_OK);
    require(sqlite3_vfs_register(&memory, 1) == SQLITE_OK);
    unlocked = memory;
    unlocked.zName = "unix-none";
    require(sqlite3_vfs_unregister(sqlite3_vfs_find("unix-none")) == SQLITE_OK);
    require(sqlite3_vfs_register(&unlocked, 0) == SQLITE_OK);
}

void memory_keep(void)
{
    heap_kept = heap_used;
    pieces_kept = pieces;
}
