#include "spool/database.h"
#include "pipefish/drivers/clock.h"
#include "spool/readonly.h"
#include "spool/salvage.h"
#include "spool/schema.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define ROOM_BYTES UINT64_C(8388608)    /* twice what the log has between two checkpoints */
#define RETRY_NS   UINT64_C(1000000000) /* between tries of what costs reads and writes: the disk may still be full */

static const char *const sql[SQL_STATEMENTS] = {
    [SQL_BEGIN] = "BEGIN IMMEDIATE",
    [SQL_COMMIT] = "COMMIT",
    [SQL_ROLLBACK] = "ROLLBACK",
    [SQL_HAS] = "SELECT 1 FROM object WHERE name = ?1",
    [SQL_PUT] = "INSERT INTO object (kind, name, bytes) VALUES (?1, ?2, ?3)",
    [SQL_NEXT] = "SELECT row, kind, name, length(bytes) FROM object WHERE row > ?1 ORDER BY row LIMIT 1",
    [SQL_READ] = "SELECT bytes FROM object WHERE row = ?1",
    [SQL_SIZE] = "SELECT length(bytes) FROM object WHERE row = ?1",
    [SQL_REMOVE] = "DELETE FROM object WHERE row = ?1",
    [SQL_GET] = "SELECT bytes FROM value WHERE key = ?1",
    [SQL_SET] = "INSERT INTO value (key, bytes) VALUES (?1, ?2) ON CONFLICT (key) DO UPDATE SET bytes = excluded.bytes",
    [SQL_DELETE] = "DELETE FROM value WHERE key = ?1",
    [SQL_RANK] = "INSERT OR REPLACE INTO evictable (row, importance, number) VALUES (?1, ?2, ?3)",
    [SQL_VICTIMS] = ("SELECT e.row, e.number, length(o.bytes) FROM evictable e JOIN object o ON o.row = e.row "
                     "WHERE e.row > ?1 AND e.importance <= ?2 ORDER BY e.importance, e.row LIMIT ?3"),
    [SQL_KEEP_ALL] = "DELETE FROM evictable",
    [SQL_FREE_PAGES] = "PRAGMA freelist_count",
    [SQL_PAGES] = "PRAGMA page_count",
};

/* What the log's file failed with last: a commit keeps it to itself. */
static int reason_of_log(const pf_spool_database *d)
{
    sqlite3_file *log = NULL;
    int reason = 0;
    if (sqlite3_file_control(d->db, "main", SQLITE_FCNTL_JOURNAL_POINTER, (void *)&log) != SQLITE_OK || log == NULL ||
        log->pMethods == NULL || log->pMethods->xFileControl(log, SQLITE_FCNTL_LAST_ERRNO, &reason) != SQLITE_OK)
        return 0;
    return reason;
}

/* errno of what SQLite failed in; 0: not known. Where a file cannot be made it tells what came of looking for one, so
 * that one is tried. */
static int reason_of(const pf_spool_database *d)
{
    char name[1100];
    const int reason = sqlite3_system_errno(d->db);
    if (sqlite3_errcode(d->db) != SQLITE_CANTOPEN)
        return reason != 0 ? reason : reason_of_log(d);
    if (snprintf(name, sizeof name, "%s-room", d->path) >= 1100)
        return reason;
    const int fd = open(name, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (fd < 0)
        return errno;
    (void)close(fd);
    (void)unlink(name);
    return reason;
}

static pf_status fail_sqlite(pf_spool_database *d, const char *doing)
{
    pf_status status = PF_ERR_IO;
    int reason = 0;
    switch (sqlite3_errcode(d->db)) {
    case SQLITE_NOTADB:
        d->is_damaged = pf_spool_was_one(d->path);
        return pf_fail(&d->failure, PF_ERR_FORMAT, "%s: not a spool: not an SQLite file", d->path);
    case SQLITE_CORRUPT:
        d->is_damaged = true;
        status = PF_ERR_FORMAT;
        break;
    case SQLITE_READONLY: /* of a file that can be written: its header names a format that SQLite may only read */
        if (d->is_read_only || pf_spool_is_read_only(d->path))
            break;
        d->is_damaged = true;
        status = PF_ERR_FORMAT;
        break;
    case SQLITE_NOMEM:
        if (!pf_spool_has_memory())
            break;
        d->is_damaged = true;
        return pf_fail(&d->failure, PF_ERR_FORMAT, "%s: %s: a row says that it is larger than any object", d->path,
                       doing);
    case SQLITE_BUSY:
        return pf_fail(&d->failure, PF_ERR_IO, "%s: another program uses it", d->path);
    case SQLITE_TOOBIG:
        status = PF_ERR_SPACE;
        break;
    case SQLITE_FULL: /* its words say all */
        d->no_room = ENOSPC;
        status = PF_ERR_SPACE;
        break;
    case SQLITE_CANTOPEN:
    case SQLITE_IOERR:
        reason = reason_of(d); /* a user's own limit is none that SQLite knows */
        if (reason == ENOSPC || reason == EDQUOT) {
            d->no_room = reason;
            status = PF_ERR_SPACE;
        }
        break;
    default:
        break;
    }
    return pf_fail(&d->failure, status, "%s: %s: %s%s%s", d->path, doing, sqlite3_errmsg(d->db),
                   reason != 0 ? ": " : "", reason != 0 ? strerror(reason) : "");
}

pf_status pf_spool_fail(pf_spool_database *d, const char *doing)
{
    pf_status status = fail_sqlite(d, doing);
    d->stats.errors++;
    return status == PF_ERR_FORMAT ? PF_ERR_IO : status;
}

sqlite3_stmt *pf_spool_prepare(pf_spool_database *d, pf_spool_statement which)
{
    if (d->statements[which] == NULL)
        (void)sqlite3_prepare_v3(d->db, sql[which], -1, SQLITE_PREPARE_PERSISTENT, &d->statements[which], NULL);
    return d->statements[which];
}

void pf_spool_unbind(sqlite3_stmt *q)
{
    if (q != NULL)
        (void)sqlite3_clear_bindings(q);
}

bool pf_spool_run(pf_spool_database *d, pf_spool_statement which)
{
    sqlite3_stmt *q = pf_spool_prepare(d, which);
    int code = sqlite3_step(q);
    int reset = sqlite3_reset(q);
    pf_spool_unbind(q);
    return code == SQLITE_DONE && reset == SQLITE_OK;
}

static pf_status fail_damaged(pf_spool_database *d, const char *why)
{
    d->is_damaged = true;
    return pf_fail(&d->failure, PF_ERR_FORMAT, "%s: damaged: %s", d->path, why);
}

/* Nothing is stored here: what is too large is so in the file. */
static pf_status fail_opening(pf_spool_database *d)
{
    return sqlite3_errcode(d->db) == SQLITE_TOOBIG ? fail_damaged(d, sqlite3_errmsg(d->db)) : fail_sqlite(d, "opening");
}

static pf_status run_text(pf_spool_database *d, const char *text)
{
    if (sqlite3_exec(d->db, text, NULL, NULL, NULL) != SQLITE_OK)
        return fail_opening(d);
    return PF_OK;
}

/* The one integer that a query gives. */
static pf_status ask(pf_spool_database *d, const char *query, int64_t *value)
{
    sqlite3_stmt *q = NULL;
    pf_status status = PF_OK;
    if (sqlite3_prepare_v2(d->db, query, -1, &q, NULL) != SQLITE_OK || sqlite3_step(q) != SQLITE_ROW)
        status = fail_opening(d);
    else
        *value = sqlite3_column_int64(q, 0);
    sqlite3_finalize(q);
    return status;
}

static pf_status fail_foreign(pf_spool_database *d)
{
    return pf_fail(&d->failure, PF_ERR_FORMAT, "%s: not a spool: an SQLite database of another program", d->path);
}

static pf_status fail_version(pf_spool_database *d, int64_t version)
{
    return pf_fail(&d->failure, PF_ERR_VERSION, "%s: spool of version %" PRId64 "; this program reads version %d",
                   d->path, version, PF_SPOOL_VERSION);
}

/* Before it is known whose file it is: what is damaged may be another program's, to which it is left. */
static pf_status leave_others(pf_spool_database *d, pf_status status)
{
    if (!d->is_damaged || pf_spool_was_one(d->path))
        return status;
    d->is_damaged = false;
    return fail_foreign(d);
}

/* Tells a spool from an empty file, a damaged one and everything else, before anything is written. */
static pf_status identify(pf_spool_database *d, pf_spool_schema *schema)
{
    int64_t id = 0, version = 0, pages = 0;
    pf_status status = ask(d, "PRAGMA application_id", &id);
    if (status == PF_OK)
        status = ask(d, "PRAGMA user_version", &version);
    if (status != PF_OK)
        return leave_others(d, status);
    const bool is_spool = id == PF_SPOOL_APPLICATION_ID;
    const int code = pf_spool_read_schema(d->db, schema);
    if (code == SQLITE_ERROR) /* of a format that SQLite does not know */
        return leave_others(d, fail_damaged(d, sqlite3_errmsg(d->db)));
    if (code != SQLITE_OK)
        return leave_others(d, fail_opening(d));
    schema->is_empty = schema->is_empty && id == 0 && version == 0;
    if (schema->is_empty) {
        status = ask(d, "PRAGMA page_count", &pages);
        return status == PF_OK && pages > 1 && pf_spool_was_one(d->path) ? fail_damaged(d, "it names no table")
                                                                         : status;
    }
    if (!is_spool && !schema->has_objects)
        return fail_foreign(d);
    if (is_spool && version != PF_SPOOL_VERSION)
        return fail_version(d, version);
    return is_spool && schema->is_right ? PF_OK : fail_damaged(d, "its first page is not a spool's");
}

static int call_alive(void *self)
{
    ((pf_spool_database *)self)->alive();
    return 0;
}

/* Tables that lie elsewhere than this program puts them may do so rightly, or because the place where they begin is
 * damaged: what is there is looked at. */
static pf_status look_through(pf_spool_database *d, const pf_spool_schema *schema)
{
    const struct {
        bool is_due;
        const char *query;
    } checks[] = {{!schema->is_in_place, pf_spool_check_tables},
                  {!schema->ranks_are_in_place && schema->has_rank_rows, pf_spool_check_ranks},
                  {!schema->ranks_are_in_place && schema->has_ranks, pf_spool_check_order}};
    pf_status status = PF_OK;
    sqlite3_progress_handler(d->db, 1000, d->alive != NULL ? call_alive : NULL, d);
    for (size_t i = 0; status == PF_OK && i < sizeof checks / sizeof checks[0]; i++) {
        int64_t is_right = 1;
        if (checks[i].is_due)
            status = ask(d, checks[i].query, &is_right);
        if (status == PF_OK && is_right == 0)
            status = fail_damaged(d, "its tables begin on wrong pages");
    }
    sqlite3_progress_handler(d->db, 0, NULL, NULL);
    return status;
}

/* The row of an object that could not be saved may be held by somebody, who will remove it: it is given to no other. */
static pf_status go_on_after_highest(pf_spool_database *d)
{
    char text[320];
    (void)snprintf(text, sizeof text,
                   "INSERT INTO sqlite_sequence (name, seq) SELECT 'object', 0 WHERE NOT EXISTS "
                   "(SELECT 1 FROM sqlite_sequence WHERE name = 'object'); "
                   "UPDATE sqlite_sequence SET seq = %" PRId64 " WHERE name = 'object' AND seq < %" PRId64,
                   d->highest, d->highest);
    return d->highest == 0 ? PF_OK : run_text(d, text);
}

static pf_status open_for_writing(pf_spool_database *d)
{
    pf_spool_schema schema = {0};
    pf_spool_finish_setting_aside(d->path);
    if (sqlite3_open_v2(d->path, &d->db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_NOMUTEX, NULL) !=
        SQLITE_OK) {
        d->no_room = d->db == NULL ? ENOMEM : 0;
        return d->db != NULL ? fail_sqlite(d, "opening") : pf_fail(&d->failure, PF_ERR_SPACE, "%s: no memory", d->path);
    }
    (void)sqlite3_busy_timeout(d->db, 2000); /* the daemon before us may still be closing */
    /* Exclusive: a second daemon on the same spool is refused, and WAL needs no shared memory. */
    pf_status status = run_text(d, "PRAGMA locking_mode = EXCLUSIVE");
    if (status == PF_OK)
        status = identify(d, &schema);
    if (status == PF_OK)
        status = schema.is_empty ? run_text(d, pf_spool_layout) : look_through(d, &schema);
    /* The log is cut back to 4 MB after a checkpoint, lest it hold an SD card's free space for ever. */
    if (status == PF_OK)
        status =
            run_text(d, "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; PRAGMA journal_size_limit = 4194304;");
    if (status == PF_OK && schema.is_empty)
        status = run_text(d, pf_spool_create);
    if (status == PF_OK && !schema.has_ranks)
        status = run_text(d, pf_spool_add_ranks);
    if (status == PF_OK)
        status = go_on_after_highest(d);
    if (status == PF_OK)
        d->stats.healed += pf_spool_salvage(d->db, d->path, d->alive, &d->healing);
    return status;
}

void pf_spool_database_close(pf_spool_database *d)
{
    for (int i = 0; i < SQL_STATEMENTS; i++) {
        sqlite3_finalize(d->statements[i]);
        d->statements[i] = NULL;
    }
    (void)sqlite3_close(d->db);
    d->db = NULL;
}

/* What cannot be written can still be sent. Where there is nothing yet, or nothing that can be read, an empty spool in
 * memory stands in, so that everybody else need not know. */
static pf_status open_for_reading(pf_spool_database *d)
{
    pf_spool_schema schema = {.is_empty = access(d->path, F_OK) != 0};
    pf_status status = PF_OK;
    if (!schema.is_empty) {
        status = pf_spool_open_read_only(d->path, &d->db) == SQLITE_OK ? run_text(d, "PRAGMA locking_mode = EXCLUSIVE")
                                                                       : fail_sqlite(d, "opening");
        if (status == PF_OK)
            status = identify(d, &schema);
        if (d->is_damaged && schema.has_objects) { /* all that is needed for sending */
            d->is_damaged = false;
            status = PF_OK;
        }
    }
    if (schema.is_empty || d->is_damaged) {
        d->is_damaged = false;
        pf_spool_database_close(d);
        status =
            sqlite3_open(":memory:", &d->db) == SQLITE_OK ? run_text(d, pf_spool_create) : fail_sqlite(d, "opening");
    }
    if (status == PF_OK) /* over the file's own: nothing has to go while nothing can come */
        status = run_text(d, "PRAGMA temp_store = MEMORY; CREATE TEMP TABLE evictable (row INTEGER PRIMARY KEY,"
                             "importance INTEGER NOT NULL, number INTEGER NOT NULL)");
    if (status == PF_OK && !schema.is_empty && schema.has_objects && !schema.has_values)
        status = run_text(d, "CREATE TEMP TABLE value (key TEXT PRIMARY KEY, bytes BLOB NOT NULL)");
    return status;
}

/* Every row is looked at, on a slow card with a read for most of them: some 250 rows, 0.1 s, between two alive(). */
static pf_status measure(pf_spool_database *d)
{
    int64_t objects = 0, bytes = 0;
    sqlite3_progress_handler(d->db, 1000, d->alive != NULL ? call_alive : NULL, d);
    pf_status status = ask(d, "SELECT count(*) FROM object", &objects);
    if (status == PF_OK)
        status = ask(d, "SELECT coalesce(sum(length(bytes)), 0) FROM object", &bytes);
    sqlite3_progress_handler(d->db, 0, NULL, NULL);
    d->stats.objects = (uint64_t)objects;
    d->stats.bytes = (uint64_t)bytes;
    return status;
}

static pf_status open_file(pf_spool_database *d)
{
    d->is_read_only = pf_spool_is_read_only(d->path);
    d->is_full = false;
    d->no_room = 0;
    d->retry_ns = 0;
    d->stats.objects = d->stats.bytes = 0;
    const uint32_t version = pf_spool_version_of(d->path);
    if (version > PF_SPOOL_VERSION) /* whatever else is in it, damaged or not */
        return fail_version(d, version);
    pf_status status = d->is_read_only ? PF_ERR_SPACE : open_for_writing(d);
    if (status == PF_ERR_SPACE) { /* a disk too full for an empty spool, too: a survey needs none to begin */
        pf_spool_database_close(d);
        d->is_full = !d->is_read_only;
        d->is_read_only = true;
        status = open_for_reading(d);
    }
    if (status == PF_OK)
        status = measure(d);
    if (d->is_full)
        d->retry_ns = pf_now() + RETRY_NS;
    return status;
}

pf_status pf_spool_heal(pf_spool_database *d)
{
    d->is_damaged = false;
    d->stats.errors++;
    pf_status status = pf_spool_set_aside(d->path, &d->failure);
    if (status != PF_OK)
        return status;
    pf_spool_database_close(d);
    status = open_file(d);
    if (status != PF_OK)
        pf_spool_database_close(d);
    return status;
}

pf_status pf_spool_database_open(pf_spool_database *d)
{
    pf_status status = open_file(d);
    if (d->is_damaged)
        return pf_spool_heal(d);
    if (status != PF_OK)
        pf_spool_database_close(d);
    return status;
}

static uint64_t room_on(const struct statvfs *disk)
{
    return (uint64_t)disk->f_bavail * disk->f_frsize;
}

/* Whether what kept it from being written may have gone. Of a user's own limit the disk's room says nothing: it is
 * tried, which reads the whole spool again. */
static bool may_be_written(const pf_spool_database *d)
{
    struct statvfs disk;
    if (pf_spool_is_read_only(d->path))
        return false;
    return !d->is_full ||
           (pf_now() >= d->retry_ns && (!pf_spool_look_at_disk(d->path, &disk) || room_on(&disk) >= ROOM_BYTES));
}

bool pf_spool_enter(pf_spool_database *d)
{
    pthread_mutex_lock(&d->mutex);
    if (d->is_read_only && may_be_written(d))
        pf_spool_database_close(d);
    if (d->db != NULL || pf_spool_database_open(d) == PF_OK)
        return true;
    d->stats.errors++;
    pthread_mutex_unlock(&d->mutex);
    return false;
}

void pf_spool_leave(pf_spool_database *d)
{
    if (d->is_damaged)
        (void)pf_spool_heal(d);
    pthread_mutex_unlock(&d->mutex);
}

static bool count(pf_spool_database *d, pf_spool_statement which, uint64_t *pages)
{
    sqlite3_stmt *q = pf_spool_prepare(d, which);
    const bool is_known = sqlite3_step(q) == SQLITE_ROW;
    *pages = is_known ? (uint64_t)sqlite3_column_int64(q, 0) : 0;
    sqlite3_reset(q);
    return is_known;
}

/* By how many bytes the file must grow for what the log has, before the log can begin anew. */
static uint64_t pending_growth(pf_spool_database *d)
{
    struct stat file;
    uint64_t pages;
    if (!count(d, SQL_PAGES, &pages) || stat(d->path, &file) != 0 || (uint64_t)file.st_size >= pages * PF_SPOOL_PAGE)
        return 0;
    return pages * PF_SPOOL_PAGE - (uint64_t)file.st_size;
}

/* By how many pages an object of n bytes, and what its row changes in the trees, may make the file larger. False: it
 * cannot be told. */
static bool measure_growth(pf_spool_database *d, size_t n, uint64_t *pages)
{
    uint64_t unused;
    const bool is_known = count(d, SQL_FREE_PAGES, &unused);
    const uint64_t needed = pf_spool_pages(n) + 8;
    *pages = needed > unused ? needed - unused : 0;
    return is_known;
}

/* Removing takes room too: in the log, and, before the log can begin anew, in the file for what the log still has. A
 * spool that had filled the disk to the last byte could never get rid of anything again, so some is left. What comes
 * instead of others takes a page more now and then. */
static bool has_room(pf_spool_database *d, uint64_t pages, bool is_exchange, uint64_t *left)
{
    struct statvfs disk;
    if (!pf_spool_look_at_disk(d->path, &disk))
        return true;
    *left = room_on(&disk);
    if (pages == 0)
        return *left >= ROOM_BYTES || *left >= pending_growth(d);
    return *left >= (is_exchange ? ROOM_BYTES / 2 : ROOM_BYTES) + 2 * pages * PF_SPOOL_PAGE;
}

pf_status pf_spool_check_disk(pf_spool_database *d, size_t n, bool is_exchange)
{
    uint64_t growth, left = 0;
    if (!measure_growth(d, n, &growth))
        return pf_spool_fail(d, "storing");
    if (has_room(d, growth, is_exchange, &left))
        return PF_OK;
    d->no_room = pending_growth(d) > 0 ? ENOSPC : 0; /* while there is room */
    d->stats.errors++;
    return pf_fail(&d->failure, PF_ERR_SPACE, "%s: the disk is full: the last %" PRIu64 " bytes are for removing",
                   d->path, left);
}

pf_status pf_spool_pages_to_free(pf_spool_database *d, size_t n, uint64_t *pages)
{
    uint64_t left = 0;
    if (!measure_growth(d, n, pages))
        return pf_spool_fail(d, "making room");
    if (has_room(d, *pages, true, &left))
        *pages = 0;
    return PF_OK;
}

bool pf_spool_reuse_log(pf_spool_database *d)
{
    struct statvfs disk;
    int frames = 0, done = 0;
    if (d->is_read_only || d->no_room == 0 || pf_now() < d->retry_ns)
        return false;
    if (pf_spool_look_at_disk(d->path, &disk) && room_on(&disk) < pending_growth(d))
        return false; /* the last bytes are for removing */
    const int code = sqlite3_wal_checkpoint_v2(d->db, NULL, SQLITE_CHECKPOINT_PASSIVE, &frames, &done);
    const bool is_reusable = code == SQLITE_OK && frames > 0 && done == frames;
    if (!is_reusable)
        d->retry_ns = pf_now() + RETRY_NS;
    return is_reusable;
}

pf_status pf_spool_fail_read_only(pf_spool_database *d)
{
    struct statvfs disk;
    const bool is_forbidden = pf_spool_is_read_only(d->path);
    const int reason = is_forbidden ? errno : d->no_room;
    const bool has_no_files =
        reason == ENOSPC && pf_spool_look_at_disk(d->path, &disk) && disk.f_files > 0 && disk.f_favail == 0;
    d->stats.errors++;
    return pf_fail(&d->failure, PF_ERR_SPACE, "%s: cannot be written: %s%s", d->path, strerror(reason),
                   has_no_files ? " for one more file" : "");
}
