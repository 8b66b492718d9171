#include "pipefish/drivers/flash_file.h"

#include "common/failure.h"

#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#define SIZE (PF_FLASH_FILE_SECTORS * PF_FLASH_FILE_ERASE_SIZE)

typedef struct flash_file {
    int fd;
} flash_file;

static bool read_all(int fd, uint8_t *bytes, size_t n, off_t at)
{
    while (n > 0) {
        ssize_t done = pread(fd, bytes, n, at);
        if (done < 0 && errno == EINTR)
            continue;
        if (done <= 0)
            return false;
        bytes += done;
        at += done;
        n -= (size_t)done;
    }
    return true;
}

static bool write_all(int fd, const uint8_t *bytes, size_t n, off_t at)
{
    while (n > 0) {
        ssize_t done = pwrite(fd, bytes, n, at);
        if (done < 0 && errno == EINTR)
            continue;
        if (done <= 0)
            return false;
        bytes += done;
        at += done;
        n -= (size_t)done;
    }
    return true;
}

static pf_status file_read(void *self, uint32_t at, void *bytes, uint32_t n)
{
    flash_file *f = self;
    return read_all(f->fd, bytes, n, (off_t)at) ? PF_OK : PF_ERR_IO;
}

static pf_status file_program(void *self, uint32_t at, const void *bytes, uint32_t n)
{
    flash_file *f = self;
    if (at % PF_FLASH_FILE_PROGRAM_SIZE != 0 || n % PF_FLASH_FILE_PROGRAM_SIZE != 0 || at > SIZE || n > SIZE - at)
        return PF_ERR_IO;
    return write_all(f->fd, bytes, n, (off_t)at) ? PF_OK : PF_ERR_IO;
}

static bool write_erased(int fd, off_t at, size_t n)
{
    uint8_t page[PF_FLASH_FILE_PROGRAM_SIZE];
    memset(page, 0xFF, sizeof page);
    for (size_t done = 0; done < n; done += sizeof page)
        if (!write_all(fd, page, sizeof page, at + (off_t)done))
            return false;
    return true;
}

static pf_status file_erase(void *self, uint32_t sector)
{
    flash_file *f = self;
    if (sector >= PF_FLASH_FILE_SECTORS)
        return PF_ERR_IO;
    return write_erased(f->fd, (off_t)sector * PF_FLASH_FILE_ERASE_SIZE, PF_FLASH_FILE_ERASE_SIZE) ? PF_OK : PF_ERR_IO;
}

static pf_status file_flush(void *self)
{
    flash_file *f = self;
    return fdatasync(f->fd) == 0 ? PF_OK : PF_ERR_IO;
}

/* The folder too: without it a power cut may take the name away again. */
static bool sync_folder(const char *path)
{
    char copy[PATH_MAX];
    (void)snprintf(copy, sizeof copy, "%s", path);
    int fd = open(dirname(copy), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd < 0)
        return false;
    bool ok = fsync(fd) == 0;
    return close(fd) == 0 && ok;
}

/* The file appears whole, whatever happens: link does not replace one that somebody else has made meanwhile. */
static bool make_file(const char *path)
{
    char draft[PATH_MAX];
    if (snprintf(draft, sizeof draft, "%s.%ld.new", path, (long)getpid()) >= (int)sizeof draft) {
        errno = ENAMETOOLONG;
        return false;
    }
    int fd = open(draft, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    if (fd < 0)
        return false;
    bool ok = write_erased(fd, 0, SIZE) && fsync(fd) == 0;
    ok = close(fd) == 0 && ok;
    ok = ok && (link(draft, path) == 0 || errno == EEXIST);
    int kept = errno;
    (void)unlink(draft);
    errno = kept;
    return ok && sync_folder(path);
}

pf_status pf_flash_file_open(pf_flash *flash, const pf_flash_file_config *config, char *error, size_t n)
{
    static const pf_flash_ops ops = {file_read, file_program, file_erase, file_flush};
    pf_failure failure = {""};
    struct stat info;
    int flags = config->is_read_only ? O_RDONLY : O_RDWR;
    int fd = open(config->path, flags | O_CLOEXEC);
    const bool is_to_be_made = fd < 0 && errno == ENOENT;
    if (is_to_be_made && config->is_read_only)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_END, "%s: not there", config->path), error, n);
    if (is_to_be_made && make_file(config->path))
        fd = open(config->path, flags | O_CLOEXEC);
    pf_status status = PF_OK;
    if (fd < 0 && is_to_be_made && (errno == ENOSPC || errno == EDQUOT || errno == EROFS))
        status = pf_fail(&failure, PF_ERR_SPACE, "%s: %s", config->path, strerror(errno));
    else if (fd < 0 || fstat(fd, &info) != 0)
        status = pf_fail(&failure, PF_ERR_IO, "%s: %s", config->path, strerror(errno));
    else if (!S_ISREG(info.st_mode) || info.st_size != SIZE)
        status =
            pf_fail(&failure, PF_ERR_FORMAT, "%s: not a profile store (not a file of %u bytes)", config->path, SIZE);
    else if (!config->is_read_only && flock(fd, LOCK_EX | LOCK_NB) != 0)
        status = pf_fail(&failure, PF_ERR_AGAIN, "%s: another process has it open", config->path);
    flash_file *f = status == PF_OK ? malloc(sizeof *f) : NULL;
    if (status == PF_OK && f == NULL)
        status = pf_fail(&failure, PF_ERR_IO, "%s: no memory", config->path);
    if (status != PF_OK) {
        if (fd >= 0)
            (void)close(fd);
        return pf_failure_copy(&failure, status, error, n);
    }
    f->fd = fd;
    *flash = (pf_flash){f, &ops, PF_FLASH_FILE_ERASE_SIZE, PF_FLASH_FILE_PROGRAM_SIZE, PF_FLASH_FILE_SECTORS};
    return PF_OK;
}

void pf_flash_file_close(pf_flash *flash)
{
    flash_file *f = flash->self;
    (void)close(f->fd);
    free(f);
    flash->self = NULL;
}
