/* The spool's database: its statements, how it is opened, and how it comes back from damage. All but enter() want the
 * mutex. */
#ifndef PIPEFISH_SPOOL_DATABASE_H
#define PIPEFISH_SPOOL_DATABASE_H

#include "common/failure.h"
#include "pipefish/drivers/spool.h"
#include "spool/schema.h"

#include <pthread.h>
#include <sqlite3.h>

typedef enum pf_spool_statement {
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
    SQL_FREE_PAGES,
    SQL_PAGES,
    SQL_STATEMENTS,
} pf_spool_statement;

typedef struct pf_spool_database {
    pthread_mutex_t mutex;
    sqlite3 *db;                              /* NULL: it could not be opened again after it was found damaged */
    sqlite3_stmt *statements[SQL_STATEMENTS]; /* those that were asked for */
    char *path;
    uint64_t quota;
    void (*alive)(void);
    bool is_damaged;   /* SQLite has found the file to be, and it is to be replaced */
    bool is_read_only; /* it cannot be written: the medium does not allow it, */
    bool is_full;      /* or had no room for what an opening writes */
    int no_room;       /* errno of the last that found no room where it writes: ENOSPC, EDQUOT, ENOMEM; 0: none did */
    uint64_t retry_ns; /* not before: opening a full one for writing; pf_spool_reuse_log */
    int64_t highest;   /* row given or shown to anybody */
    pf_spool_stats stats;
    pf_failure failure, healing;
} pf_spool_database;

/* Opens, and heals if need be; goes on with what an earlier healing has not finished. PF_OK, or as pf_spool_open. */
pf_status pf_spool_database_open(pf_spool_database *d);
void pf_spool_database_close(pf_spool_database *d);

/* Takes the mutex and sees to it that the database is open. False, without the mutex: it cannot be. A medium that was
 * read-only or full is asked whether it still is. */
bool pf_spool_enter(pf_spool_database *d);

/* Gives the mutex back; what was found damaged meanwhile is replaced first. */
void pf_spool_leave(pf_spool_database *d);

/* In place of a damaged file a new one, with what can be read of it. Rows keep their numbers, so that whoever holds
 * some need not know. A file that cannot be set aside stays in use. */
pf_status pf_spool_heal(pf_spool_database *d);

/* A statement, made when it is first asked for. NULL: it cannot be; to bind and to step that fails, and the reason
 * stays in the connection. */
sqlite3_stmt *pf_spool_prepare(pf_spool_database *d, pf_spool_statement which);
void pf_spool_unbind(sqlite3_stmt *q);

/* Runs a statement that gives no rows, and leaves it ready for the next time. The error stays in the connection. */
bool pf_spool_run(pf_spool_database *d, pf_spool_statement which);

/* The call that failed is counted and told in SQLite's words. PF_ERR_SPACE, else PF_ERR_IO. */
pf_status pf_spool_fail(pf_spool_database *d, const char *doing);

/* Pages that n bytes of an object fill for sure, beside its row's: each begins with the next one's number. */
static inline uint64_t pf_spool_pages(size_t n)
{
    return n / (PF_SPOOL_PAGE - 4);
}

/* Whether an object of n bytes may make the file larger, if it has to: inside the open transaction, after what has gone
 * for it (is_exchange). PF_OK; PF_ERR_SPACE, counted and told; PF_ERR_IO. */
pf_status pf_spool_check_disk(pf_spool_database *d, size_t n, bool is_exchange);

/* How many pages of others have to go lest an object of n bytes make the file larger on a disk where it must not; 0: it
 * may, or does not. PF_OK; PF_ERR_IO. */
pf_status pf_spool_pages_to_free(pf_spool_database *d, size_t n, uint64_t *pages);

/* After PF_ERR_SPACE, outside of transactions: true if SQLite had no room, or soon has none, and may have now, for what
 * is in the log has gone into the file, so that the log begins anew where it lies. */
bool pf_spool_reuse_log(pf_spool_database *d);

/* As pf_spool_fail where it is opened for reading only: later it may be written. PF_ERR_SPACE. */
pf_status pf_spool_fail_read_only(pf_spool_database *d);

#endif
