/* What the first page of every spool says: whose file it is, and which tables lie where. */
#ifndef PIPEFISH_SPOOL_SCHEMA_H
#define PIPEFISH_SPOOL_SCHEMA_H

#include <sqlite3.h>
#include <stdbool.h>
#include <stdint.h>

#define PF_SPOOL_APPLICATION_ID 0x50465350 /* "PFSP" */
#define PF_SPOOL_VERSION        1

enum { PF_SPOOL_PAGE = 4096 };

/* What an empty file gets, and what programs of earlier days have not made in theirs. A transaction each. */
extern const char pf_spool_create[], pf_spool_add_ranks[];

typedef struct pf_spool_schema {
    bool is_empty;
    bool has_objects; /* as no other program's file has them */
    bool has_ranks;
    bool is_right; /* all is there and lies where it must; a later program's tables may be beside it */
} pf_spool_schema;

/* Returns SQLite's code. */
int pf_spool_read_schema(sqlite3 *db, pf_spool_schema *found);

/* The first page of a spool that is only read: without ranks, and with as many pages as the file has. NULL: no memory.
 */
const uint8_t *pf_spool_first_page(void);

#endif
