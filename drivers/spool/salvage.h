/* A spool's file that has become unreadable: it is set aside, and what can be read of it goes into a new one. Until all
 * of it is there the file is called <path>.damaged-N.unread, so that a kill, a full disk, a missing descriptor or
 * a new file that cannot be opened ends nothing: the next opening goes on. It is read through its own first page; where
 * that says other than every spool's, or a page could not be read, its log is taken into it, the first page of every
 * spool takes the place of its own, if its pages are of that size, and it is read once more, for what is still missing.
 * A card too full for that is "not now" as well. */
#ifndef PIPEFISH_SPOOL_SALVAGE_H
#define PIPEFISH_SPOOL_SALVAGE_H

#include "common/failure.h"

#include <sqlite3.h>

/* What SQLITE_NOMEM says of a file: true: its bytes are bad, for there is memory for any object; false: there is none
 * now. SQLite says so too of a row whose length is damaged: none such can be had, or its count of pages wraps to 0. */
bool pf_spool_has_memory(void);

/* Gives the file, and the log beside it, the name <path>.damaged-1.unread, or that with the first free number above
 * those that are still called so. PF_OK, PF_ERR_IO. */
pf_status pf_spool_set_aside(const char *path, pf_failure *failure);

/* Where a kill came between the two names: the log of a file that is no longer there follows the newest unread one. To
 * be called before SQLite opens `path`, which would throw that log away. */
void pf_spool_finish_setting_aside(const char *path);

/* Copies from every file of `path` that is still called so, the newest first: each object that is whole by its SHA-256,
 * under its row number, and, once, every value that is not there yet; 64 objects a transaction, alive() before each
 * object. Objects that cannot be reached from either end of the damaged table are lost. Returns how many files there
 * were; *told says what came of the last.
 */
uint32_t pf_spool_salvage(sqlite3 *to, const char *path, void (*alive)(void), pf_failure *told);

#endif
