/* YUV4MPEG2 as mjpegtools' yuv4mpeg(5) describes it: one header line, then FRAME lines each followed by planes. */
#include "replay.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define LINE_MAX_BYTES 1024u /* longer header and FRAME lines are refused; real ones have less than 150 bytes */

/* Reads up to n bytes at `offset`; fewer only at the end of the file. */
static pf_status read_at(const pf_y4m *y4m, uint64_t offset, void *bytes, size_t n, size_t *done, pf_failure *failure)
{
    *done = 0;
    while (*done < n) {
        ssize_t k = pread(y4m->fd, (uint8_t *)bytes + *done, n - *done, (off_t)(offset + *done));
        if (k < 0 && errno == EINTR)
            continue;
        if (k < 0)
            return pf_fail(failure, PF_ERR_IO, "%s: byte %" PRIu64 ": %s", y4m->name, offset + *done, strerror(errno));
        if (k == 0)
            break;
        *done += (size_t)k;
    }
    return PF_OK;
}

/* Reads the line that starts at `offset` into line[LINE_MAX_BYTES] without its newline; *length is its length. */
static pf_status read_line(const pf_y4m *y4m, uint64_t offset, char *line, size_t *length, pf_failure *failure)
{
    size_t n;
    pf_status status = read_at(y4m, offset, line, LINE_MAX_BYTES, &n, failure);
    if (status != PF_OK)
        return status;
    char *end = memchr(line, '\n', n);
    if (end == NULL && n < LINE_MAX_BYTES)
        return pf_fail(failure, PF_ERR_TRUNCATED, "%s: byte %" PRIu64 ": the file ends within this line", y4m->name,
                       offset);
    if (end == NULL)
        return pf_fail(failure, PF_ERR_FORMAT, "%s: byte %" PRIu64 ": no end of line within %u bytes", y4m->name,
                       offset, LINE_MAX_BYTES);
    *end = '\0';
    *length = (size_t)(end - line);
    if (strlen(line) != *length)
        return pf_fail(failure, PF_ERR_FORMAT, "%s: byte %" PRIu64 ": a zero byte in a line of text", y4m->name,
                       offset);
    return PF_OK;
}

/* Decimal digits up to `end`, at most 10^9. */
static bool parse_count(const char *text, const char *end, uint32_t *value)
{
    uint32_t v = 0;
    if (text == end || end - text > 9)
        return false;
    for (; text < end; text++) {
        if (*text < '0' || *text > '9')
            return false;
        v = v * 10 + (uint32_t)(*text - '0');
    }
    *value = v;
    return true;
}

/* Bytes of the planes after the luma, for the 8-bit colour spaces of mjpegtools and FFmpeg. */
static bool chroma_size(const char *name, uint64_t w, uint64_t h, uint64_t *bytes)
{
    if (strcmp(name, "mono") == 0)
        *bytes = 0;
    else if (strcmp(name, "420") == 0 || strcmp(name, "420jpeg") == 0 || strcmp(name, "420mpeg2") == 0 ||
             strcmp(name, "420paldv") == 0)
        *bytes = 2 * ((w + 1) / 2) * ((h + 1) / 2);
    else if (strcmp(name, "422") == 0)
        *bytes = 2 * ((w + 1) / 2) * h;
    else if (strcmp(name, "411") == 0)
        *bytes = 2 * ((w + 3) / 4) * h;
    else if (strcmp(name, "444") == 0)
        *bytes = 2 * w * h;
    else if (strcmp(name, "444alpha") == 0)
        *bytes = 3 * w * h;
    else
        return false;
    return true;
}

typedef struct header {
    const char *colour;
    bool has_width, has_height, has_rate, has_interlace, has_colour;
} header;

/* Frames per second "num:den", 0.001 to 1000000; 0:0 means unknown. */
static bool parse_rate(const char *value, double *rate)
{
    const char *colon = strchr(value, ':');
    uint32_t num, den;
    if (colon == NULL || !parse_count(value, colon, &num) || !parse_count(colon + 1, value + strlen(value), &den) ||
        (num == 0) != (den == 0))
        return false;
    *rate = den == 0 ? 0 : (double)num / den;
    return den == 0 || (*rate >= 1e-3 && *rate <= 1e6);
}

static pf_status parse_size(const pf_y4m *y4m, const char *token, uint32_t *size, pf_failure *failure)
{
    if (!parse_count(token + 1, token + strlen(token), size) || *size == 0)
        return pf_fail(failure, PF_ERR_FORMAT, "%s: header: \"%s\" is no size", y4m->name, token);
    if (*size > PF_IMAGE_SIZE_MAX)
        return pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: header: \"%s\": at most %u pixels", y4m->name, token,
                       PF_IMAGE_SIZE_MAX);
    return PF_OK;
}

static pf_status parse_parameter(pf_y4m *y4m, header *h, const char *token, pf_failure *failure)
{
    bool *seen = NULL;
    pf_status status = PF_OK;
    switch (token[0]) {
    case 'W':
        seen = &h->has_width;
        status = parse_size(y4m, token, &y4m->width, failure);
        break;
    case 'H':
        seen = &h->has_height;
        status = parse_size(y4m, token, &y4m->height, failure);
        break;
    case 'F':
        seen = &h->has_rate;
        if (!parse_rate(token + 1, &y4m->frame_rate))
            status = pf_fail(failure, PF_ERR_FORMAT, "%s: header: \"%s\" is no frame rate", y4m->name, token);
        break;
    case 'I':
        seen = &h->has_interlace;
        if (strcmp(token, "It") == 0 || strcmp(token, "Ib") == 0 || strcmp(token, "Im") == 0)
            status = pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: header: interlaced video (\"%s\"); deinterlace it first",
                             y4m->name, token);
        else if (strcmp(token, "Ip") != 0 && strcmp(token, "I?") != 0)
            status = pf_fail(failure, PF_ERR_FORMAT, "%s: header: \"%s\" is no interlacing", y4m->name, token);
        break;
    case 'C':
        seen = &h->has_colour;
        h->colour = token + 1;
        break;
    case 'A': /* pixel aspect: the camera model takes care of it */
    case 'X': /* comments and extensions */
        return PF_OK;
    default:
        return pf_fail(failure, PF_ERR_FORMAT, "%s: header: unknown parameter \"%s\"", y4m->name, token);
    }
    if (status == PF_OK && *seen)
        status = pf_fail(failure, PF_ERR_FORMAT, "%s: header: a second \"%s\"", y4m->name, token);
    *seen = true;
    return status;
}

/* Reads the header line; *size is its length with the newline, *chroma the bytes after each luma plane. */
static pf_status read_header(pf_y4m *y4m, uint64_t *size, uint64_t *chroma, pf_failure *failure)
{
    static const char magic[] = "YUV4MPEG2";
    char line[LINE_MAX_BYTES], *rest = NULL;
    size_t length;
    pf_status status = read_at(y4m, 0, line, sizeof magic, &length, failure);
    if (status != PF_OK)
        return status;
    if (length < sizeof magic || memcmp(line, magic, sizeof magic - 1) != 0 || (line[9] != ' ' && line[9] != '\n'))
        return pf_fail(failure, PF_ERR_FORMAT,
                       "%s: byte 0: not a Y4M file, which begins with %s (make one with ffmpeg -pix_fmt gray)",
                       y4m->name, magic);
    status = read_line(y4m, 0, line, &length, failure);
    if (status != PF_OK)
        return status;
    *size = length + 1;
    header h = {.colour = "420jpeg"};
    for (char *token = strtok_r(line + sizeof magic - 1, " ", &rest); token != NULL && status == PF_OK;
         token = strtok_r(NULL, " ", &rest))
        status = parse_parameter(y4m, &h, token, failure);
    if (status != PF_OK)
        return status;
    if (!h.has_width || !h.has_height)
        return pf_fail(failure, PF_ERR_FORMAT, "%s: header: no %s", y4m->name,
                       h.has_width ? "height (H)" : "width (W)");
    if (!chroma_size(h.colour, y4m->width, y4m->height, chroma))
        return pf_fail(failure, PF_ERR_UNSUPPORTED,
                       "%s: header: colour space \"%s\"; only 8-bit ones are read: mono, 420*, 422, 411, 444 (make one "
                       "with ffmpeg -pix_fmt gray)",
                       y4m->name, h.colour);
    return PF_OK;
}

static pf_status append_offset(pf_y4m *y4m, uint64_t *capacity, uint64_t offset, pf_failure *failure)
{
    if (y4m->frames == *capacity) {
        *capacity = *capacity == 0 ? 1024 : 2 * *capacity;
        uint64_t *grown = realloc(y4m->offset, *capacity * sizeof *grown);
        if (grown == NULL)
            return pf_fail(failure, PF_ERR_SPACE, "%s: no memory for the index of %" PRIu64 " frames", y4m->name,
                           *capacity);
        y4m->offset = grown;
    }
    y4m->offset[y4m->frames++] = offset;
    return PF_OK;
}

static pf_status find_frames(pf_y4m *y4m, uint64_t at, uint64_t chroma, uint64_t end, pf_failure *failure)
{
    uint64_t luma = (uint64_t)y4m->width * y4m->height, capacity = 0;
    while (at < end) {
        char line[LINE_MAX_BYTES];
        size_t length;
        pf_status status = read_line(y4m, at, line, &length, failure);
        if (status != PF_OK)
            return status;
        if (strncmp(line, "FRAME", 5) != 0 || (line[5] != '\0' && line[5] != ' '))
            return pf_fail(failure, PF_ERR_FORMAT, "%s: byte %" PRIu64 ": no FRAME line where frame %" PRIu64 " begins",
                           y4m->name, at, y4m->frames);
        at += length + 1;
        if (end - at < luma + chroma)
            return pf_fail(failure, PF_ERR_TRUNCATED,
                           "%s: byte %" PRIu64 ": frame %" PRIu64 " is cut off: %" PRIu64 " of %" PRIu64 " bytes",
                           y4m->name, at, y4m->frames, end - at, luma + chroma);
        status = append_offset(y4m, &capacity, at, failure);
        if (status != PF_OK)
            return status;
        at += luma + chroma;
    }
    if (y4m->frames == 0)
        return pf_fail(failure, PF_ERR_TRUNCATED, "%s: byte %" PRIu64 ": no frame after the header", y4m->name, at);
    return PF_OK;
}

pf_status pf_y4m_open_fd(pf_y4m *y4m, int fd, const char *name, pf_failure *failure)
{
    struct stat info;
    uint64_t size = 0, chroma = 0;
    *y4m = (pf_y4m){.name = name, .fd = fd};
    pf_status status = PF_OK;
    if (fstat(fd, &info) != 0)
        status = pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
    else if (!S_ISREG(info.st_mode))
        status = pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: not a regular file (a pipe cannot be replayed)", name);
    if (status == PF_OK)
        status = read_header(y4m, &size, &chroma, failure);
    if (status == PF_OK)
        status = find_frames(y4m, size, chroma, (uint64_t)info.st_size, failure);
    if (status != PF_OK)
        pf_y4m_close(y4m);
    return status;
}

pf_status pf_y4m_open(pf_y4m *y4m, const char *name, pf_failure *failure)
{
    int fd = open(name, O_RDONLY | O_CLOEXEC | O_NONBLOCK); /* else a pipe waits for its writer */
    if (fd < 0)
        return pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
    return pf_y4m_open_fd(y4m, fd, name, failure);
}

pf_status pf_y4m_read(const pf_y4m *y4m, uint64_t i, uint8_t *pixels, pf_failure *failure)
{
    size_t size = (size_t)y4m->width * y4m->height, done;
    pf_status status = read_at(y4m, y4m->offset[i], pixels, size, &done, failure);
    if (status == PF_OK && done < size)
        status = pf_fail(failure, PF_ERR_TRUNCATED,
                         "%s: byte %" PRIu64 ": frame %" PRIu64 " is cut off: the file has shrunk since it was opened",
                         y4m->name, y4m->offset[i] + done, i);
    return status;
}

void pf_y4m_close(pf_y4m *y4m)
{
    close(y4m->fd);
    free(y4m->offset);
    y4m->fd = -1;
    y4m->offset = NULL;
}
