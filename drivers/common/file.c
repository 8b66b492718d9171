#include "pipefish/drivers/file.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#define PATH_BYTES 4096

static bool write_all(int fd, const char *bytes, size_t n)
{
    while (n > 0) {
        ssize_t k = write(fd, bytes, n);
        if (k < 0 && errno != EINTR)
            return false;
        if (k > 0) {
            bytes += k;
            n -= (size_t)k;
        }
    }
    return true;
}

bool pf_file_sync_folder(const char *path)
{
    char folder[PATH_BYTES] = ".";
    const char *slash = strrchr(path, '/');
    if (slash != NULL &&
        snprintf(folder, sizeof folder, "%.*s", slash == path ? 1 : (int)(slash - path), path) >= (int)sizeof folder) {
        errno = ENAMETOOLONG;
        return false;
    }
    int fd = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    bool ok = fd >= 0 && fsync(fd) == 0;
    if (fd >= 0)
        (void)close(fd);
    return ok;
}

pf_status pf_file_replace(const char *path, const void *bytes, size_t size, char *error, size_t n)
{
    char draft[PATH_BYTES];
    if ((size_t)snprintf(draft, sizeof draft, "%s.new", path) >= sizeof draft) {
        (void)snprintf(error, n, "%.64s...: path too long", path);
        return PF_ERR_IO;
    }
    (void)unlink(draft); /* what a power cut left; it may have another mode */
    int fd = open(draft, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    bool ok = fd >= 0 && write_all(fd, bytes, size) && fsync(fd) == 0;
    int why = errno;
    if (fd >= 0 && close(fd) != 0 && ok) {
        ok = false;
        why = errno;
    }
    if (ok && rename(draft, path) != 0) {
        ok = false;
        why = errno;
    }
    if (!ok) {
        (void)unlink(draft);
    } else if (!pf_file_sync_folder(path)) {
        ok = false;
        why = errno;
    }
    if (!ok)
        (void)snprintf(error, n, "%s: %s", path, strerror(why));
    return ok ? PF_OK : PF_ERR_IO;
}
