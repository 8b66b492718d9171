/* The spool's recovery from whatever a power cut or a worn medium has left of its file and its log, and its salvage of
 * what a file that it sets aside still has. The files live in memory (memory_files.h). The input's first byte chooses
 * what lies there: a spool as kill -9 leaves it, with its log, or one that was closed; a valid header before bytes of
 * the input's own; whether the log's checksums are repaired, so that damage behind them is reached; and whether another
 * program opens it first: one that can write nothing, or one that has no
 * memory for a while after so many reads. The rest are changes and cuts. Invariants: opening succeeds, unless the file
 * says that it is another program's or a newer one's; an object that is handed out has the bytes of its name, and rows
 * ascend; what is stored in undamaged files without an error is there after opening again, and they lose nothing, also
 * by errors that pass; what cannot be written is read, and stays as it is; after any damage the next object is stored;
 * damage to pages that hold no objects, only an index of them, costs none.
 */
#include "memory_files.h"
#include "pipefish/drivers/sha256.h"
#include "pipefish/drivers/spool.h"

#include <limits.h>
#include <sqlite3.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { OBJECTS = 6, OBJECT_MAX = 6000, WALK_MAX = 64 };
enum { VICTORIOUS = 99, LAST = 100, REMAINDER = 7, MOMENTARY = 200 }; /* ids of what is stored later */
enum { DATABASE = 0, LOG = 1 };
enum { CLOSED = 1, REPAIRED = 2, RAW = 4, ANOTHER_FIRST = 8, READS_SHIFT = 4 };

static memory_file crashed[2], closed;
static struct {
    uint32_t id;
    size_t n;
    uint8_t name[32], bytes[OBJECT_MAX];
} object[OBJECTS + REMAINDER + 2]; /* all that are ever stored */
enum { KNOWN = sizeof object / sizeof object[0] };
static uint32_t known;       /* so many of them are made */
static uint64_t index_pages; /* of the closed spool: bits, page 1 is bit 0 */

/* ---- spools */

/* PF_OK, or why not. */
static pf_status open_spool(pf_spool *spool)
{
    const pf_spool_config config = {.path = SPOOL_PATH, .quota = MEMORY_FILE_MAX / 4};
    char error[512] = "";
    pf_status status = pf_spool_open(spool, &config, error, sizeof error);
    require(status == PF_OK || status == PF_ERR_FORMAT || status == PF_ERR_VERSION || status == PF_ERR_IO ||
            status == PF_ERR_SPACE);
    require((status == PF_OK) == (error[0] == '\0'));
    require((status == PF_ERR_FORMAT) == (strstr(error, ": not a spool: ") != NULL));
    require((status == PF_ERR_VERSION) == (strstr(error, ": spool of version ") != NULL));
    if (status != PF_OK)
        memory_reset();
    return status;
}

static void make_objects(void)
{
    for (uint32_t i = 0; i < KNOWN; i++) {
        const uint32_t more = i - OBJECTS;
        object[i].id = i < OBJECTS ? i : more < REMAINDER ? LAST + more : more == REMAINDER ? VICTORIOUS : MOMENTARY;
        object[i].n = 200 + 900 * (size_t)(object[i].id % OBJECTS);
        for (size_t k = 0; k < object[i].n; k++)
            object[i].bytes[k] = (uint8_t)(object[i].id * 31 + k * 7);
        require(pf_sha256(object[i].bytes, object[i].n, object[i].name) == PF_OK);
    }
    known = KNOWN;
}

/* In place of the spool's own (--wrap): a known object's bytes have its name, which costs less to see. */
pf_status __real_pf_sha256(const void *bytes, size_t n, uint8_t hash[32]);
pf_status __wrap_pf_sha256(const void *bytes, size_t n, uint8_t hash[32]);

pf_status __wrap_pf_sha256(const void *bytes, size_t n, uint8_t hash[32])
{
    for (uint32_t i = 0; i < known; i++)
        if (object[i].n == n && memcmp(object[i].bytes, bytes, n) == 0) {
            memcpy(hash, object[i].name, 32);
            return PF_OK;
        }
    return __real_pf_sha256(bytes, n, hash);
}

/* Nothing of it stays. */
static void close_spool(const pf_spool *spool)
{
    spool->ops->close(spool->self);
    memory_reset();
}

static pf_status put_over(const pf_spool *spool, uint32_t id, const pf_spool_victim *victims, uint32_t count,
                          const uint8_t **name)
{
    const pf_spool_rank rank = {id % 3, id};
    uint32_t i = 0;
    while (object[i].id != id)
        i++;
    *name = object[i].name;
    return spool->ops->exchange(spool->self, victims, count, 2, *name, object[i].bytes, object[i].n,
                                id % 2 ? &rank : NULL, "survey", &id, sizeof id);
}

static pf_status put(const pf_spool *spool, uint32_t id, const uint8_t **name)
{
    return put_over(spool, id, NULL, 0, name);
}

/* Of a known object by its bytes, which is quicker than by their hash, and does not trust the spool's. */
static bool is_right(const uint8_t name[32], const uint8_t *bytes, size_t n)
{
    uint8_t hash[32];
    for (uint32_t i = 0; i < KNOWN; i++)
        if (memcmp(object[i].name, name, 32) == 0)
            return n == object[i].n && memcmp(object[i].bytes, bytes, n) == 0;
    return pf_sha256(bytes, n, hash) == PF_OK && memcmp(hash, name, 32) == 0;
}

/* How many objects come out, each checked; whether `name` is among them, if it is not NULL. */
static uint32_t walk(const pf_spool *spool, const uint8_t *name, bool *is_there)
{
    static uint8_t bytes[OBJECT_MAX];
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
        require(n <= sizeof bytes && is_right(item.name, bytes, n));
        intact++;
        *is_there = *is_there || (name != NULL && memcmp(item.name, name, 32) == 0);
    }
    return intact;
}

static void find_indices(void)
{
    sqlite3 *db = NULL;
    sqlite3_stmt *q = NULL;
    require(sqlite3_open_v2(SPOOL_PATH, &db, SQLITE_OPEN_READWRITE, NULL) == SQLITE_OK);
    require(sqlite3_prepare_v2(db, "SELECT rootpage FROM sqlite_schema WHERE type = 'index'", -1, &q, NULL) ==
            SQLITE_OK);
    while (sqlite3_step(q) == SQLITE_ROW)
        index_pages |= UINT64_C(1) << (sqlite3_column_int(q, 0) - 1);
    sqlite3_finalize(q);
    require(sqlite3_close(db) == SQLITE_OK && index_pages != 0);
}

static void begin(void)
{
    pf_spool spool;
    const uint8_t *name;
    memory_begin();
    make_objects();
    require(open_spool(&spool) == PF_OK);
    for (uint32_t id = 0; id < OBJECTS; id++)
        require(put(&spool, id, &name) == PF_OK);
    require(spool.ops->remove(spool.self, 1) == PF_OK);
    require(strcmp(medium.file[DATABASE].name, SPOOL_PATH) == 0 &&
            strcmp(medium.file[LOG].name, SPOOL_PATH "-wal") == 0);
    crashed[DATABASE] = medium.file[DATABASE];
    crashed[LOG] = medium.file[LOG];
    spool.ops->close(spool.self);
    closed = medium.file[DATABASE];
    find_indices();
    memory_keep();
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
static void repair_log(memory_file *log)
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
        memory_file *i = &medium.file[data[0] & 1];
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

static void copy_file(memory_file *to, const memory_file *from)
{
    memcpy(to->bytes, from->bytes, from->n);
    to->n = from->n;
    to->is_there = from->is_there;
}

static void lay(const memory_file *from, const char *name)
{
    memory_file *i = memory_make(name);
    require(i != NULL);
    copy_file(i, from);
}

/* A program that can write nothing: it hands out what is there, takes nothing, and leaves everything as it is. */
static void read_only(bool is_whole)
{
    static memory_file before[2];
    pf_spool spool;
    const uint8_t *name = NULL;
    bool is_there;
    for (int i = 0; i < 2; i++)
        copy_file(&before[i], &medium.file[i]);
    medium.is_read_only = true;
    if (open_spool(&spool) == PF_OK) {
        uint32_t intact = walk(&spool, name, &is_there);
        require(!is_whole || intact == OBJECTS - 1);
        require(put(&spool, LAST, &name) != PF_OK && spool.ops->remove(spool.self, 2) != PF_OK);
        require(spool.ops->keep_all(spool.self) != PF_OK && spool.ops->error(spool.self)[0] != '\0');
        close_spool(&spool);
    } else {
        require(!is_whole);
    }
    medium.is_read_only = false;
    for (int i = 0; i < MEMORY_FILES; i++)
        require(medium.file[i].is_there == (i < 2 && before[i].is_there));
    for (int i = 0; i < 2; i++)
        require(before[i].n == medium.file[i].n && memcmp(before[i].bytes, medium.file[i].bytes, before[i].n) == 0);
}

/* A program that has no memory after so many reads, for a moment. */
static void fail_for_a_moment(int reads)
{
    pf_spool spool;
    const uint8_t *name = NULL;
    bool is_there;
    medium.reads_left = reads;
    if (open_spool(&spool) == PF_OK) {
        (void)walk(&spool, name, &is_there);
        (void)put(&spool, MOMENTARY, &name);
        close_spool(&spool);
    }
    medium.reads_left = INT_MAX;
    medium.was_full = false;
}

/* A log that says that the spool has as many pages as SQLite ever gives one: "full", without a write. */
static bool says_full(const memory_file *log)
{
    const size_t frame = 24 + 4096;
    for (size_t at = 32; log->is_there && at + frame <= log->n; at += frame)
        if (get_be(log->bytes + at + 4) >= 1073741823)
            return true;
    return false;
}

typedef struct laid {
    bool is_whole, is_spared; /* undamaged; undamaged where objects are */
    bool says_spool;          /* and of which version, in the one place where that is said */
    bool says_full;           /* by a log whose checksums are right */
} laid;

static laid lay_all(const uint8_t *data, size_t size)
{
    laid what;
    const uint8_t how = data[0];
    uint64_t pages = 0;
    for (uint32_t i = 0; i < MEMORY_FILES; i++)
        memory_forget(&medium.file[i]);
    medium.was_full = false;
    lay(how & CLOSED ? &closed : &crashed[DATABASE], SPOOL_PATH);
    if (!(how & CLOSED))
        lay(&crashed[LOG], SPOOL_PATH "-wal");
    if (how & RAW) {
        size_t length = size - 1 < MEMORY_FILE_MAX - 100 ? size - 1 : MEMORY_FILE_MAX - 100;
        memcpy(medium.file[DATABASE].bytes + 100, data + 1, length);
        what.is_whole = length == 0;
    } else {
        what.is_whole = !damage(data + 1, size - 1, &pages);
    }
    if (how & REPAIRED && medium.file[LOG].is_there)
        repair_log(&medium.file[LOG]);
    what.says_full = how & REPAIRED && says_full(&medium.file[LOG]);
    what.is_spared = what.is_whole || (how & CLOSED && pages != 0 && (pages & ~index_pages) == 0);
    what.says_spool = what.is_whole || (how & CLOSED && medium.file[DATABASE].n >= 72 &&
                                        memcmp(medium.file[DATABASE].bytes + 60, closed.bytes + 60, 12) == 0);
    return what;
}

/* A log that is right by its checksums, and says that the spool is larger than the medium, or than any can be: no
 * damage leaves such a one. */
static bool is_full(uint8_t how, laid what, pf_status status)
{
    return status == PF_ERR_SPACE && (medium.was_full || what.says_full) && how & REPAIRED && !(how & CLOSED);
}

/* A program that does everything, and what another one finds then. */
static void use(const uint8_t *data, size_t size, laid what)
{
    pf_spool spool;
    pf_spool_victim victims[PF_SPOOL_VICTIMS_MAX];
    const uint8_t how = data[0], *name = NULL;
    uint8_t value[64];
    uint32_t count, left = OBJECTS - 2; /* at least: row 1 was removed, and row 2 will be */
    size_t n;
    bool is_there;
    pf_status status = open_spool(&spool);
    if (status != PF_OK) { /* it says that it is another program's, or a newer one's */
        require((!what.says_spool && (status == PF_ERR_FORMAT || status == PF_ERR_VERSION)) ||
                is_full(how, what, status));
        return;
    }
    uint32_t intact = walk(&spool, name, &is_there);
    require(!what.is_whole || intact >= OBJECTS - 1);
    (void)spool.ops->get(spool.self, "survey", value, sizeof value, &n);
    (void)spool.ops->set(spool.self, "other", data, size < 40 ? size : 40);
    if (spool.ops->victims(spool.self, 0, 9, 1000, victims, &count) == PF_OK && how & CLOSED)
        left += (put_over(&spool, VICTORIOUS, victims, count, &name) == PF_OK) - count;
    else
        (void)spool.ops->keep_all(spool.self);
    (void)spool.ops->remove(spool.self, 2);
    status = put(&spool, LAST + how % REMAINDER, &name);
    require(!what.is_whole || status == PF_OK);
    if (status != PF_OK) /* damage that was found in storing; the next survey is stored */
        status = put(&spool, LAST + how % REMAINDER, &name);
    require(status == PF_OK || status == PF_ERR_SPACE);
    close_spool(&spool);
    left += status == PF_OK;
    status = open_spool(&spool);
    require(status == PF_OK || is_full(how, what, status));
    if (status != PF_OK)
        return;
    intact = walk(&spool, name, &is_there);
    require(!what.is_spared || (is_there && intact >= left));
    close_spool(&spool);
}

static void try_files(const uint8_t *data, size_t size)
{
    const int reads = data[0] >> READS_SHIFT;
    const laid what = lay_all(data, size);
    if (data[0] & ANOTHER_FIRST && reads == 0) {
        read_only(what.is_whole); /* and nothing has changed: to go on from there is another input */
        return;
    }
    if (data[0] & ANOTHER_FIRST)
        fail_for_a_moment(4 * reads);
    use(data, size, what);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (!closed.is_there)
        begin();
    if (size >= 1)
        try_files(data, size);
    return 0;
}
