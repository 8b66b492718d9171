#include "spool/salvage.h"
#include "pipefish/drivers/sha256.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#define ASIDE_MAX 99

bool pf_spool_was_one(const char *path, uint32_t application_id)
{
    static const char mark[] = "CREATE TABLE object (row INTEGER PRIMARY KEY AUTOINCREMENT";
    uint8_t page[4096];
    const uint8_t id[4] = {(uint8_t)(application_id >> 24), (uint8_t)(application_id >> 16),
                           (uint8_t)(application_id >> 8), (uint8_t)application_id};
    FILE *file = fopen(path, "rb");
    if (file == NULL)
        return false;
    size_t n = fread(page, 1, sizeof page, file);
    (void)fclose(file);
    return (n >= 72 && memcmp(page + 68, id, sizeof id) == 0) || memmem(page, n, mark, sizeof mark - 1) != NULL;
}

pf_status pf_spool_set_aside(const char *path, char aside[PF_SALVAGE_PATH_MAX], pf_failure *failure)
{
    char from[PF_SALVAGE_PATH_MAX], to[PF_SALVAGE_PATH_MAX + 8];
    int number = 1;
    do
        (void)snprintf(aside, PF_SALVAGE_PATH_MAX, "%s.damaged-%d", path, number);
    while (access(aside, F_OK) == 0 && ++number <= ASIDE_MAX);
    if (rename(path, aside) != 0)
        return pf_fail(failure, PF_ERR_IO, "%s: damaged, and cannot be set aside: %s", path, strerror(errno));
    (void)snprintf(from, sizeof from, "%s-wal", path);
    (void)snprintf(to, sizeof to, "%s-wal", aside);
    (void)rename(from, to);
    return PF_OK;
}

/* One row of the damaged file. */
static bool copy_object(sqlite3_stmt *put, sqlite3_stmt *row)
{
    uint8_t hash[32];
    const void *name = sqlite3_column_blob(row, 2), *bytes = sqlite3_column_blob(row, 3);
    const int n = sqlite3_column_bytes(row, 3);
    if (name == NULL || bytes == NULL || sqlite3_column_bytes(row, 2) != 32 ||
        pf_sha256(bytes, (size_t)n, hash) != PF_OK || memcmp(hash, name, sizeof hash) != 0)
        return false;
    for (int i = 0; i < 4; i++)
        (void)sqlite3_bind_value(put, i + 1, sqlite3_column_value(row, i));
    bool is_new = sqlite3_step(put) == SQLITE_DONE;
    (void)sqlite3_reset(put);
    return is_new;
}

static void copy_values(sqlite3 *from, sqlite3 *to)
{
    sqlite3_stmt *get = NULL, *set = NULL;
    if (sqlite3_prepare_v2(from, "SELECT key, bytes FROM value", -1, &get, NULL) == SQLITE_OK &&
        sqlite3_prepare_v2(to, "INSERT OR REPLACE INTO value (key, bytes) VALUES (?1, ?2)", -1, &set, NULL) ==
            SQLITE_OK) {
        while (sqlite3_step(get) == SQLITE_ROW) {
            (void)sqlite3_bind_value(set, 1, sqlite3_column_value(get, 0));
            (void)sqlite3_bind_value(set, 2, sqlite3_column_value(get, 1));
            (void)sqlite3_step(set);
            (void)sqlite3_reset(set);
        }
    }
    sqlite3_finalize(get);
    sqlite3_finalize(set);
}

uint64_t pf_spool_salvage(sqlite3 *to, const char *aside)
{
    /* From both ends: a page that cannot be read stops a walk over the table. */
    static const char *const walks[] = {"SELECT row, kind, name, bytes FROM object NOT INDEXED ORDER BY row",
                                        "SELECT row, kind, name, bytes FROM object NOT INDEXED ORDER BY row DESC"};
    sqlite3 *from = NULL;
    sqlite3_stmt *put = NULL;
    uint64_t copied = 0;
    if (sqlite3_open_v2(aside, &from, SQLITE_OPEN_READWRITE, NULL) == SQLITE_OK &&
        sqlite3_exec(to, "BEGIN IMMEDIATE", NULL, NULL, NULL) == SQLITE_OK) {
        copy_values(from, to);
        if (sqlite3_prepare_v2(to, "INSERT OR IGNORE INTO object (row, kind, name, bytes) VALUES (?1, ?2, ?3, ?4)", -1,
                               &put, NULL) == SQLITE_OK) {
            for (size_t i = 0; i < sizeof walks / sizeof walks[0]; i++) {
                sqlite3_stmt *walk = NULL;
                if (sqlite3_prepare_v2(from, walks[i], -1, &walk, NULL) == SQLITE_OK)
                    while (sqlite3_step(walk) == SQLITE_ROW)
                        if (copy_object(put, walk))
                            copied += (uint64_t)sqlite3_changes(to);
                sqlite3_finalize(walk);
            }
        }
        sqlite3_finalize(put);
        if (sqlite3_exec(to, "COMMIT", NULL, NULL, NULL) != SQLITE_OK) {
            (void)sqlite3_exec(to, "ROLLBACK", NULL, NULL, NULL);
            copied = 0;
        }
    }
    (void)sqlite3_close(from);
    return copied;
}
