/* The spool in SQLite: WAL with synchronous=FULL, so that a commit outlives a power cut. One connection behind a mutex.
 */
#include "pipefish/drivers/spool.h"
#include "common/failure.h"
#include "pipefish/drivers/sha256.h"
#include "spool/readonly.h"
#include "spool/salvage.h"

#include <errno.h>
#include <inttypes.h>
#include <pthread.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define APPLICATION_ID 0x50465350 /* "PFSP" */
#define SCHEMA_VERSION 1

/* AUTOINCREMENT: a row number is never used again, so that next() in order of rows is next() in order of storing. */
static const char schema[] = "CREATE TABLE object ("
                             "row INTEGER PRIMARY KEY AUTOINCREMENT,"
                             "kind INTEGER NOT NULL,"
                             "name BLOB NOT NULL UNIQUE CHECK (length(name) = 32),"
                             "bytes BLOB NOT NULL);"
                             "CREATE TABLE value (key TEXT PRIMARY KEY, bytes BLOB NOT NULL) WITHOUT ROWID;";

/* Beside the objects, so that taking a rank away does not write the object anew, and so that programs without ranks can
 * go on with the file: to them it is a table that looks after itself. */
static const char ranks[] = "CREATE TABLE IF NOT EXISTS evictable (row INTEGER PRIMARY KEY,"
                            "importance INTEGER NOT NULL, number INTEGER NOT NULL);"
                            "CREATE INDEX IF NOT EXISTS evictable_order ON evictable (importance, row);"
                            "CREATE TRIGGER IF NOT EXISTS evictable_gone AFTER DELETE ON object BEGIN "
                            "DELETE FROM evictable WHERE row = old.row; END;";

typedef enum statement {
    SQL_BEGIN,
    SQL_COMMIT,
    SQL_ROLLBACK,
    SQL_HAS,
    SQL_PUT,
    SQL_NEXT,
    SQL_READ,
    SQL_SIZE,
    SQL_REMOVE,
    SQL_GET,
    SQL_SET,
    SQL_DELETE,
    SQL_RANK,
    SQL_VICTIMS,
    SQL_KEEP_ALL,
    SQL_STATEMENTS,
} statement;

static const char *const sql[SQL_STATEMENTS] = {
    [SQL_BEGIN] = "BEGIN IMMEDIATE",
    [SQL_COMMIT] = "COMMIT",
    [SQL_ROLLBACK] = "ROLLBACK",
    [SQL_HAS] = "SELECT 1 FROM object WHERE name = ?1",
    [SQL_PUT] = "INSERT INTO object (kind, name, bytes) VALUES (?1, ?2, ?3)",
    [SQL_NEXT] = "SELECT row, kind, name, length(bytes) FROM object WHERE row > ?1 ORDER BY row LIMIT 1",
    [SQL_READ] = "SELECT name, bytes FROM object WHERE row = ?1",
    [SQL_SIZE] = "SELECT length(bytes) FROM object WHERE row = ?1",
    [SQL_REMOVE] = "DELETE FROM object WHERE row = ?1",
    [SQL_GET] = "SELECT bytes FROM value WHERE key = ?1",
    [SQL_SET] = "INSERT INTO value (key, bytes) VALUES (?1, ?2) ON CONFLICT (key) DO UPDATE SET bytes = excluded.bytes",
    [SQL_DELETE] = "DELETE FROM value WHERE key = ?1",
    [SQL_RANK] = "INSERT OR REPLACE INTO evictable (row, importance, number) VALUES (?1, ?2, ?3)",
    [SQL_VICTIMS] = ("SELECT e.row, e.number, length(o.bytes) FROM evictable e JOIN object o ON o.row = e.row "
                     "WHERE e.row > ?1 AND e.importance <= ?2 ORDER BY e.importance, e.row LIMIT ?3"),
    [SQL_KEEP_ALL] = "DELETE FROM evictable",
};

typedef struct spool {
    pthread_mutex_t mutex;
    sqlite3 *db;
    sqlite3_stmt *statements[SQL_STATEMENTS];
    uint64_t quota;
    char *path;
    bool is_damaged; /* SQLite has found the file to be, and it is to be replaced */
    bool is_read_only;
    int64_t highest; /* row given or shown to anybody */
    pf_spool_stats stats;
    pf_failure failure;
} spool;

typedef struct object {
    uint32_t kind;
    const uint8_t *name;
    const void *bytes;
    size_t n;
    const pf_spool_rank *rank;
    const pf_spool_victim *victims;
    uint32_t victims_n;
} object;

static pf_status fail_sqlite(spool *s, const char *doing)
{
    pf_status status = PF_ERR_IO;
    switch (sqlite3_errcode(s->db)) {
    case SQLITE_NOTADB:
        s->is_damaged = pf_spool_was_one(s->path, APPLICATION_ID);
        return pf_fail(&s->failure, PF_ERR_FORMAT, "%s: not a spool: not an SQLite file", s->path);
    case SQLITE_CORRUPT:
        s->is_damaged = true;
        status = PF_ERR_FORMAT;
        break;
    case SQLITE_BUSY:
        return pf_fail(&s->failure, PF_ERR_IO, "%s: another program uses it", s->path);
    case SQLITE_FULL:
    case SQLITE_TOOBIG:
        status = PF_ERR_SPACE;
        break;
    default:
        break;
    }
    return pf_fail(&s->failure, status, "%s: %s: %s", s->path, doing, sqlite3_errmsg(s->db));
}

/* For the calls that promise nothing but PF_ERR_IO when the medium fails. */
static pf_status fail_call(spool *s, const char *doing)
{
    pf_status status = fail_sqlite(s, doing);
    s->stats.errors++;
    return status == PF_ERR_FORMAT ? PF_ERR_IO : status;
}

/* Runs a statement that gives no rows, and leaves it ready for the next time. The error stays in the connection. */
static bool run(spool *s, statement which)
{
    int code = sqlite3_step(s->statements[which]);
    int reset = sqlite3_reset(s->statements[which]);
    sqlite3_clear_bindings(s->statements[which]);
    return code == SQLITE_DONE && reset == SQLITE_OK;
}

/* ---- opening ---- */

static pf_status run_text(spool *s, const char *text)
{
    if (sqlite3_exec(s->db, text, NULL, NULL, NULL) != SQLITE_OK)
        return fail_sqlite(s, "opening");
    return PF_OK;
}

/* The one integer that a query gives. */
static pf_status ask(spool *s, const char *query, int64_t *value)
{
    sqlite3_stmt *q = NULL;
    pf_status status = PF_OK;
    if (sqlite3_prepare_v2(s->db, query, -1, &q, NULL) != SQLITE_OK || sqlite3_step(q) != SQLITE_ROW)
        status = fail_sqlite(s, "opening");
    else
        *value = sqlite3_column_int64(q, 0);
    sqlite3_finalize(q);
    return status;
}

/* Tells a spool from an empty file and from everything else, before anything is written. */
static pf_status identify(spool *s, bool *is_empty)
{
    int64_t id = 0, version = 0, objects = 0;
    pf_status status = ask(s, "PRAGMA application_id", &id);
    if (status == PF_OK)
        status = ask(s, "PRAGMA user_version", &version);
    if (status == PF_OK)
        status = ask(s, "SELECT count(*) FROM sqlite_schema", &objects);
    if (status != PF_OK)
        return status;
    *is_empty = id == 0 && version == 0 && objects == 0;
    if (*is_empty)
        return PF_OK;
    if (id != APPLICATION_ID)
        return pf_fail(&s->failure, PF_ERR_FORMAT, "%s: not a spool: an SQLite database of another program", s->path);
    if (version != SCHEMA_VERSION)
        return pf_fail(&s->failure, PF_ERR_VERSION, "%s: spool of version %" PRId64 "; this program reads version %d",
                       s->path, version, SCHEMA_VERSION);
    return PF_OK;
}

static pf_status create(spool *s)
{
    char text[sizeof schema + 128];
    (void)snprintf(text, sizeof text, "BEGIN IMMEDIATE;%sPRAGMA application_id = %d;PRAGMA user_version = %d;COMMIT;",
                   schema, APPLICATION_ID, SCHEMA_VERSION);
    return run_text(s, text);
}

static pf_status open_for_writing(spool *s)
{
    bool is_empty = false;
    if (sqlite3_open_v2(s->path, &s->db, SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_NOMUTEX, NULL) !=
        SQLITE_OK)
        return s->db != NULL ? fail_sqlite(s, "opening") : pf_fail(&s->failure, PF_ERR_SPACE, "%s: no memory", s->path);
    (void)sqlite3_busy_timeout(s->db, 2000); /* the daemon before us may still be closing */
    /* Exclusive: a second daemon on the same spool is refused, and WAL needs no shared memory. */
    pf_status status = run_text(s, "PRAGMA locking_mode = EXCLUSIVE");
    if (status == PF_OK)
        status = identify(s, &is_empty);
    /* The log is cut back to 4 MB after a checkpoint, lest it hold an SD card's free space for ever. */
    if (status == PF_OK)
        status =
            run_text(s, "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; PRAGMA journal_size_limit = 4194304;");
    if (status == PF_OK && is_empty)
        status = create(s);
    if (status == PF_OK)
        status = run_text(s, ranks);
    return status;
}

static void close_database(spool *s)
{
    for (int i = 0; i < SQL_STATEMENTS; i++) {
        sqlite3_finalize(s->statements[i]);
        s->statements[i] = NULL;
    }
    (void)sqlite3_close(s->db);
    s->db = NULL;
}

/* What cannot be written can still be sent. Where there is nothing yet, or nothing that can be read, an empty spool in
 * memory stands in, so that everybody else need not know. */
static pf_status open_for_reading(spool *s)
{
    bool is_empty = access(s->path, F_OK) != 0;
    pf_status status = PF_OK;
    if (!is_empty) {
        status = pf_spool_open_read_only(s->path, &s->db) == SQLITE_OK ? run_text(s, "PRAGMA locking_mode = EXCLUSIVE")
                                                                       : fail_sqlite(s, "opening");
        if (status == PF_OK)
            status = identify(s, &is_empty);
    }
    if (is_empty || s->is_damaged) {
        s->is_damaged = false;
        close_database(s);
        status = sqlite3_open(":memory:", &s->db) == SQLITE_OK ? create(s) : fail_sqlite(s, "opening");
    }
    if (status == PF_OK) /* over the file's own: nothing has to go while nothing can come */
        status = run_text(s, "PRAGMA temp_store = MEMORY; CREATE TEMP TABLE evictable (row INTEGER PRIMARY KEY,"
                             "importance INTEGER NOT NULL, number INTEGER NOT NULL)");
    return status;
}

static pf_status open_database(spool *s)
{
    s->is_read_only = pf_spool_is_read_only(s->path);
    pf_status status = s->is_read_only ? open_for_reading(s) : open_for_writing(s);
    int64_t objects = 0, bytes = 0;
    if (status == PF_OK)
        status = ask(s, "SELECT count(*) FROM object", &objects);
    if (status == PF_OK)
        status = ask(s, "SELECT coalesce(sum(length(bytes)), 0) FROM object", &bytes);
    s->stats.objects = (uint64_t)objects;
    s->stats.bytes = (uint64_t)bytes;
    for (int i = 0; status == PF_OK && i < SQL_STATEMENTS; i++)
        if (sqlite3_prepare_v3(s->db, sql[i], -1, SQLITE_PREPARE_PERSISTENT, &s->statements[i], NULL) != SQLITE_OK)
            status = fail_sqlite(s, "opening");
    return status;
}

/* The row of an object that could not be saved may be held by somebody, who will remove it: it is given to no other. */
static pf_status go_on_after(spool *s)
{
    char text[256];
    (void)snprintf(text, sizeof text,
                   "INSERT INTO sqlite_sequence (name, seq) SELECT 'object', 0 WHERE NOT EXISTS "
                   "(SELECT 1 FROM sqlite_sequence WHERE name = 'object'); "
                   "UPDATE sqlite_sequence SET seq = max(seq, %" PRId64 ") WHERE name = 'object'",
                   s->highest);
    return sqlite3_exec(s->db, text, NULL, NULL, NULL) == SQLITE_OK ? PF_OK : fail_sqlite(s, "opening");
}

/* In place of a damaged file a new one, with what can be read of it. Rows keep their numbers, so that whoever holds
 * some need not know. A file that cannot be set aside stays in use; without a new one every call tries again (enter).
 */
static pf_status heal(spool *s)
{
    char aside[PF_SALVAGE_PATH_MAX];
    s->is_damaged = false;
    s->stats.errors++;
    pf_status status = pf_spool_set_aside(s->path, aside, &s->failure);
    if (status != PF_OK)
        return status;
    close_database(s);
    status = open_database(s);
    if (status != PF_OK) {
        close_database(s);
        return status;
    }
    s->stats.objects = pf_spool_salvage(s->db, aside);
    status = go_on_after(s);
    (void)pf_fail(&s->failure, PF_OK, "%s: was damaged: %" PRIu64 " objects saved from it, the rest is in %s", s->path,
                  s->stats.objects, aside);
    int64_t bytes = 0;
    if (status == PF_OK)
        status = ask(s, "SELECT coalesce(sum(length(bytes)), 0) FROM object", &bytes);
    s->stats.bytes = (uint64_t)bytes;
    s->stats.healed++;
    return status;
}

/* Takes the mutex. False, without it: the file could not be opened again after it was found damaged, nor can it now. A
 * medium that was read-only is asked whether it still is. */
static bool enter(spool *s)
{
    pthread_mutex_lock(&s->mutex);
    if (s->is_read_only && !pf_spool_is_read_only(s->path))
        close_database(s);
    if (s->db != NULL || open_database(s) == PF_OK || (s->is_damaged && heal(s) == PF_OK))
        return true;
    close_database(s);
    s->stats.errors++;
    pthread_mutex_unlock(&s->mutex);
    return false;
}

/* Later it may be written. */
static pf_status fail_read_only(spool *s)
{
    s->stats.errors++;
    (void)pf_spool_is_read_only(s->path);
    return pf_fail(&s->failure, PF_ERR_SPACE, "%s: cannot be written: %s", s->path, strerror(errno));
}

/* ---- calls; each takes the mutex ---- */

/* Removes what has to go inside the open transaction. */
static pf_status evict(spool *s, const object *o, uint64_t *freed, uint32_t *gone)
{
    for (uint32_t i = 0; i < o->victims_n; i++) {
        (void)sqlite3_bind_int64(s->statements[SQL_REMOVE], 1, (int64_t)o->victims[i].row);
        if (!run(s, SQL_REMOVE))
            return fail_call(s, "making room");
        if (sqlite3_changes(s->db) > 0) {
            *freed += o->victims[i].size;
            ++*gone;
        }
    }
    return PF_OK;
}

static pf_status set_rank(spool *s, int64_t row, const pf_spool_rank *rank)
{
    sqlite3_stmt *q = s->statements[SQL_RANK];
    (void)sqlite3_bind_int64(q, 1, row);
    (void)sqlite3_bind_int64(q, 2, rank->importance);
    (void)sqlite3_bind_int64(q, 3, rank->number);
    return run(s, SQL_RANK) ? PF_OK : fail_call(s, "storing");
}

/* Stores an object inside the open transaction, in which `freed` bytes have been removed. *stored: it was not there
 * before. */
static pf_status insert(spool *s, const object *o, uint64_t freed, bool *stored)
{
    const uint64_t bytes = s->stats.bytes - freed;
    sqlite3_stmt *has = s->statements[SQL_HAS], *put = s->statements[SQL_PUT];
    *stored = false;
    (void)sqlite3_bind_blob(has, 1, o->name, 32, SQLITE_STATIC);
    int code = sqlite3_step(has);
    sqlite3_reset(has);
    sqlite3_clear_bindings(has);
    if (code == SQLITE_ROW)
        return PF_OK;
    if (code != SQLITE_DONE)
        return fail_call(s, "storing");
    if (s->quota != 0 && bytes > s->quota - o->n) {
        s->stats.errors++;
        return pf_fail(&s->failure, PF_ERR_SPACE, "%s: quota: %" PRIu64 " bytes wait, %zu more are above %" PRIu64,
                       s->path, bytes, o->n, s->quota);
    }
    (void)sqlite3_bind_int64(put, 1, o->kind);
    (void)sqlite3_bind_blob(put, 2, o->name, 32, SQLITE_STATIC);
    if (sqlite3_bind_blob64(put, 3, o->bytes, o->n, SQLITE_STATIC) != SQLITE_OK) {
        sqlite3_clear_bindings(put);
        return fail_call(s, "storing");
    }
    if (!run(s, SQL_PUT))
        return fail_call(s, "storing");
    *stored = true;
    s->highest = sqlite3_last_insert_rowid(s->db);
    return o->rank == NULL ? PF_OK : set_rank(s, s->highest, o->rank);
}

static pf_status set_value(spool *s, const char *key, const void *bytes, size_t n)
{
    statement which = n == 0 ? SQL_DELETE : SQL_SET;
    (void)sqlite3_bind_text(s->statements[which], 1, key, -1, SQLITE_STATIC);
    if (n != 0 && sqlite3_bind_blob64(s->statements[which], 2, bytes, n, SQLITE_STATIC) != SQLITE_OK) {
        sqlite3_clear_bindings(s->statements[which]);
        return fail_call(s, "setting a value");
    }
    return run(s, which) ? PF_OK : fail_call(s, "setting a value");
}

/* One transaction: an object (or NULL), a value (or a NULL key). With the mutex. */
static pf_status try_to_store(spool *s, const object *o, const char *key, const void *value, size_t value_n)
{
    bool stored = false;
    uint64_t freed = 0;
    uint32_t gone = 0;
    if (s->is_read_only)
        return fail_read_only(s);
    pf_status status = run(s, SQL_BEGIN) ? PF_OK : fail_call(s, "storing");
    if (status == PF_OK && o != NULL)
        status = evict(s, o, &freed, &gone);
    if (status == PF_OK && o != NULL)
        status = insert(s, o, freed, &stored);
    if (status == PF_OK && key != NULL)
        status = set_value(s, key, value, value_n);
    if (status == PF_OK && !run(s, SQL_COMMIT))
        status = fail_call(s, "storing");
    if (status == PF_OK) {
        s->stats.objects -= gone;
        s->stats.bytes -= freed;
        s->stats.evicted += gone;
    }
    if (status == PF_OK && stored) {
        s->stats.objects++;
        s->stats.bytes += o->n;
        s->stats.stored++;
    }
    /* SQLite ends the transaction itself on some errors. */
    if (status != PF_OK && sqlite3_get_autocommit(s->db) == 0)
        (void)run(s, SQL_ROLLBACK);
    return status;
}

static pf_status store(spool *s, const object *o, const char *key, const void *value, size_t value_n)
{
    if (!enter(s))
        return PF_ERR_IO;
    pf_status status = try_to_store(s, o, key, value, value_n);
    if (s->is_damaged && heal(s) == PF_OK)
        status = try_to_store(s, o, key, value, value_n);
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status fail_argument(spool *s, const char *text)
{
    pthread_mutex_lock(&s->mutex);
    pf_status status = pf_fail(&s->failure, PF_ERR_ARGUMENT, "%s: %s", s->path, text);
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status spool_exchange(void *self, const pf_spool_victim *victims, uint32_t count, uint32_t kind,
                                const uint8_t name[32], const void *bytes, size_t n, const pf_spool_rank *rank,
                                const char *key, const void *value, size_t value_n)
{
    spool *s = self;
    object o = {kind, name, bytes, n, rank, victims, count};
    if (n == 0 || n > UINT32_MAX)
        return fail_argument(s, "an object must have 1..2^32 - 1 bytes");
    if (s->quota != 0 && n > s->quota)
        return fail_argument(s, "an object is larger than the whole quota");
    return store(s, &o, key, value, value_n);
}

static pf_status spool_put_and_set(void *self, uint32_t kind, const uint8_t name[32], const void *bytes, size_t n,
                                   const char *key, const void *value, size_t value_n)
{
    return spool_exchange(self, NULL, 0, kind, name, bytes, n, NULL, key, value, value_n);
}

static pf_status spool_victims(void *self, uint64_t after, uint32_t importance, size_t n,
                               pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX], uint32_t *count)
{
    spool *s = self;
    pf_status status = PF_OK;
    uint64_t freed = 0;
    int code = SQLITE_ROW;
    *count = 0;
    if (!enter(s))
        return PF_ERR_IO;
    sqlite3_stmt *q = s->statements[SQL_VICTIMS];
    (void)sqlite3_bind_int64(q, 1, (int64_t)after);
    (void)sqlite3_bind_int64(q, 2, importance);
    (void)sqlite3_bind_int64(q, 3, PF_SPOOL_VICTIMS_MAX);
    while (freed < n && (code = sqlite3_step(q)) == SQLITE_ROW) {
        pf_spool_victim *v = &victims[(*count)++];
        *v = (pf_spool_victim){.row = (uint64_t)sqlite3_column_int64(q, 0),
                               .number = (uint32_t)sqlite3_column_int64(q, 1),
                               .size = (uint32_t)sqlite3_column_int64(q, 2)};
        freed += v->size;
    }
    if (code != SQLITE_ROW && code != SQLITE_DONE)
        status = fail_call(s, "making room");
    else if (s->is_read_only)
        status = fail_read_only(s);
    else if (freed < n)
        status = pf_fail(&s->failure, PF_ERR_SPACE, "%s: full, and nothing in it is less important", s->path);
    sqlite3_reset(q);
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status spool_keep_all(void *self)
{
    spool *s = self;
    if (!enter(s))
        return PF_ERR_IO;
    pf_status status = PF_OK;
    if (s->is_read_only)
        status = fail_read_only(s);
    else if (!run(s, SQL_KEEP_ALL))
        status = fail_call(s, "keeping what is there");
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status spool_put(void *self, uint32_t kind, const uint8_t name[32], const void *bytes, size_t n)
{
    return spool_put_and_set(self, kind, name, bytes, n, NULL, NULL, 0);
}

static pf_status spool_set(void *self, const char *key, const void *bytes, size_t n)
{
    return store(self, NULL, key, bytes, n);
}

static pf_status spool_next(void *self, uint64_t after, pf_spool_item *item)
{
    spool *s = self;
    pf_status status = PF_OK;
    if (after >= INT64_MAX)
        return PF_ERR_END;
    if (!enter(s))
        return PF_ERR_IO;
    sqlite3_stmt *q = s->statements[SQL_NEXT];
    (void)sqlite3_bind_int64(q, 1, (int64_t)after);
    int code = sqlite3_step(q);
    if (code == SQLITE_ROW && sqlite3_column_bytes(q, 2) == 32) {
        item->row = (uint64_t)sqlite3_column_int64(q, 0);
        s->highest = (int64_t)item->row > s->highest ? (int64_t)item->row : s->highest;
        item->kind = (uint32_t)sqlite3_column_int64(q, 1);
        memcpy(item->name, sqlite3_column_blob(q, 2), 32);
        item->size = (uint32_t)sqlite3_column_int64(q, 3);
    } else if (code == SQLITE_DONE) {
        status = PF_ERR_END;
    } else {
        status = fail_call(s, "listing");
    }
    sqlite3_reset(q);
    if (s->is_damaged) /* the caller asks again */
        (void)heal(s);
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status spool_read(void *self, uint64_t row, void *bytes, size_t capacity, size_t *n)
{
    spool *s = self;
    uint8_t hash[32];
    pf_status status = PF_OK;
    if (!enter(s))
        return PF_ERR_IO;
    sqlite3_stmt *q = s->statements[SQL_READ];
    (void)sqlite3_bind_int64(q, 1, (int64_t)row);
    int code = sqlite3_step(q);
    const void *name = code == SQLITE_ROW ? sqlite3_column_blob(q, 0) : NULL;
    const void *blob = code == SQLITE_ROW ? sqlite3_column_blob(q, 1) : NULL;
    if (code == SQLITE_DONE) {
        status = PF_ERR_END;
    } else if (name == NULL || blob == NULL) {
        status = fail_call(s, "reading");
    } else if ((size_t)sqlite3_column_bytes(q, 1) > capacity) {
        status = pf_fail(&s->failure, PF_ERR_SPACE, "%s: row %" PRIu64 " has %d bytes, the buffer %zu", s->path, row,
                         sqlite3_column_bytes(q, 1), capacity);
    } else {
        *n = (size_t)sqlite3_column_bytes(q, 1);
        memcpy(bytes, blob, *n);
        if (pf_sha256(bytes, *n, hash) != PF_OK || memcmp(hash, name, sizeof hash) != 0) {
            s->stats.errors++;
            status = pf_fail(&s->failure, PF_ERR_CHECKSUM, "%s: row %" PRIu64 ": its bytes do not have its SHA-256",
                             s->path, row);
        }
    }
    sqlite3_reset(q);
    if (s->is_damaged) /* likewise */
        (void)heal(s);
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status spool_remove(void *self, uint64_t row)
{
    spool *s = self;
    pf_status status = PF_OK;
    if (!enter(s))
        return PF_ERR_IO;
    if (s->is_read_only) {
        (void)fail_read_only(s);
        pthread_mutex_unlock(&s->mutex);
        return PF_ERR_IO;
    }
    sqlite3_stmt *q = s->statements[SQL_SIZE];
    (void)sqlite3_bind_int64(q, 1, (int64_t)row);
    int code = sqlite3_step(q);
    uint64_t size = code == SQLITE_ROW ? (uint64_t)sqlite3_column_int64(q, 0) : 0;
    sqlite3_reset(q);
    (void)sqlite3_bind_int64(s->statements[SQL_REMOVE], 1, (int64_t)row);
    if (code != SQLITE_DONE && (code != SQLITE_ROW || !run(s, SQL_REMOVE))) {
        status = fail_call(s, "removing");
    } else if (code == SQLITE_ROW) {
        s->stats.objects--;
        s->stats.bytes -= size;
        s->stats.acknowledged++;
    }
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static pf_status spool_get(void *self, const char *key, void *bytes, size_t capacity, size_t *n)
{
    spool *s = self;
    pf_status status = PF_OK;
    if (!enter(s))
        return PF_ERR_IO;
    sqlite3_stmt *q = s->statements[SQL_GET];
    (void)sqlite3_bind_text(q, 1, key, -1, SQLITE_STATIC);
    int code = sqlite3_step(q);
    const void *blob = code == SQLITE_ROW ? sqlite3_column_blob(q, 0) : NULL;
    if (code == SQLITE_DONE) {
        status = PF_ERR_END;
    } else if (blob == NULL) {
        status = fail_call(s, "getting a value");
    } else if ((size_t)sqlite3_column_bytes(q, 0) > capacity) {
        status = pf_fail(&s->failure, PF_ERR_SPACE, "%s: value %s has %d bytes, the buffer %zu", s->path, key,
                         sqlite3_column_bytes(q, 0), capacity);
    } else {
        *n = (size_t)sqlite3_column_bytes(q, 0);
        memcpy(bytes, blob, *n);
    }
    sqlite3_reset(q);
    sqlite3_clear_bindings(q);
    pthread_mutex_unlock(&s->mutex);
    return status;
}

static void spool_get_stats(void *self, pf_spool_stats *stats)
{
    spool *s = self;
    pthread_mutex_lock(&s->mutex);
    *stats = s->stats;
    pthread_mutex_unlock(&s->mutex);
}

/* A copy of the caller's own: another thread may fail while this one reads. */
static const char *spool_error(void *self)
{
    static _Thread_local pf_failure copy;
    spool *s = self;
    pthread_mutex_lock(&s->mutex);
    copy = s->failure;
    pthread_mutex_unlock(&s->mutex);
    return copy.text;
}

static void spool_close(void *self)
{
    spool *s = self;
    close_database(s);
    pthread_mutex_destroy(&s->mutex);
    free(s->path);
    free(s);
}

pf_status pf_spool_open(pf_spool *opened, const pf_spool_config *config, char *error, size_t n)
{
    static const pf_spool_ops ops = {
        .put = spool_put,
        .next = spool_next,
        .read = spool_read,
        .remove = spool_remove,
        .get = spool_get,
        .set = spool_set,
        .put_and_set = spool_put_and_set,
        .victims = spool_victims,
        .exchange = spool_exchange,
        .keep_all = spool_keep_all,
        .stats = spool_get_stats,
        .error = spool_error,
        .close = spool_close,
    };
    pf_failure failure = {""};
    if (config->path == NULL || config->path[0] == '\0')
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_ARGUMENT, "spool: no path"), error, n);
    spool *s = calloc(1, sizeof *s);
    if (s == NULL || (s->path = strdup(config->path)) == NULL) {
        free(s);
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "spool: no memory"), error, n);
    }
    pthread_mutex_init(&s->mutex, NULL);
    s->quota = config->quota;
    pf_status status = open_database(s);
    if (s->is_damaged)
        status = heal(s);
    if (status != PF_OK) {
        pf_failure_copy(&s->failure, status, error, n);
        spool_close(s);
        return status;
    }
    opened->self = s;
    opened->ops = &ops;
    return PF_OK;
}
