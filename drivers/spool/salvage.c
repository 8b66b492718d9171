#include "spool/salvage.h"
#include "pipefish/drivers/file.h"
#include "pipefish/drivers/sha256.h"
#include "spool/schema.h"

#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#define ASIDE_END     100 /* numbers of files that were set aside: below it */
#define CHUNK_OBJECTS 64  /* of one transaction: some megabytes, so that neither a kill nor the log costs much */
#define PATH_BYTES    1024

bool pf_spool_has_memory(void)
{
    void *more_than_an_object = sqlite3_malloc64(UINT64_C(1) << 26);
    sqlite3_free(more_than_an_object);
    return more_than_an_object != NULL;
}

/* The log's name follows the file's. */
static int rename_both(const char *from, const char *to)
{
    char log_from[PATH_BYTES + 8], log_to[PATH_BYTES + 8];
    if (rename(from, to) != 0)
        return -1;
    (void)snprintf(log_from, sizeof log_from, "%s-wal", from);
    (void)snprintf(log_to, sizeof log_to, "%s-wal", to);
    (void)rename(log_from, log_to);
    return 0;
}

static void name_aside(const char *path, int number, char read[PATH_BYTES], char unread[PATH_BYTES])
{
    (void)snprintf(read, PATH_BYTES, "%s.damaged-%d", path, number);
    (void)snprintf(unread, PATH_BYTES, "%s.damaged-%d.unread", path, number);
}

/* The highest number below `end` under which a file waits to be read; 0: none. Each start of a healthy spool asks for
 * all of them, so only the digits are written anew. */
static int find_unread(const char *path, int end)
{
    char name[PATH_BYTES];
    const int n = snprintf(name, sizeof name, "%s.damaged-", path);
    if (n < 0 || n + (int)sizeof "99.unread" > (int)sizeof name)
        return 0;
    for (int number = end - 1; number > 0; number--) {
        char *at = name + n;
        if (number >= 10)
            *at++ = (char)('0' + number / 10);
        *at++ = (char)('0' + number % 10);
        memcpy(at, ".unread", sizeof ".unread");
        if (access(name, F_OK) == 0)
            return number;
    }
    return 0;
}

pf_status pf_spool_set_aside(const char *path, pf_failure *failure)
{
    char read[PATH_BYTES], unread[PATH_BYTES];
    int number = find_unread(path, ASIDE_END); /* above every unread one: of those the highest is the newest */
    do {
        number += number < ASIDE_END - 1;
        name_aside(path, number, read, unread);
    } while (number < ASIDE_END - 1 && access(read, F_OK) == 0);
    if (rename_both(path, unread) != 0)
        return pf_fail(failure, PF_ERR_IO, "%s: damaged, and cannot be set aside: %s", path, strerror(errno));
    return PF_OK;
}

void pf_spool_finish_setting_aside(const char *path)
{
    char read[PATH_BYTES], unread[PATH_BYTES], log[PATH_BYTES + 8], log_unread[PATH_BYTES + 8];
    (void)snprintf(log, sizeof log, "%s-wal", path);
    if (access(path, F_OK) == 0 || access(log, F_OK) != 0)
        return;
    const int number = find_unread(path, ASIDE_END);
    name_aside(path, number, read, unread);
    (void)snprintf(log_unread, sizeof log_unread, "%s-wal", unread);
    if (number > 0 && access(log_unread, F_OK) != 0)
        (void)rename(log, log_unread);
}

/* ---- one file */

typedef struct salvage {
    sqlite3 *from, *to;
    sqlite3_stmt *put, *note;
    void (*alive)(void);
    char key[32];         /* of the value that says how far it has come */
    int64_t up_to, after; /* rows that are done: from the first one up, from the last one down */
    bool has_values;      /* taken through this page, by an earlier run too: they may have changed since */
    bool is_usual;        /* the file's first page is that of every spool */
    bool is_lossy;        /* something of the file could not be read */
    int chunk;            /* objects of the open transaction */
    char why[128];        /* the new file takes no more, or the damaged one cannot be read now */
} salvage;

static bool run(sqlite3 *db, const char *text)
{
    return sqlite3_exec(db, text, NULL, NULL, NULL) == SQLITE_OK;
}

/* After an error in reading the damaged file. True: its bytes are bad, and always will be. False: it is the moment (no
 * descriptor, no memory, a lock), and s->why says so. "No such table" and a row too big to be one are its bytes too. */
static bool is_lost(salvage *s)
{
    const int code = sqlite3_extended_errcode(s->from);
    switch (code & 0xff) {
    case SQLITE_CORRUPT:
    case SQLITE_NOTADB:
    case SQLITE_ERROR:
    case SQLITE_TOOBIG:
        return true;
    case SQLITE_NOMEM:
        if (pf_spool_has_memory())
            return true;
        break;
    default:
        break;
    }
    if (code == SQLITE_IOERR_READ || code == SQLITE_IOERR_SHORT_READ || code == SQLITE_IOERR_CORRUPTFS)
        return true;
    (void)snprintf(s->why, sizeof s->why, "%s", sqlite3_errmsg(s->from));
    return false;
}

/* A note is two rows, and a third number while the values are still to be taken. */
enum { NOTE = 16, NOTE_WITHOUT_VALUES = 24 };

static void load_progress(salvage *s)
{
    sqlite3_stmt *get = NULL;
    s->up_to = 0;
    s->after = INT64_MAX;
    s->has_values = false;
    if (sqlite3_prepare_v2(s->to, "SELECT bytes FROM value WHERE key = ?1", -1, &get, NULL) == SQLITE_OK) {
        (void)sqlite3_bind_text(get, 1, s->key, -1, SQLITE_STATIC);
        const int n = sqlite3_step(get) == SQLITE_ROW ? sqlite3_column_bytes(get, 0) : 0;
        if (n == NOTE || n == NOTE_WITHOUT_VALUES) {
            const uint8_t *bytes = sqlite3_column_blob(get, 0);
            memcpy(&s->up_to, bytes, 8);
            memcpy(&s->after, bytes + 8, 8);
            s->has_values = n == NOTE;
        }
    }
    sqlite3_finalize(get);
}

/* SQLite ends the transaction itself on some errors. */
static bool give_up(salvage *s)
{
    if (s->why[0] == '\0')
        (void)snprintf(s->why, sizeof s->why, "%s", sqlite3_errmsg(s->to));
    if (sqlite3_get_autocommit(s->to) == 0)
        (void)run(s->to, "ROLLBACK");
    return false;
}

static bool commit(salvage *s)
{
    int64_t rows[3] = {s->up_to, s->after, 0};
    (void)sqlite3_bind_text(s->note, 1, s->key, -1, SQLITE_STATIC);
    (void)sqlite3_bind_blob(s->note, 2, rows, s->has_values ? NOTE : NOTE_WITHOUT_VALUES, SQLITE_TRANSIENT);
    bool ok = sqlite3_step(s->note) == SQLITE_DONE;
    ok = sqlite3_reset(s->note) == SQLITE_OK && ok && run(s->to, "COMMIT");
    return ok || give_up(s);
}

/* False: no memory. What is not bound would be NULL, which an INSERT OR IGNORE passes over. */
static bool copy_column(sqlite3_stmt *to, sqlite3_stmt *from, int column)
{
    return sqlite3_bind_value(to, column + 1, sqlite3_column_value(from, column)) == SQLITE_OK;
}

/* Of a value that is there already the newer one stays. A note that the damaged file has of another one says that the
 * other's values were taken into it, and no more: objects taken with them may be lost here. False: the new file does
 * not take them, or they cannot be read now. */
static bool copy_values(salvage *s)
{
    static const char order[] = "SELECT key, CASE WHEN key GLOB 'salvage [0-9]*' THEN ?1 ELSE bytes END FROM value "
                                "WHERE typeof(key) = 'text' AND typeof(bytes) = 'blob'";
    const int64_t rows[2] = {0, INT64_MAX};
    sqlite3_stmt *get = NULL, *set = NULL;
    int code = SQLITE_OK;
    bool ok = sqlite3_prepare_v2(s->to, "INSERT OR IGNORE INTO value (key, bytes) VALUES (?1, ?2)", -1, &set, NULL) ==
              SQLITE_OK;
    if (ok && (code = sqlite3_prepare_v2(s->from, order, -1, &get, NULL)) == SQLITE_OK) {
        (void)sqlite3_bind_blob(get, 1, rows, sizeof rows, SQLITE_STATIC);
        while (ok && (code = sqlite3_step(get)) == SQLITE_ROW) {
            ok = copy_column(set, get, 0) && copy_column(set, get, 1) && sqlite3_step(set) == SQLITE_DONE;
            (void)sqlite3_reset(set);
        }
    }
    s->has_values = ok && code == SQLITE_DONE;
    if (ok && code != SQLITE_DONE)
        ok = is_lost(s);
    sqlite3_finalize(get);
    sqlite3_finalize(set);
    return ok;
}

/* False: the new file does not take it. */
static bool copy_object(salvage *s, sqlite3_stmt *row)
{
    uint8_t hash[32];
    const void *name = sqlite3_column_blob(row, 2), *bytes = sqlite3_column_blob(row, 3);
    if (name == NULL || bytes == NULL || sqlite3_column_bytes(row, 2) != 32 ||
        pf_sha256(bytes, (size_t)sqlite3_column_bytes(row, 3), hash) != PF_OK || memcmp(hash, name, sizeof hash) != 0)
        return true;
    bool ok = true;
    for (int i = 0; i < 4; i++)
        ok = ok && copy_column(s->put, row, i);
    ok = ok && sqlite3_step(s->put) == SQLITE_DONE;
    (void)sqlite3_reset(s->put);
    return ok;
}

/* Walks over the rows that are left, one way. False: the new file takes no more, or the damaged one cannot be read now.
 * *has_ended: it reached the end, and no page stopped it. */
static bool walk(salvage *s, bool is_down, bool *has_ended)
{
    static const char *const orders[] = {
        "SELECT row, kind, name, bytes FROM object NOT INDEXED WHERE row > ?1 AND row < ?2 ORDER BY row",
        "SELECT row, kind, name, bytes FROM object NOT INDEXED WHERE row > ?1 AND row < ?2 ORDER BY row DESC"};
    sqlite3_stmt *q = NULL;
    bool ok = true;
    int code = sqlite3_prepare_v2(s->from, orders[is_down], -1, &q, NULL);
    if (code == SQLITE_OK) {
        (void)sqlite3_bind_int64(q, 1, s->up_to);
        (void)sqlite3_bind_int64(q, 2, s->after);
        while (ok && (code = sqlite3_step(q)) == SQLITE_ROW) {
            if (s->alive != NULL)
                s->alive();
            ok = copy_object(s, q);
            if (!ok)
                break;
            *(is_down ? &s->after : &s->up_to) = sqlite3_column_int64(q, 0);
            if (++s->chunk == CHUNK_OBJECTS) {
                s->chunk = 0;
                ok = commit(s) && run(s->to, "BEGIN IMMEDIATE");
            }
        }
    }
    if (ok && code != SQLITE_DONE)
        ok = is_lost(s);
    sqlite3_finalize(q);
    *has_ended = ok && code == SQLITE_DONE;
    return ok;
}

/* From both ends: a page that cannot be read stops a walk over the table. False: there is more, for another time. */
static bool copy_all(salvage *s)
{
    bool has_ended = false, from_above = false;
    load_progress(s);
    bool ok = run(s->to, "BEGIN IMMEDIATE") && (s->has_values || copy_values(s)) && walk(s, false, &has_ended) &&
              (has_ended || walk(s, true, &from_above)) && commit(s);
    s->is_lossy = !has_ended || !s->has_values;
    return ok || give_up(s);
}

/* Alone: its log needs no memory that is shared, which would be a file more. */
static bool open_damaged(salvage *s, const char *file)
{
    return (sqlite3_open_v2(file, &s->from, SQLITE_OPEN_READWRITE, NULL) == SQLITE_OK &&
            run(s->from, "PRAGMA locking_mode = EXCLUSIVE")) ||
           is_lost(s);
}

/* In place of the file's own, through which it has been read. */
static bool write_first_page(salvage *s, const char *file)
{
    const uint8_t *page = pf_spool_first_page();
    FILE *f = page != NULL ? fopen(file, "r+b") : NULL;
    bool ok = f != NULL && fwrite(page, 1, PF_SPOOL_PAGE, f) == PF_SPOOL_PAGE;
    ok = f != NULL && fclose(f) == 0 && ok;
    if (!ok)
        (void)snprintf(s->why, sizeof s->why, "%s", page != NULL ? strerror(errno) : "no memory");
    return ok;
}

/* The log's pages go into the file, its first one among them. */
static bool empty_log(salvage *s, const char *file)
{
    bool ok = open_damaged(s, file);
    /* The first opens the log, and fails where the log's first page is bad. */
    ok = ok && (run(s->from, "PRAGMA user_version") || is_lost(s));
    ok = ok &&
         (sqlite3_wal_checkpoint_v2(s->from, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL, NULL) == SQLITE_OK || is_lost(s));
    (void)sqlite3_close(s->from);
    s->from = NULL;
    return ok;
}

/* False: not now, and s->why says so. */
static bool mend_first_page(salvage *s, const char *file)
{
    char log[PATH_BYTES + 8];
    (void)snprintf(log, sizeof log, "%s-wal", file);
    if (!write_first_page(s, file))
        return false;
    return access(log, F_OK) != 0 || (empty_log(s, file) && write_first_page(s, file));
}

/* Whether the file, opened, has the first page that every spool has, as far as it matters. False, with s->why: it
 * cannot be read now. */
static bool has_every_spools_page(salvage *s, const char *file)
{
    pf_spool_schema schema;
    if (pf_spool_read_schema(s->from, &schema) != SQLITE_OK) {
        (void)is_lost(s);
        return false;
    }
    return schema.is_in_place && pf_spool_has_first_header(file);
}

/* One pass. The notes of what was read through a page of the file's own say nothing of the other pass. */
static bool read_through(salvage *s, const char *file, int number)
{
    /* Where its row is another's by now it gets a new one; what is there already takes none. */
    static const char put[] = "INSERT OR IGNORE INTO object (row, kind, name, bytes) SELECT "
                              "CASE WHEN EXISTS (SELECT 1 FROM object WHERE row = ?1) THEN NULL ELSE ?1 END, "
                              "?2, ?3, ?4 WHERE NOT EXISTS (SELECT 1 FROM object WHERE name = ?3)";
    static const char note[] = "INSERT OR REPLACE INTO value (key, bytes) VALUES (?1, ?2)";
    bool is_done = open_damaged(s, file);
    s->chunk = 0;
    s->is_usual = is_done && has_every_spools_page(s, file);
    (void)snprintf(s->key, sizeof s->key, s->is_usual ? "salvage %d" : "salvage %d own", number);
    if (!is_done || s->why[0] != '\0')
        is_done = false;
    else if (sqlite3_prepare_v2(s->to, put, -1, &s->put, NULL) != SQLITE_OK ||
             sqlite3_prepare_v2(s->to, note, -1, &s->note, NULL) != SQLITE_OK)
        is_done = give_up(s);
    else
        is_done = copy_all(s);
    sqlite3_finalize(s->put);
    sqlite3_finalize(s->note);
    (void)sqlite3_close(s->from);
    s->put = s->note = NULL;
    s->from = NULL;
    return is_done;
}

static bool salvage_file(salvage *s, const char *file, int number)
{
    if (!read_through(s, file, number))
        return false;
    if ((s->is_usual && !s->is_lossy) || !pf_spool_takes_first_page(file))
        return true;
    return mend_first_page(s, file) && read_through(s, file, number);
}

static uint64_t count(sqlite3 *db)
{
    sqlite3_stmt *q = NULL;
    uint64_t n = 0;
    if (sqlite3_prepare_v2(db, "SELECT count(*) FROM object", -1, &q, NULL) == SQLITE_OK &&
        sqlite3_step(q) == SQLITE_ROW)
        n = (uint64_t)sqlite3_column_int64(q, 0);
    sqlite3_finalize(q);
    return n;
}

uint32_t pf_spool_salvage(sqlite3 *to, const char *path, void (*alive)(void), pf_failure *told)
{
    uint32_t files = 0, left = 0;
    for (int number = ASIDE_END; (number = find_unread(path, number)) > 0;) {
        char read[PATH_BYTES], unread[PATH_BYTES];
        salvage s = {.to = to, .alive = alive};
        name_aside(path, number, read, unread);
        files++;
        const uint64_t before = count(to);
        bool is_done = salvage_file(&s, unread, number);
        const uint64_t saved = count(to) - before; /* of those in a transaction that failed none are there */
        if (!is_done) {
            left++;
            (void)pf_fail(told, PF_OK,
                          "%s: was damaged: %" PRIu64
                          " objects saved from it; more are in %s, and the next start tries "
                          "again: %s",
                          path, saved, unread, s.why);
            continue;
        }
        left += rename_both(unread, read) != 0;
        (void)pf_fail(told, PF_OK, "%s: was damaged: %" PRIu64 " objects saved from it, the rest is in %s", path, saved,
                      read);
    }
    /* Not before the names have changed, on the disk too, or all would be taken once more. */
    if (left == 0 && pf_file_sync_folder(path))
        (void)run(to, "DELETE FROM value WHERE key GLOB 'salvage [0-9]*'");
    return files;
}
