#include "spool/schema.h"

#include <pthread.h>
#include <string.h>

#define TEXT_OF(x) #x
#define TEXT(x)    TEXT_OF(x)

/* AUTOINCREMENT: a row number is never used again, so that next() in order of rows is next() in order of storing. */
#define OBJECT                                                                                                         \
    "CREATE TABLE object ("                                                                                            \
    "row INTEGER PRIMARY KEY AUTOINCREMENT,"                                                                           \
    "kind INTEGER NOT NULL,"                                                                                           \
    "name BLOB NOT NULL UNIQUE CHECK (length(name) = 32),"                                                             \
    "bytes BLOB NOT NULL)"
#define VALUE "CREATE TABLE value (key TEXT PRIMARY KEY, bytes BLOB NOT NULL) WITHOUT ROWID"

/* Beside the objects, so that taking a rank away does not write the object anew, and so that programs without ranks can
 * go on with the file: to them it is a table that looks after itself. */
#define RANKS "evictable (row INTEGER PRIMARY KEY,importance INTEGER NOT NULL, number INTEGER NOT NULL)"
#define ORDER "evictable_order ON evictable (importance, row)"
#define GONE  "evictable_gone AFTER DELETE ON object BEGIN DELETE FROM evictable WHERE row = old.row; END"

const char pf_spool_create[] =
    "BEGIN IMMEDIATE;" OBJECT ";" VALUE ";"
    "PRAGMA application_id = " TEXT(PF_SPOOL_APPLICATION_ID) ";"
                                                             "PRAGMA user_version = " TEXT(PF_SPOOL_VERSION) ";COMMIT;";
const char pf_spool_add_ranks[] =
    "BEGIN IMMEDIATE;CREATE TABLE " RANKS ";CREATE INDEX " ORDER ";CREATE TRIGGER " GONE ";COMMIT;";

enum { BASE = 4, ENTRIES = 7, ANY = -1 };

/* As SQLite writes them into an empty file, the roots in order; ranks may have come later, to any pages. */
static const struct entry {
    const char *type, *name, *table;
    int root;
    const char *sql;
} entries[ENTRIES] = {
    {"table", "object", "object", 2, OBJECT},
    {"index", "sqlite_autoindex_object_1", "object", 3, NULL},
    {"table", "sqlite_sequence", "sqlite_sequence", 4, "CREATE TABLE sqlite_sequence(name,seq)"},
    {"table", "value", "value", 5, VALUE},
    {"table", "evictable", "evictable", ANY, "CREATE TABLE " RANKS},
    {"index", "evictable_order", "evictable", ANY, "CREATE INDEX " ORDER},
    {"trigger", "evictable_gone", "object", 0, "CREATE TRIGGER " GONE},
};

static bool is_text(sqlite3_stmt *row, int column, const char *text)
{
    const char *there = (const char *)sqlite3_column_text(row, column);
    return there == NULL || text == NULL ? there == text : strcmp(there, text) == 0;
}

static bool is_entry(sqlite3_stmt *row, const struct entry *e)
{
    const int root = sqlite3_column_int(row, 3);
    return is_text(row, 1, e->name) && is_text(row, 0, e->type) && is_text(row, 2, e->table) &&
           is_text(row, 4, e->sql) && (e->root == ANY ? root > BASE + 1 : root == e->root);
}

int pf_spool_read_schema(sqlite3 *db, pf_spool_schema *found)
{
    sqlite3_stmt *row = NULL;
    int count[ENTRIES] = {0}, root[ENTRIES] = {0}, rows = 0, ranks = 0;
    int code = sqlite3_prepare_v2(db, "SELECT type, name, tbl_name, rootpage, sql FROM sqlite_schema", -1, &row, NULL);
    while (code == SQLITE_OK && sqlite3_step(row) == SQLITE_ROW) {
        rows++;
        for (int i = 0; i < ENTRIES; i++)
            if (is_entry(row, &entries[i])) {
                count[i]++;
                root[i] = sqlite3_column_int(row, 3);
            }
    }
    const int end = sqlite3_finalize(row);
    found->is_empty = rows == 0;
    found->has_objects = count[0] > 0;
    found->is_right = true;
    for (int i = 0; i < BASE; i++)
        found->is_right = found->is_right && count[i] == 1;
    for (int i = BASE; i < ENTRIES; i++)
        ranks += count[i];
    found->has_ranks = ranks > 0;
    if (found->has_ranks)
        found->is_right = found->is_right && ranks == ENTRIES - BASE && root[BASE] != root[BASE + 1];
    return code == SQLITE_OK ? end : code;
}

static uint8_t first_page[PF_SPOOL_PAGE];
static bool has_first_page; /* from then on it does not change */

/* SQLite's own, of a spool in memory. */
static void make_first_page(void)
{
    static const uint8_t wal[2] = {2, 2}, as_the_file_has[4] = {0};
    sqlite3 *db = NULL;
    sqlite3_int64 n = 0;
    uint8_t *bytes = NULL;
    if (sqlite3_open(":memory:", &db) == SQLITE_OK && sqlite3_exec(db, pf_spool_create, NULL, NULL, NULL) == SQLITE_OK)
        bytes = sqlite3_serialize(db, "main", &n, 0);
    has_first_page = bytes != NULL && n > PF_SPOOL_PAGE;
    if (has_first_page) {
        memcpy(first_page, bytes, sizeof first_page);
        memcpy(first_page + 18, wal, sizeof wal);
        memcpy(first_page + 28, as_the_file_has, sizeof as_the_file_has);
    }
    sqlite3_free(bytes);
    (void)sqlite3_close(db);
}

const uint8_t *pf_spool_first_page(void)
{
    static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
    pthread_mutex_lock(&mutex);
    if (!has_first_page)
        make_first_page();
    const uint8_t *page = has_first_page ? first_page : NULL;
    pthread_mutex_unlock(&mutex);
    return page;
}
