/* A medium under the spool that refuses writes when told to, and small objects for it. */
#ifndef PIPEFISH_TESTS_SPOOL_MEDIUM_H
#define PIPEFISH_TESTS_SPOOL_MEDIUM_H

#include "spool_objects.h"

#include <errno.h>
#include <fcntl.h>
#include <sqlite3.h>

/* SQLite's own way to put other system calls in place. */
static int refuse_with;         /* errno of every write; 0 = none fails */
static uint64_t allowed;        /* writes before that */
static uint64_t refused_writes; /* writes so far */

static inline bool refuses(void)
{
    if (refuse_with == 0 || (allowed > 0 && allowed--))
        return false;
    refused_writes++;
    errno = refuse_with;
    return true;
}

static inline ssize_t write_or_not(int fd, const void *bytes, size_t n)
{
    return refuses() ? -1 : write(fd, bytes, n);
}

static inline ssize_t pwrite_or_not(int fd, const void *bytes, size_t n, off_t at)
{
    return refuses() ? -1 : pwrite(fd, bytes, n, at);
}

static inline int fallocate_or_not(int fd, off_t at, off_t n)
{
    return refuses() ? errno : posix_fallocate(fd, at, n);
}

static inline int ftruncate_or_not(int fd, off_t n)
{
    return refuses() ? -1 : ftruncate(fd, n);
}

static inline void hook(const char *name, sqlite3_syscall_ptr call)
{
    sqlite3_vfs *vfs = sqlite3_vfs_find(NULL);
    (void)vfs->xSetSystemCall(vfs, name, call);
}

/* Closes the spool and takes its file away, and those that were set aside. */
static inline void forget(const char *name)
{
    char other[64];
    close_spool();
    (void)unlink(temporary_path(name));
    for (int i = 1; i < 4; i++) {
        (void)snprintf(other, sizeof other, "%s.damaged-%d", name, i);
        (void)unlink(temporary_path(other));
    }
}

/* Object `id` of 300 bytes. */
static inline pf_status put_small(uint64_t id)
{
    uint8_t bytes[300], name[32];
    memset(bytes, (int)id, sizeof bytes);
    memcpy(bytes, &id, sizeof id);
    if (pf_sha256(bytes, sizeof bytes, name) != PF_OK)
        return PF_ERR_IO;
    return spool.ops->put(spool.self, 2, name, bytes, sizeof bytes);
}

enum { MANY = 300 }; /* ids of small objects are below, or one above */

/* The ids that are there, each once. */
static inline uint64_t list_ids(bool *is_there)
{
    pf_spool_item item;
    uint64_t row = 0, n = 0, id;
    size_t size;
    memset(is_there, 0, MANY + 2);
    for (; spool.ops->next(spool.self, row, &item) == PF_OK; row = item.row, n++) {
        TEST_ASSERT_EQUAL_INT(PF_OK, spool.ops->read(spool.self, &item, read_bytes, sizeof read_bytes, &size));
        memcpy(&id, read_bytes, sizeof id);
        TEST_ASSERT_TRUE(id <= MANY + 1 && !is_there[id]);
        is_there[id] = true;
    }
    return n;
}

#endif
