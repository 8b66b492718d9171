/* The spool in SQLite: WAL with synchronous=FULL, so that a commit outlives a power cut. One connection behind a mutex,
 * which each call takes.
 */
#include "pipefish/drivers/spool.h"
#include "pipefish/drivers/sha256.h"
#include "spool/database.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

typedef struct object {
    uint32_t kind;
    const uint8_t *name;
    const void *bytes;
    size_t n;
    const pf_spool_rank *rank;
    const pf_spool_victim *victims;
    uint32_t victims_n;
} object;

/* Removes what has to go inside the open transaction. */
static pf_status evict(pf_spool_database *d, const object *o, uint64_t *freed, uint32_t *gone)
{
    for (uint32_t i = 0; i < o->victims_n; i++) {
        (void)sqlite3_bind_int64(pf_spool_prepare(d, SQL_REMOVE), 1, (int64_t)o->victims[i].row);
        if (!pf_spool_run(d, SQL_REMOVE))
            return pf_spool_fail(d, "making room");
        if (sqlite3_changes(d->db) > 0) {
            *freed += o->victims[i].size;
            ++*gone;
        }
    }
    return PF_OK;
}

static pf_status set_rank(pf_spool_database *d, int64_t row, const pf_spool_rank *rank)
{
    sqlite3_stmt *q = pf_spool_prepare(d, SQL_RANK);
    (void)sqlite3_bind_int64(q, 1, row);
    (void)sqlite3_bind_int64(q, 2, rank->importance);
    (void)sqlite3_bind_int64(q, 3, rank->number);
    return pf_spool_run(d, SQL_RANK) ? PF_OK : pf_spool_fail(d, "storing");
}

/* Stores an object inside the open transaction, in which `freed` bytes have been removed. *stored: it was not there
 * before. */
static pf_status insert(pf_spool_database *d, const object *o, uint64_t freed, bool *stored)
{
    const uint64_t bytes = d->stats.bytes - freed;
    sqlite3_stmt *has = pf_spool_prepare(d, SQL_HAS);
    *stored = false;
    (void)sqlite3_bind_blob(has, 1, o->name, 32, SQLITE_STATIC);
    int code = sqlite3_step(has);
    sqlite3_reset(has);
    pf_spool_unbind(has);
    if (code == SQLITE_ROW)
        return PF_OK;
    if (code != SQLITE_DONE)
        return pf_spool_fail(d, "storing");
    if (d->quota != 0 && bytes > d->quota - o->n) {
        d->stats.errors++;
        return pf_fail(&d->failure, PF_ERR_SPACE, "%s: quota: %" PRIu64 " bytes wait, %zu more are above %" PRIu64,
                       d->path, bytes, o->n, d->quota);
    }
    pf_status status = pf_spool_check_disk(d, o->n, freed > 0);
    if (status != PF_OK)
        return status;
    sqlite3_stmt *put = pf_spool_prepare(d, SQL_PUT);
    (void)sqlite3_bind_int64(put, 1, o->kind);
    (void)sqlite3_bind_blob(put, 2, o->name, 32, SQLITE_STATIC);
    if (sqlite3_bind_blob64(put, 3, o->bytes, o->n, SQLITE_STATIC) != SQLITE_OK) {
        pf_spool_unbind(put);
        return pf_spool_fail(d, "storing");
    }
    if (!pf_spool_run(d, SQL_PUT))
        return pf_spool_fail(d, "storing");
    *stored = true;
    d->highest = sqlite3_last_insert_rowid(d->db);
    return o->rank == NULL ? PF_OK : set_rank(d, d->highest, o->rank);
}

static pf_status set_value(pf_spool_database *d, const char *key, const void *bytes, size_t n)
{
    pf_spool_statement which = n == 0 ? SQL_DELETE : SQL_SET;
    sqlite3_stmt *q = pf_spool_prepare(d, which);
    (void)sqlite3_bind_text(q, 1, key, -1, SQLITE_STATIC);
    if (n != 0 && sqlite3_bind_blob64(q, 2, bytes, n, SQLITE_STATIC) != SQLITE_OK) {
        pf_spool_unbind(q);
        return pf_spool_fail(d, "setting a value");
    }
    return pf_spool_run(d, which) ? PF_OK : pf_spool_fail(d, "setting a value");
}

/* One transaction: an object (or NULL), a value (or a NULL key). With the mutex. */
static pf_status try_to_store(pf_spool_database *d, const object *o, const char *key, const void *value, size_t value_n)
{
    bool stored = false;
    uint64_t freed = 0;
    uint32_t gone = 0;
    if (d->is_read_only)
        return pf_spool_fail_read_only(d);
    d->no_room = 0;
    pf_status status = pf_spool_run(d, SQL_BEGIN) ? PF_OK : pf_spool_fail(d, "storing");
    if (status == PF_OK && o != NULL)
        status = evict(d, o, &freed, &gone);
    if (status == PF_OK && o != NULL)
        status = insert(d, o, freed, &stored);
    if (status == PF_OK && key != NULL)
        status = set_value(d, key, value, value_n);
    if (status == PF_OK && !pf_spool_run(d, SQL_COMMIT))
        status = pf_spool_fail(d, "storing");
    if (status == PF_OK) {
        d->stats.objects -= gone;
        d->stats.bytes -= freed;
        d->stats.evicted += gone;
    }
    if (status == PF_OK && stored) {
        d->stats.objects++;
        d->stats.bytes += o->n;
        d->stats.stored++;
    }
    /* SQLite ends the transaction itself on some errors. */
    if (status != PF_OK && sqlite3_get_autocommit(d->db) == 0)
        (void)pf_spool_run(d, SQL_ROLLBACK);
    return status;
}

static pf_status store(pf_spool_database *d, const object *o, const char *key, const void *value, size_t value_n)
{
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    pf_status status = try_to_store(d, o, key, value, value_n);
    if (d->is_damaged ? pf_spool_heal(d) == PF_OK /* what is to be stored comes but once */
                      : status == PF_ERR_SPACE && pf_spool_reuse_log(d))
        status = try_to_store(d, o, key, value, value_n);
    pf_spool_leave(d);
    return status;
}

static pf_status fail_argument(pf_spool_database *d, const char *text)
{
    pthread_mutex_lock(&d->mutex);
    pf_status status = pf_fail(&d->failure, PF_ERR_ARGUMENT, "%s: %s", d->path, text);
    pthread_mutex_unlock(&d->mutex);
    return status;
}

static pf_status spool_exchange(void *self, const pf_spool_victim *victims, uint32_t count, uint32_t kind,
                                const uint8_t name[32], const void *bytes, size_t n, const pf_spool_rank *rank,
                                const char *key, const void *value, size_t value_n)
{
    pf_spool_database *d = self;
    object o = {kind, name, bytes, n, rank, victims, count};
    if (n == 0 || n > UINT32_MAX)
        return fail_argument(d, "an object must have 1..2^32 - 1 bytes");
    if (d->quota != 0 && n > d->quota)
        return fail_argument(d, "an object is larger than the whole quota");
    return store(d, &o, key, value, value_n);
}

static pf_status spool_put_and_set(void *self, uint32_t kind, const uint8_t name[32], const void *bytes, size_t n,
                                   const char *key, const void *value, size_t value_n)
{
    return spool_exchange(self, NULL, 0, kind, name, bytes, n, NULL, key, value, value_n);
}

static pf_status spool_victims(void *self, uint64_t after, uint32_t importance, size_t n,
                               pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX], uint32_t *count)
{
    pf_spool_database *d = self;
    uint64_t freed = 0, pages_freed = 0, pages = 0;
    int code = SQLITE_ROW;
    *count = 0;
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    pf_status status = pf_spool_pages_to_free(d, n, &pages);
    sqlite3_stmt *q = pf_spool_prepare(d, SQL_VICTIMS);
    (void)sqlite3_bind_int64(q, 1, (int64_t)after);
    (void)sqlite3_bind_int64(q, 2, importance);
    (void)sqlite3_bind_int64(q, 3, PF_SPOOL_VICTIMS_MAX);
    while (status == PF_OK && (freed < n || pages_freed < pages) && (code = sqlite3_step(q)) == SQLITE_ROW) {
        pf_spool_victim *v = &victims[(*count)++];
        *v = (pf_spool_victim){.row = (uint64_t)sqlite3_column_int64(q, 0),
                               .number = (uint32_t)sqlite3_column_int64(q, 1),
                               .size = (uint32_t)sqlite3_column_int64(q, 2)};
        freed += v->size;
        pages_freed += pf_spool_pages(v->size);
    }
    if (code != SQLITE_ROW && code != SQLITE_DONE)
        status = pf_spool_fail(d, "making room");
    else if (status == PF_OK && d->is_read_only)
        status = pf_spool_fail_read_only(d);
    else if (status == PF_OK && code == SQLITE_DONE)
        status = pf_fail(&d->failure, PF_ERR_SPACE, "%s: full, and nothing in it is less important", d->path);
    sqlite3_reset(q);
    pf_spool_leave(d);
    return status;
}

static pf_status spool_keep_all(void *self)
{
    pf_spool_database *d = self;
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    pf_status status = PF_OK;
    if (d->is_read_only)
        status = pf_spool_fail_read_only(d);
    else if (!pf_spool_run(d, SQL_KEEP_ALL))
        status = pf_spool_fail(d, "keeping what is there");
    pf_spool_leave(d);
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
    pf_spool_database *d = self;
    pf_status status = PF_OK;
    if (after >= INT64_MAX)
        return PF_ERR_END;
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    sqlite3_stmt *q = pf_spool_prepare(d, SQL_NEXT);
    (void)sqlite3_bind_int64(q, 1, (int64_t)after);
    int code = sqlite3_step(q);
    if (code == SQLITE_ROW && sqlite3_column_int64(q, 0) <= (int64_t)after) { /* SQLite believes its pages' order */
        d->is_damaged = true;
        d->stats.errors++;
        status = pf_fail(&d->failure, PF_ERR_IO, "%s: listing: its rows are out of order", d->path);
    } else if (code == SQLITE_ROW && sqlite3_column_bytes(q, 2) == 32) {
        item->row = (uint64_t)sqlite3_column_int64(q, 0);
        d->highest = (int64_t)item->row > d->highest ? (int64_t)item->row : d->highest;
        item->kind = (uint32_t)sqlite3_column_int64(q, 1);
        memcpy(item->name, sqlite3_column_blob(q, 2), 32);
        item->size = (uint32_t)sqlite3_column_int64(q, 3);
    } else if (code == SQLITE_DONE) {
        status = PF_ERR_END;
    } else {
        status = pf_spool_fail(d, "listing");
    }
    sqlite3_reset(q);
    pf_spool_leave(d);
    return status;
}

static pf_status spool_read(void *self, const pf_spool_item *item, void *bytes, size_t capacity, size_t *n)
{
    pf_spool_database *d = self;
    uint8_t hash[32];
    pf_status status = PF_OK;
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    sqlite3_stmt *q = pf_spool_prepare(d, SQL_READ);
    (void)sqlite3_bind_int64(q, 1, (int64_t)item->row);
    int code = sqlite3_step(q);
    const void *blob = code == SQLITE_ROW ? sqlite3_column_blob(q, 0) : NULL;
    if (code == SQLITE_DONE) {
        status = PF_ERR_END;
    } else if (blob == NULL) {
        status = pf_spool_fail(d, "reading");
    } else if ((size_t)sqlite3_column_bytes(q, 0) > capacity) {
        status = pf_fail(&d->failure, PF_ERR_SPACE, "%s: row %" PRIu64 " has %d bytes, the buffer %zu", d->path,
                         item->row, sqlite3_column_bytes(q, 0), capacity);
    } else {
        *n = (size_t)sqlite3_column_bytes(q, 0);
        memcpy(bytes, blob, *n);
        if (pf_sha256(bytes, *n, hash) != PF_OK || memcmp(hash, item->name, sizeof hash) != 0) {
            d->stats.errors++;
            status = pf_fail(&d->failure, PF_ERR_CHECKSUM, "%s: row %" PRIu64 ": its bytes do not have its SHA-256",
                             d->path, item->row);
        }
    }
    sqlite3_reset(q);
    pf_spool_leave(d);
    return status;
}

static pf_status try_to_remove(pf_spool_database *d, uint64_t row)
{
    if (d->is_read_only)
        return pf_spool_fail_read_only(d);
    d->no_room = 0;
    sqlite3_stmt *q = pf_spool_prepare(d, SQL_SIZE);
    (void)sqlite3_bind_int64(q, 1, (int64_t)row);
    int code = sqlite3_step(q);
    uint64_t size = code == SQLITE_ROW ? (uint64_t)sqlite3_column_int64(q, 0) : 0;
    sqlite3_reset(q);
    if (code == SQLITE_ROW) /* not before: it would wipe out the error */
        (void)sqlite3_bind_int64(pf_spool_prepare(d, SQL_REMOVE), 1, (int64_t)row);
    if (code != SQLITE_DONE && (code != SQLITE_ROW || !pf_spool_run(d, SQL_REMOVE)))
        return pf_spool_fail(d, "removing");
    if (code == SQLITE_ROW) {
        d->stats.objects--;
        d->stats.bytes -= size;
        d->stats.acknowledged++;
    }
    return PF_OK;
}

static pf_status spool_remove(void *self, uint64_t row)
{
    pf_spool_database *d = self;
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    pf_status status = try_to_remove(d, row);
    if (status == PF_ERR_SPACE && pf_spool_reuse_log(d))
        status = try_to_remove(d, row);
    pf_spool_leave(d);
    return status == PF_OK ? PF_OK : PF_ERR_IO;
}

static pf_status spool_get(void *self, const char *key, void *bytes, size_t capacity, size_t *n)
{
    pf_spool_database *d = self;
    pf_status status = PF_OK;
    if (!pf_spool_enter(d))
        return PF_ERR_IO;
    sqlite3_stmt *q = pf_spool_prepare(d, SQL_GET);
    (void)sqlite3_bind_text(q, 1, key, -1, SQLITE_STATIC);
    int code = sqlite3_step(q);
    const void *blob = code == SQLITE_ROW ? sqlite3_column_blob(q, 0) : NULL;
    if (code == SQLITE_DONE) {
        status = PF_ERR_END;
    } else if (blob == NULL) {
        status = pf_spool_fail(d, "getting a value");
    } else if ((size_t)sqlite3_column_bytes(q, 0) > capacity) {
        status = pf_fail(&d->failure, PF_ERR_SPACE, "%s: value %s has %d bytes, the buffer %zu", d->path, key,
                         sqlite3_column_bytes(q, 0), capacity);
    } else {
        *n = (size_t)sqlite3_column_bytes(q, 0);
        memcpy(bytes, blob, *n);
    }
    sqlite3_reset(q);
    pf_spool_unbind(q);
    pf_spool_leave(d);
    return status;
}

static void spool_get_stats(void *self, pf_spool_stats *stats)
{
    pf_spool_database *d = self;
    pthread_mutex_lock(&d->mutex);
    *stats = d->stats;
    pthread_mutex_unlock(&d->mutex);
}

/* A copy of the caller's own: another thread may fail while this one reads. */
static const char *spool_error(void *self)
{
    static _Thread_local pf_failure copy;
    pf_spool_database *d = self;
    pthread_mutex_lock(&d->mutex);
    copy = d->failure;
    pthread_mutex_unlock(&d->mutex);
    return copy.text;
}

static const char *spool_healing(void *self)
{
    static _Thread_local pf_failure copy;
    pf_spool_database *d = self;
    pthread_mutex_lock(&d->mutex);
    copy = d->healing;
    pthread_mutex_unlock(&d->mutex);
    return copy.text;
}

static void spool_close(void *self)
{
    pf_spool_database *d = self;
    pf_spool_database_close(d);
    pthread_mutex_destroy(&d->mutex);
    free(d->path);
    free(d);
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
        .healing = spool_healing,
        .close = spool_close,
    };
    pf_failure failure = {""};
    if (config->path == NULL || config->path[0] == '\0')
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_ARGUMENT, "spool: no path"), error, n);
    pf_spool_database *d = calloc(1, sizeof *d);
    if (d == NULL || (d->path = strdup(config->path)) == NULL) {
        free(d);
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "spool: no memory"), error, n);
    }
    pthread_mutex_init(&d->mutex, NULL);
    d->quota = config->quota;
    d->alive = config->alive;
    pf_status status = pf_spool_database_open(d);
    if (status != PF_OK) {
        pf_failure_copy(&d->failure, status, error, n);
        spool_close(d);
        return status;
    }
    opened->self = d;
    opened->ops = &ops;
    return PF_OK;
}
