/* The spool's files in memory: a file system and a heap of SQLite's own kind, and what the spool asks of the system's
 * files by name (the linker gives those calls to this: --wrap, see CMakeLists.txt). An input costs no disk, and what
 * was allocated for a spool is looked for when it has been closed. */
#ifndef PIPEFISH_FUZZ_MEMORY_FILES_H
#define PIPEFISH_FUZZ_MEMORY_FILES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define SPOOL_PATH "/spool.db" /* files whose names begin so are here, all others the system's */

enum { MEMORY_FILES = 10, MEMORY_FILE_MAX = 1 << 19, MEMORY_NAME_MAX = 48 };

typedef struct memory_file {
    uint8_t bytes[MEMORY_FILE_MAX];
    size_t n;
    bool is_there;
    char name[MEMORY_NAME_MAX]; /* "": a temporary one, which goes when it is closed */
} memory_file;

typedef struct memory_medium {
    memory_file file[MEMORY_FILES];
    bool is_read_only;
    bool was_full;  /* a write was refused for that */
    int reads_left; /* then they fail, and memory is no longer given either; INT_MAX: not */
} memory_medium;

extern memory_medium medium;

void require(bool holds); /* or abort() */

void memory_begin(void); /* once, before SQLite is used */
void memory_keep(void);  /* what is allocated now stays */
void memory_reset(void); /* the rest must have been freed */

/* The first free one, empty; NULL: there is none. */
memory_file *memory_make(const char *name);
void memory_forget(memory_file *f);

#endif
