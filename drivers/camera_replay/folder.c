#include "replay.h"

#include <ctype.h>
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

#define PICTURE_MAX_BYTES ((off_t)1 << 30)

/* Compares the numbers that *a and *b begin with, by value, and steps over them. */
static int compare_numbers(const char **a, const char **b)
{
    while (**a == '0')
        (*a)++;
    while (**b == '0')
        (*b)++;
    size_t n = strspn(*a, "0123456789"), m = strspn(*b, "0123456789");
    int order = n != m ? (n < m ? -1 : 1) : strncmp(*a, *b, n);
    *a += n;
    *b += m;
    return order;
}

int pf_natural_compare(const char *a, const char *b)
{
    const char *p = a, *q = b;
    while (*p != '\0' && *q != '\0') {
        if (isdigit((unsigned char)*p) && isdigit((unsigned char)*q)) {
            int order = compare_numbers(&p, &q);
            if (order != 0)
                return order;
        } else if (*p != *q) {
            return (unsigned char)*p < (unsigned char)*q ? -1 : 1;
        } else {
            p++;
            q++;
        }
    }
    if (*p != *q)
        return *p == '\0' ? -1 : 1;
    return strcmp(a, b); /* img1 and img01: any order will do, but always the same one */
}

static int compare_names(const void *a, const void *b)
{
    return pf_natural_compare(*(char *const *)a, *(char *const *)b);
}

static bool is_picture_name(const char *name)
{
    static const char *const endings[] = {".png", ".jpg", ".jpeg", ".pgm"};
    const char *dot = strrchr(name, '.');
    if (dot == NULL || name[0] == '.')
        return false;
    for (size_t i = 0; i < sizeof endings / sizeof endings[0]; i++)
        if (strcasecmp(dot, endings[i]) == 0)
            return true;
    return false;
}

/* Adds a file to the list if it is a picture's regular file, and notes the size of the largest. */
static pf_status add(pf_folder *folder, uint64_t *capacity, const char *path, const char *name, pf_failure *failure)
{
    struct stat info;
    char *full;
    if (!is_picture_name(name))
        return PF_OK;
    if (asprintf(&full, "%s/%s", path, name) < 0)
        return pf_fail(failure, PF_ERR_SPACE, "%s: no memory for its list of files", path);
    pf_status status = PF_OK;
    if (stat(full, &info) != 0)
        status = pf_fail(failure, PF_ERR_IO, "%s: %s", full, strerror(errno));
    else if (S_ISREG(info.st_mode) && info.st_size > PICTURE_MAX_BYTES)
        status = pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: larger than 1 GiB", full);
    if (status != PF_OK || !S_ISREG(info.st_mode)) {
        free(full);
        return status;
    }
    if (folder->frames == *capacity) {
        *capacity = *capacity == 0 ? 256 : 2 * *capacity;
        char **grown = realloc(folder->names, *capacity * sizeof *grown);
        if (grown == NULL) {
            free(full);
            return pf_fail(failure, PF_ERR_SPACE, "%s: no memory for its list of files", path);
        }
        folder->names = grown;
    }
    folder->names[folder->frames++] = full;
    if ((size_t)info.st_size > folder->file_size)
        folder->file_size = (size_t)info.st_size;
    return PF_OK;
}

static pf_status list(pf_folder *folder, const char *path, pf_failure *failure)
{
    uint64_t capacity = 0;
    DIR *directory = opendir(path);
    if (directory == NULL)
        return pf_fail(failure, PF_ERR_IO, "%s: %s", path, strerror(errno));
    pf_status status = PF_OK;
    while (status == PF_OK) {
        errno = 0;
        const struct dirent *entry = readdir(directory);
        if (entry == NULL) {
            if (errno != 0)
                status = pf_fail(failure, PF_ERR_IO, "%s: %s", path, strerror(errno));
            break;
        }
        status = add(folder, &capacity, path, entry->d_name, failure);
    }
    closedir(directory);
    if (status == PF_OK && folder->frames == 0)
        return pf_fail(failure, PF_ERR_FORMAT, "%s: no .png, .jpg, .jpeg or .pgm file in this folder", path);
    if (status == PF_OK)
        qsort(folder->names, folder->frames, sizeof *folder->names, compare_names);
    return status;
}

/* Reads file i into folder->file. */
static pf_status load(pf_folder *folder, uint64_t i, pf_picture *picture, pf_failure *failure)
{
    const char *name = folder->names[i];
    int fd = open(name, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
    size_t done = 0;
    pf_status status = PF_OK;
    for (;;) { /* one byte more than the largest file had: a file that has grown shows */
        ssize_t k = read(fd, folder->file + done, folder->file_size + 1 - done);
        if (k < 0 && errno == EINTR)
            continue;
        if (k < 0)
            status = pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
        if (k <= 0)
            break;
        done += (size_t)k;
        if (done > folder->file_size) {
            status = pf_fail(failure, PF_ERR_IO, "%s: has grown since the folder was opened", name);
            break;
        }
    }
    close(fd);
    *picture = (pf_picture){name, folder->file, done, folder->scratch, folder->scratch_size};
    return status;
}

static pf_status check_sizes(pf_folder *folder, pf_failure *failure)
{
    for (uint64_t i = 0; i < folder->frames; i++) {
        pf_picture picture;
        uint32_t width, height;
        pf_status status = load(folder, i, &picture, failure);
        if (status == PF_OK)
            status = pf_picture_size(&picture, &width, &height, failure);
        if (status != PF_OK)
            return status;
        if (i == 0) {
            folder->width = width;
            folder->height = height;
        } else if (width != folder->width || height != folder->height) {
            return pf_fail(failure, PF_ERR_FORMAT, "%s: %u x %u pixels, but %s has %u x %u", folder->names[i], width,
                           height, folder->names[0], folder->width, folder->height);
        }
    }
    return PF_OK;
}

pf_status pf_folder_open(pf_folder *folder, const char *path, pf_failure *failure)
{
    *folder = (pf_folder){0};
    pf_status status = list(folder, path, failure);
    if (status == PF_OK) {
        folder->file = malloc(folder->file_size + 1);
        if (folder->file == NULL)
            status = pf_fail(failure, PF_ERR_SPACE, "%s: no memory for a file of %zu bytes", path, folder->file_size);
    }
    if (status == PF_OK)
        status = check_sizes(folder, failure);
    if (status != PF_OK)
        pf_folder_close(folder);
    return status;
}

pf_status pf_folder_read(pf_folder *folder, uint64_t i, uint8_t *pixels, pf_failure *failure)
{
    pf_picture picture;
    pf_status status = load(folder, i, &picture, failure);
    if (status == PF_OK)
        status = pf_picture_decode(&picture, folder->width, folder->height, pixels, failure);
    folder->scratch = picture.scratch;
    folder->scratch_size = picture.scratch_size;
    return status;
}

void pf_folder_close(pf_folder *folder)
{
    for (uint64_t i = 0; i < folder->frames; i++)
        free(folder->names[i]);
    free(folder->names);
    free(folder->file);
    free(folder->scratch);
    *folder = (pf_folder){0};
}
