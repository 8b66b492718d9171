#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "pipefish/drivers/picture.h"
#include "replay.h"

#define FILE_MAX ((size_t)256 << 20)

/* The whole file into *bytes, the caller's to free(). */
static pf_status read_whole(const char *path, uint8_t **bytes, size_t *n, pf_failure *failure)
{
    FILE *in = fopen(path, "rb");
    size_t room = 0;
    pf_status status = PF_OK;
    *bytes = NULL;
    *n = 0;
    if (in == NULL)
        return pf_fail(failure, PF_ERR_IO, "%s: %s", path, strerror(errno));
    while (*n == room && status == PF_OK) {
        room = room ? 2 * room : (size_t)1 << 16;
        uint8_t *more = room <= FILE_MAX ? realloc(*bytes, room) : NULL;
        if (more == NULL) {
            status = pf_fail(failure, PF_ERR_SPACE, "%s: too large", path);
            break;
        }
        *bytes = more;
        *n += fread(*bytes + *n, 1, room - *n, in);
        if (ferror(in))
            status = pf_fail(failure, PF_ERR_IO, "%s: %s", path, strerror(errno));
    }
    (void)fclose(in);
    return status;
}

pf_status pf_picture_load(const char *path, uint32_t *width, uint32_t *height, uint8_t **pixels, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_picture picture = {.name = path};
    uint32_t w = 0, h = 0;
    uint8_t *out = NULL, *bytes;
    pf_status status = read_whole(path, &bytes, &picture.n, &failure);
    picture.bytes = bytes;
    if (status == PF_OK)
        status = pf_picture_size(&picture, &w, &h, &failure);
    if (status == PF_OK) {
        out = malloc((size_t)w * h);
        status = out ? pf_picture_decode(&picture, w, h, out, &failure)
                     : pf_fail(&failure, PF_ERR_SPACE, "%s: no memory", path);
    }
    free(bytes);
    free(picture.scratch);
    if (status != PF_OK) {
        free(out);
        return pf_failure_copy(&failure, status, error, n);
    }
    *width = w;
    *height = h;
    *pixels = out;
    return PF_OK;
}
