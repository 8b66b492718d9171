/* A folder of its own for each test program that needs files; removed at its end. */
#ifndef PIPEFISH_TESTS_TEMPORARY_H
#define PIPEFISH_TESTS_TEMPORARY_H

#include <ftw.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static char temporary_root[256];

static inline void temporary_make(void)
{
    const char *base = getenv("TMPDIR");
    int n = snprintf(temporary_root, sizeof temporary_root, "%s/pipefish-test-XXXXXX", base != NULL ? base : "/tmp");
    if (n < 0 || (size_t)n >= sizeof temporary_root || mkdtemp(temporary_root) == NULL) {
        perror("temporary folder");
        exit(1);
    }
}

static inline int temporary_remove_one(const char *path, const struct stat *info, int kind, struct FTW *at)
{
    (void)info;
    (void)kind;
    (void)at;
    return remove(path);
}

static inline void temporary_remove(void)
{
    (void)nftw(temporary_root, temporary_remove_one, 8, FTW_DEPTH | FTW_PHYS);
}

/* Path of `name` in the folder; good until the eighth call after this one. */
static inline const char *temporary_path(const char *name)
{
    static char paths[8][512];
    static unsigned next;
    char *path = paths[next++ % 8];
    (void)snprintf(path, sizeof paths[0], "%s/%s", temporary_root, name);
    return path;
}

static inline const char *temporary_write(const char *name, const void *bytes, size_t n)
{
    const char *path = temporary_path(name);
    FILE *f = fopen(path, "wb");
    if (f == NULL || (n > 0 && fwrite(bytes, 1, n, f) != n) || fclose(f) != 0) {
        perror(path);
        exit(1);
    }
    return path;
}

static inline const char *temporary_text(const char *name, const char *text)
{
    return temporary_write(name, text, strlen(text));
}

/* SplitMix64: the same garbage on every machine. */
static inline uint64_t temporary_random(uint64_t *state)
{
    uint64_t z = *state += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

#endif
