#include "spool/schema.h"

#include <pthread.h>
#include <stdio.h>
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

const char pf_spool_layout[] = "PRAGMA page_size = 4096;PRAGMA auto_vacuum = NONE;";
const char pf_spool_create[] =
    "BEGIN IMMEDIATE;" OBJECT ";" VALUE ";"
    "PRAGMA application_id = " TEXT(PF_SPOOL_APPLICATION_ID) ";"
                                                             "PRAGMA user_version = " TEXT(PF_SPOOL_VERSION) ";COMMIT;";
const char pf_spool_add_ranks[] = "BEGIN IMMEDIATE;CREATE TABLE IF NOT EXISTS " RANKS
                                  ";CREATE INDEX IF NOT EXISTS " ORDER ";CREATE TRIGGER IF NOT EXISTS " GONE ";"
                                  "DELETE FROM evictable WHERE row NOT IN (SELECT row FROM object);COMMIT;";

/* Rows are counted through the table and through its index: neither root is another's page, nor one of a part. */
const char pf_spool_check_tables[] =
    "SELECT (SELECT count(*) FROM object NOT INDEXED WHERE typeof(kind) = 'integer' AND typeof(name) = 'blob')"
    " = (SELECT count(*) FROM object INDEXED BY sqlite_autoindex_object_1 WHERE name >= x'')"
    " AND (SELECT coalesce(max(row), 0) FROM object)"
    " <= (SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = 'object')"
    " AND NOT EXISTS (SELECT 1 FROM value WHERE typeof(key) <> 'text' OR typeof(bytes) <> 'blob')";
const char pf_spool_check_ranks[] = "SELECT NOT EXISTS (SELECT 1 FROM evictable NOT INDEXED "
                                    "WHERE typeof(importance) <> 'integer' OR typeof(number) <> 'integer')";
const char pf_spool_check_order[] =
    "SELECT (SELECT count(*) FROM evictable NOT INDEXED WHERE importance >= 0)"
    " = (SELECT count(*) FROM evictable INDEXED BY evictable_order WHERE importance >= 0)";

enum { BASE = 4, ENTRIES = 7 };

/* As SQLite writes them into an empty file, the roots in order; where a spool was dumped and loaded again, or got its
 * ranks later, they lie elsewhere. */
static const struct entry {
    const char *type, *name, *table;
    int root;
    const char *sql;
} entries[ENTRIES] = {
    {"table", "object", "object", 2, OBJECT},
    {"index", "sqlite_autoindex_object_1", "object", 3, NULL},
    {"table", "sqlite_sequence", "sqlite_sequence", 4, "CREATE TABLE sqlite_sequence(name,seq)"},
    {"table", "value", "value", 5, VALUE},
    {"table", "evictable", "evictable", 6, "CREATE TABLE " RANKS},
    {"index", "evictable_order", "evictable", 7, "CREATE INDEX " ORDER},
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
           is_text(row, 4, e->sql) && (e->root == 0 ? root == 0 : root > 1);
}

/* It was one, before it was damaged. */
static bool resembles_entry(sqlite3_stmt *row, const struct entry *e)
{
    return is_text(row, 1, e->name) || (e->sql != NULL && is_text(row, 4, e->sql));
}

static void judge(pf_spool_schema *found, const int count[ENTRIES], const int root[ENTRIES])
{
    found->has_objects = count[0] > 0;
    found->has_values = count[3] > 0;
    found->has_rank_rows = count[BASE] > 0;
    found->has_ranks = found->is_in_place = found->ranks_are_in_place = true;
    for (int i = 0; i < ENTRIES; i++) {
        const bool is_in_place = count[i] == 0 || root[i] == entries[i].root;
        if (i < BASE) {
            found->is_right = found->is_right && count[i] == 1;
            found->is_in_place = found->is_in_place && is_in_place;
        } else {
            found->is_right = found->is_right && count[i] <= 1;
            found->has_ranks = found->has_ranks && count[i] == 1;
            found->ranks_are_in_place = found->ranks_are_in_place && is_in_place;
        }
        for (int k = 0; k < i; k++)
            found->is_right = found->is_right && (root[i] == 0 || root[i] != root[k]);
    }
    found->is_in_place = found->is_in_place && found->is_right;
}

int pf_spool_read_schema(sqlite3 *db, pf_spool_schema *found)
{
    sqlite3_stmt *row = NULL;
    int count[ENTRIES] = {0}, root[ENTRIES] = {0};
    int code = sqlite3_prepare_v2(db, "SELECT type, name, tbl_name, rootpage, sql FROM sqlite_schema", -1, &row, NULL);
    *found = (pf_spool_schema){.is_empty = true, .is_right = true};
    while (code == SQLITE_OK && sqlite3_step(row) == SQLITE_ROW) {
        found->is_empty = false;
        for (int i = 0; i < ENTRIES; i++)
            if (is_entry(row, &entries[i])) {
                count[i]++;
                root[i] = sqlite3_column_int(row, 3);
            } else if (resembles_entry(row, &entries[i])) {
                found->is_right = false;
            }
    }
    const int end = sqlite3_finalize(row);
    judge(found, count, root);
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
    if (sqlite3_open(":memory:", &db) == SQLITE_OK &&
        sqlite3_exec(db, pf_spool_layout, NULL, NULL, NULL) == SQLITE_OK &&
        sqlite3_exec(db, pf_spool_create, NULL, NULL, NULL) == SQLITE_OK)
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

/* ---- the bytes themselves */

static uint32_t get_be(const uint8_t *b)
{
    return (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3];
}

/* The newest of a page in the file's log; frames from before the log's last beginning have other salts. */
static bool read_from_log(const char *path, uint32_t number, uint8_t page[PF_SPOOL_PAGE])
{
    char name[1100];
    uint8_t header[32], frame[24];
    bool is_there = false;
    (void)snprintf(name, sizeof name, "%s-wal", path);
    FILE *f = fopen(name, "rb");
    if (f == NULL)
        return false;
    if (fread(header, 1, sizeof header, f) == sizeof header && get_be(header + 8) == PF_SPOOL_PAGE)
        for (long at = sizeof header; fseek(f, at, SEEK_SET) == 0 && fread(frame, 1, sizeof frame, f) == sizeof frame &&
                                      memcmp(frame + 8, header + 16, 8) == 0;
             at += (long)sizeof frame + PF_SPOOL_PAGE)
            if (get_be(frame) == number)
                is_there = fread(page, 1, PF_SPOOL_PAGE, f) == PF_SPOOL_PAGE || is_there;
    (void)fclose(f);
    return is_there;
}

static bool read_from_file(const char *path, uint32_t number, uint8_t page[PF_SPOOL_PAGE])
{
    FILE *f = fopen(path, "rb");
    memset(page, 0, PF_SPOOL_PAGE);
    if (f == NULL)
        return false;
    const bool ok = fseek(f, (long)(number - 1) * PF_SPOOL_PAGE, SEEK_SET) == 0 && fread(page, 1, PF_SPOOL_PAGE, f) > 0;
    (void)fclose(f);
    return ok;
}

static bool read_page(const char *path, uint32_t number, uint8_t page[PF_SPOOL_PAGE])
{
    return read_from_log(path, number, page) || read_from_file(path, number, page);
}

uint32_t pf_spool_version_of(const char *path)
{
    uint8_t page[PF_SPOOL_PAGE];
    return read_page(path, 1, page) && get_be(page + 68) == PF_SPOOL_APPLICATION_ID ? get_be(page + 60) : 0;
}

static bool is_spools(const uint8_t page[PF_SPOOL_PAGE])
{
    static const char mark[] = "CREATE TABLE object (row INTEGER PRIMARY KEY AUTOINCREMENT";
    return get_be(page + 68) == PF_SPOOL_APPLICATION_ID || memmem(page, PF_SPOOL_PAGE, mark, sizeof mark - 1) != NULL;
}

static bool says_nothing(const uint8_t page[PF_SPOOL_PAGE])
{
    return (page[0] == 0x00 || page[0] == 0xFF) && memcmp(page, page + 1, PF_SPOOL_PAGE - 1) == 0;
}

/* How many of the pages after the first are what they are in a spool; *names_objects: also the name of its one table
 * with rows that ascend is there, in the last bytes of a page. */
static int count_right_pages(const char *path, bool *names_objects)
{
    static const uint8_t kinds[4][2] = {{5, 13}, {2, 10}, {13, 13}, {2, 10}};
    static const char name[] = "object";
    uint8_t page[PF_SPOOL_PAGE];
    int right = 0;
    *names_objects = false;
    for (uint32_t i = 0; i < 4; i++)
        if (read_page(path, 2 + i, page)) {
            right += page[0] == kinds[i][0] || page[0] == kinds[i][1];
            if (i == 2)
                *names_objects = memmem(page + sizeof page - 20, 20, name, sizeof name - 1) != NULL;
        }
    return right;
}

bool pf_spool_was_one(const char *path)
{
    uint8_t page[PF_SPOOL_PAGE];
    bool names_objects;
    if (read_from_log(path, 1, page) && is_spools(page))
        return true;
    if (!read_from_file(path, 1, page))
        return false;
    return is_spools(page) || says_nothing(page) || (count_right_pages(path, &names_objects) == 4 && names_objects);
}

bool pf_spool_takes_first_page(const char *path)
{
    static const char magic[] = "SQLite format 3";
    uint8_t page[PF_SPOOL_PAGE];
    bool names_objects;
    if (!read_page(path, 1, page))
        return false;
    const uint32_t size = (uint32_t)page[16] << 8 | page[17]; /* 1: 65536 */
    const bool says_size = memcmp(page, magic, sizeof magic) == 0 && (size & (size - 1)) == 0 && size != 0;
    const int right = count_right_pages(path, &names_objects);
    return !says_size || size == PF_SPOOL_PAGE ? right >= 3 : right == 4 && names_objects;
}

bool pf_spool_has_first_header(const char *path)
{
    static const struct {
        uint8_t at, n;
    } parts[] = {{0, 18}, {20, 4}, {44, 4}, {52, 8}}; /* name and size of page; usable size; format; vacuum, text */
    const uint8_t *usual = pf_spool_first_page();
    uint8_t page[PF_SPOOL_PAGE];
    bool is_usual = usual != NULL && read_page(path, 1, page);
    for (size_t i = 0; i < sizeof parts / sizeof parts[0]; i++)
        is_usual = is_usual && memcmp(page + parts[i].at, usual + parts[i].at, parts[i].n) == 0;
    return is_usual;
}
