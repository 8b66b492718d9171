/* The medium under a spool, and a spool on one that cannot be written now. */
#ifndef PIPEFISH_SPOOL_READONLY_H
#define PIPEFISH_SPOOL_READONLY_H

#include <sqlite3.h>
#include <stdbool.h>
#include <sys/statvfs.h>

/* Whether the file, or the folder for what SQLite puts beside it, may not be written. errno says why: EROFS, EACCES or
 * EPERM. A folder that is not there is another matter: false. */
bool pf_spool_is_read_only(const char *path);

/* The disk that has the file, or will have it. False: it cannot be told. */
bool pf_spool_look_at_disk(const char *path, struct statvfs *disk);

/* Opens the file as it lies there, what its log holds included; nothing is written and no lock is taken, so nobody else
 * may be writing. Returns SQLite's code; *db is to be closed in any case. */
int pf_spool_open_read_only(const char *path, sqlite3 **db);

#endif
