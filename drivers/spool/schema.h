/* What the first page of every spool says: whose file it is, and which tables lie where. */
#ifndef PIPEFISH_SPOOL_SCHEMA_H
#define PIPEFISH_SPOOL_SCHEMA_H

#include <sqlite3.h>
#include <stdbool.h>
#include <stdint.h>

#define PF_SPOOL_APPLICATION_ID 0x50465350 /* "PFSP" */
#define PF_SPOOL_VERSION        1

enum { PF_SPOOL_PAGE = 4096 };

/* Before an empty file's first page is made; its tables; what programs of earlier days have not made in theirs, or not
 * all of: a power cut came between. The latter two are a transaction each. */
extern const char pf_spool_layout[], pf_spool_create[], pf_spool_add_ranks[];

/* Queries: 1 where the tables of a spool, the rows and the index of its ranks hold what such tables do. */
extern const char pf_spool_check_tables[], pf_spool_check_ranks[], pf_spool_check_order[];

typedef struct pf_spool_schema {
    bool is_empty;
    bool is_right;    /* the tables are there, wherever they lie; ranks may be missing, others' tables beside them */
    bool is_in_place; /* they lie where they do in every spool that this program has made */
    bool has_objects; /* as no other program's file has them */
    bool has_values;
    bool has_rank_rows, has_ranks, ranks_are_in_place; /* has_ranks: all that belongs to them */
} pf_spool_schema;

/* Returns SQLite's code. */
int pf_spool_read_schema(sqlite3 *db, pf_spool_schema *found);

/* The first page of a spool that is only read: without ranks, and with as many pages as the file has. NULL: no memory.
 */
const uint8_t *pf_spool_first_page(void);

/* What the bytes of a file and of its log say, whatever SQLite thinks of them. */

/* The version of which a spool says to be; 0: it does not say to be a spool. */
uint32_t pf_spool_version_of(const char *path);

/* Whether a file that SQLite does not take was a spool: its first page says so, or says nothing at all (all zeros, or
 * all ones: lost by the flash), or the pages after it are a spool's. Another program's file is left alone. */
bool pf_spool_was_one(const char *path);

/* Whether its tables lie where pf_spool_first_page() says: three of the four pages that are to be tables' or indices'
 * are; where its header says that its pages are of another size, all four, and the name in one of them. */
bool pf_spool_takes_first_page(const char *path);

/* Whether its header is that of pf_spool_first_page(), but for its counts. */
bool pf_spool_has_first_header(const char *path);

#endif
