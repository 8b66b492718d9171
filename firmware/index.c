#include "index.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "log.h"

#define ROW_MAX 512u

struct pf_index {
    int fd; /* -1: it could not be written any more */
    off_t size;
    char path[PF_CONFIG_TEXT_MAX + 32];
};

static const char headings[] =
    "sequence,time_ns,encoder_count,roll_rad,pitch_rad,attitude_sigma_rad,exposure_us,gain,lamp,sha256\n";

/* A row that has no room leaves no part of it behind. */
static bool put(pf_index *index, const char *text, size_t n)
{
    ssize_t done = write(index->fd, text, n);
    if (done == (ssize_t)n) {
        index->size += done;
        return true;
    }
    const int why = done < 0 ? errno : ENOSPC;
    (void)!ftruncate(index->fd, index->size);
    errno = why;
    return false;
}

/* What is wrong with the medium, and not with the setting, is no reason not to survey: it may happen at any start. */
static bool is_of_the_medium(int why)
{
    return why == ENOSPC || why == EDQUOT || why == EROFS || why == EIO;
}

bool pf_index_open(pf_index **index, const char *folder, const uint8_t survey_id[16], uint32_t boot, char *error,
                   size_t n)
{
    pf_index *i = calloc(1, sizeof *i);
    if (i == NULL) {
        (void)snprintf(error, n, "no memory for the frame index");
        return false;
    }
    (void)snprintf(i->path, sizeof i->path, "%s/%02x%02x%02x%02x-%03u.csv", folder, survey_id[0], survey_id[1],
                   survey_id[2], survey_id[3], boot);
    i->fd = open(i->path, O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0644);
    if (i->fd < 0 || !put(i, headings, sizeof headings - 1)) {
        const int why = errno;
        (void)snprintf(error, n, "camera.index: %s: %s", i->path, strerror(why));
        pf_index_close(i);
        *index = NULL;
        if (is_of_the_medium(why))
            pf_log(PF_LOG_ERROR, "%s; the frames of this start are not listed", error);
        return is_of_the_medium(why);
    }
    *index = i;
    return true;
}

/* Appends to a row, which has room for all its cells. */
static void cell(char *row, size_t *used, bool has, const char *format, double value)
{
    *used += (size_t)snprintf(row + *used, ROW_MAX - *used, ",");
    if (has)
        *used += (size_t)snprintf(row + *used, ROW_MAX - *used, format, value);
}

void pf_index_add(pf_index *index, const pf_shot *shot)
{
    const pf_msg_telemetry *t = &shot->telemetry;
    char row[ROW_MAX];
    if (index->fd < 0)
        return;
    size_t n = (size_t)snprintf(row, sizeof row, "%" PRIu64 ",%" PRIu64 ",", shot->frame.sequence, shot->frame.time_ns);
    if (t->has_encoder)
        n += (size_t)snprintf(row + n, sizeof row - n, "%" PRId64, t->encoder_count);
    /* Nine digits: a float comes back as it was. */
    cell(row, &n, t->has_attitude, "%.9g", (double)t->roll_rad);
    cell(row, &n, t->has_attitude, "%.9g", (double)t->pitch_rad);
    cell(row, &n, t->has_attitude && t->attitude_sigma_rad > 0, "%.9g", (double)t->attitude_sigma_rad);
    cell(row, &n, t->has_exposure, "%.0f", (double)t->exposure_us);
    cell(row, &n, t->has_gain, "%.9g", (double)t->gain);
    cell(row, &n, t->has_lamp, "%.9g", (double)t->lamp);
    n += (size_t)snprintf(row + n, sizeof row - n, ",");
    for (size_t i = 0; i < sizeof shot->frame.sha256; i++)
        n += (size_t)snprintf(row + n, sizeof row - n, "%02x", shot->frame.sha256[i]);
    row[n++] = '\n';
    if (!put(index, row, n)) {
        pf_log(PF_LOG_ERROR, "camera.index: %s: %s; rows are missing from frame %" PRIu64 " on", index->path,
               strerror(errno), shot->frame.sequence);
        (void)close(index->fd);
        index->fd = -1;
    }
}

void pf_index_close(pf_index *index)
{
    if (index == NULL)
        return;
    if (index->fd >= 0)
        (void)close(index->fd);
    free(index);
}
