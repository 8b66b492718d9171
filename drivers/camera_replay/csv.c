/* The telemetry beside a recording: one line of headings, one row a frame (docs/recording.md). */
#include "replay.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define FILE_MAX_BYTES ((off_t)1 << 30) /* a row has some 100 bytes: ten million frames */
#define CELL_MAX_BYTES 128u             /* the longest, a hash, has 64 */

typedef enum column {
    COLUMN_SEQUENCE,
    COLUMN_TIME,
    COLUMN_ENCODER,
    COLUMN_ROLL,
    COLUMN_PITCH,
    COLUMN_SIGMA,
    COLUMN_EXPOSURE,
    COLUMN_GAIN,
    COLUMN_LAMP,
    COLUMN_SHA256,
    COLUMNS,
} column;

static const char *const column_names[COLUMNS] = {
    "sequence",           "time_ns",     "encoder_count", "roll_rad", "pitch_rad",
    "attitude_sigma_rad", "exposure_us", "gain",          "lamp",     "sha256",
};

typedef struct parser {
    const char *name;
    const char *at, *end; /* what has not been read yet */
    uint64_t line;        /* the one `at` is in, from 1 */
    column columns[COLUMNS];
    uint32_t n_columns;
    bool has[COLUMNS]; /* whether the cell of this row holds something */
    pf_failure *failure;
} parser;

static pf_status cell_fail(parser *p, column c, const char *cell, const char *must)
{
    return pf_fail(p->failure, PF_ERR_FORMAT, "%s:%" PRIu64 ": column %s: \"%s\" %s", p->name, p->line, column_names[c],
                   cell, must);
}

/* Takes the next line without its end; false when there is none. CRLF counts as an end of line. */
static bool take_line(parser *p, const char **line, const char **line_end)
{
    if (p->at == p->end)
        return false;
    const char *newline = memchr(p->at, '\n', (size_t)(p->end - p->at));
    *line = p->at;
    *line_end = newline != NULL ? newline : p->end;
    p->at = newline != NULL ? newline + 1 : p->end;
    if (*line_end > *line && (*line_end)[-1] == '\r')
        (*line_end)--;
    return true;
}

/* Copies the next cell of a line, without blanks around it, and moves on; *more tells whether a comma followed. */
static pf_status take_cell(parser *p, const char **line, const char *line_end, char cell[CELL_MAX_BYTES], bool *more)
{
    const char *comma = memchr(*line, ',', (size_t)(line_end - *line));
    const char *begin = *line, *end = comma != NULL ? comma : line_end;
    *more = comma != NULL;
    *line = comma != NULL ? comma + 1 : line_end;
    while (begin < end && (*begin == ' ' || *begin == '\t'))
        begin++;
    while (end > begin && (end[-1] == ' ' || end[-1] == '\t'))
        end--;
    size_t n = (size_t)(end - begin);
    if (n >= CELL_MAX_BYTES)
        return pf_fail(p->failure, PF_ERR_FORMAT, "%s:%" PRIu64 ": a cell of %zu bytes; the longest has 64", p->name,
                       p->line, n);
    for (size_t i = 0; i < n; i++)
        if ((uint8_t)begin[i] < 0x20 || (uint8_t)begin[i] > 0x7E)
            return pf_fail(p->failure, PF_ERR_FORMAT, "%s:%" PRIu64 ": byte 0x%02X in a cell; only ASCII is read",
                           p->name, p->line, (uint8_t)begin[i]);
    memcpy(cell, begin, n);
    cell[n] = '\0';
    return PF_OK;
}

static pf_status parse_headings(parser *p)
{
    const char *line, *line_end;
    bool more = true, seen[COLUMNS] = {false};
    p->line = 1;
    if (!take_line(p, &line, &line_end))
        return pf_fail(p->failure, PF_ERR_FORMAT, "%s:1: the file is empty; the first line names the columns", p->name);
    while (more) {
        char cell[CELL_MAX_BYTES];
        pf_status status = take_cell(p, &line, line_end, cell, &more);
        if (status != PF_OK)
            return status;
        uint32_t c = 0;
        while (c < COLUMNS && strcmp(cell, column_names[c]) != 0)
            c++;
        if (c == COLUMNS)
            return pf_fail(p->failure, PF_ERR_FORMAT, "%s:1: column %" PRIu32 ": unknown name \"%s\"", p->name,
                           p->n_columns + 1, cell);
        if (seen[c])
            return pf_fail(p->failure, PF_ERR_FORMAT, "%s:1: column %" PRIu32 ": a second \"%s\"", p->name,
                           p->n_columns + 1, cell);
        seen[c] = true;
        p->columns[p->n_columns++] = (column)c;
    }
    for (uint32_t c = COLUMN_SEQUENCE; c <= COLUMN_TIME; c++)
        if (!seen[c])
            return pf_fail(p->failure, PF_ERR_FORMAT, "%s:1: no column %s", p->name, column_names[c]);
    return PF_OK;
}

/* Decimal digits only, 0..max. */
static bool parse_unsigned(const char *cell, uint64_t max, uint64_t *value)
{
    uint64_t v = 0;
    if (*cell == '\0')
        return false;
    for (; *cell != '\0'; cell++) {
        if (*cell < '0' || *cell > '9')
            return false;
        uint64_t digit = (uint64_t)(*cell - '0');
        if (v > (max - digit) / 10)
            return false;
        v = v * 10 + digit;
    }
    *value = v;
    return true;
}

static bool parse_signed(const char *cell, int64_t *value)
{
    uint64_t v;
    bool negative = *cell == '-';
    if (!parse_unsigned(negative || *cell == '+' ? cell + 1 : cell, INT64_MAX, &v))
        return false;
    *value = negative ? -(int64_t)v : (int64_t)v;
    return true;
}

/* A finite decimal number min..max. strtod alone would also take "inf", "nan" and hexadecimal. */
static bool parse_real(const char *cell, double min, double max, double *value)
{
    char *end;
    if (*cell == '\0' || strspn(cell, "0123456789+-.eE") != strlen(cell))
        return false;
    *value = strtod(cell, &end);
    return *end == '\0' && isfinite(*value) && *value >= min && *value <= max;
}

static int hex_digit(char c)
{
    if (c >= '0' && c <= '9')
        return c - '0';
    if (c >= 'a' && c <= 'f')
        return c - 'a' + 10;
    if (c >= 'A' && c <= 'F')
        return c - 'A' + 10;
    return -1;
}

static bool parse_sha256(const char *cell, uint8_t hash[32])
{
    if (strlen(cell) != 64)
        return false;
    for (size_t i = 0; i < 32; i++) {
        int high = hex_digit(cell[2 * i]), low = hex_digit(cell[2 * i + 1]);
        if (high < 0 || low < 0)
            return false;
        hash[i] = (uint8_t)(high << 4 | low);
    }
    return true;
}

static pf_status parse_cell(parser *p, column c, const char *cell, pf_csv_row *row)
{
    const double full_turn = 6.2831853071795865; /* angles of either convention, -pi..pi or 0..2 pi */
    pf_telemetry *t = &row->telemetry;
    uint64_t exposure;
    p->has[c] = *cell != '\0';
    if (!p->has[c] && c > COLUMN_TIME)
        return PF_OK;
    switch (c) {
    case COLUMN_SEQUENCE:
    case COLUMN_TIME:
        if (!parse_unsigned(cell, INT64_MAX, c == COLUMN_TIME ? &row->time_ns : &row->sequence))
            return cell_fail(p, c, cell, "is not a whole number from 0 to 2^63 - 1");
        break;
    case COLUMN_ENCODER:
        if (!parse_signed(cell, &t->encoder_count))
            return cell_fail(p, c, cell, "is not a whole number of 64 bits");
        break;
    case COLUMN_ROLL:
    case COLUMN_PITCH:
        if (!parse_real(cell, -full_turn, full_turn, c == COLUMN_ROLL ? &t->roll_rad : &t->pitch_rad))
            return cell_fail(p, c, cell, "is not an angle in radians from -2 pi to 2 pi");
        break;
    case COLUMN_SIGMA:
        if (!parse_real(cell, 0, full_turn, &t->attitude_sigma_rad) || t->attitude_sigma_rad <= 0)
            return cell_fail(p, c, cell, "is not a standard deviation in radians above 0");
        break;
    case COLUMN_EXPOSURE:
        if (!parse_unsigned(cell, UINT32_MAX, &exposure))
            return cell_fail(p, c, cell, "is not a whole number from 0 to 2^32 - 1");
        t->exposure_us = (uint32_t)exposure;
        break;
    case COLUMN_GAIN:
        if (!parse_real(cell, 0, 1e6, &t->gain))
            return cell_fail(p, c, cell, "is not a number from 0 to 1000000");
        break;
    case COLUMN_LAMP:
        if (!parse_real(cell, 0, 1, &t->lamp))
            return cell_fail(p, c, cell, "is not a number from 0 to 1");
        break;
    case COLUMN_SHA256:
        if (!parse_sha256(cell, row->sha256))
            return cell_fail(p, c, cell, "is not a SHA-256 of 64 hexadecimal digits");
        break;
    case COLUMNS:
        break;
    }
    return PF_OK;
}

/* What the cells of a row mean together. */
static pf_status finish_row(parser *p, pf_csv_row *row, const pf_csv_row *previous)
{
    pf_telemetry *t = &row->telemetry;
    if (p->has[COLUMN_ROLL] != p->has[COLUMN_PITCH])
        return cell_fail(p, p->has[COLUMN_ROLL] ? COLUMN_PITCH : COLUMN_ROLL, "",
                         "is empty, but the other angle is given: an attitude needs both");
    if (p->has[COLUMN_SIGMA] && !p->has[COLUMN_ROLL])
        return cell_fail(p, COLUMN_ROLL, "", "is empty, but attitude_sigma_rad is given");
    t->has_encoder = p->has[COLUMN_ENCODER];
    t->has_attitude = p->has[COLUMN_ROLL];
    t->has_exposure = p->has[COLUMN_EXPOSURE];
    t->has_gain = p->has[COLUMN_GAIN];
    t->has_lamp = p->has[COLUMN_LAMP];
    row->has_sha256 = p->has[COLUMN_SHA256];
    if (previous == NULL)
        return PF_OK;
    if (row->sequence <= previous->sequence)
        return pf_fail(p->failure, PF_ERR_FORMAT,
                       "%s:%" PRIu64 ": column sequence: %" PRIu64 " does not follow %" PRIu64 " (must increase)",
                       p->name, p->line, row->sequence, previous->sequence);
    if (row->time_ns <= previous->time_ns)
        return pf_fail(p->failure, PF_ERR_FORMAT,
                       "%s:%" PRIu64 ": column time_ns: %" PRIu64 " does not follow %" PRIu64 " (must increase)",
                       p->name, p->line, row->time_ns, previous->time_ns);
    return PF_OK;
}

static pf_status parse_row(parser *p, const char *line, const char *line_end, pf_csv_row *row,
                           const pf_csv_row *previous)
{
    bool more = true;
    uint32_t n = 0;
    memset(row, 0, sizeof *row);
    memset(p->has, 0, sizeof p->has);
    while (more) {
        char cell[CELL_MAX_BYTES];
        pf_status status = take_cell(p, &line, line_end, cell, &more);
        if (status == PF_OK && n < p->n_columns)
            status = parse_cell(p, p->columns[n], cell, row);
        if (status != PF_OK)
            return status;
        n++;
    }
    if (n != p->n_columns)
        return pf_fail(p->failure, PF_ERR_FORMAT,
                       "%s:%" PRIu64 ": column %" PRIu32 ": %" PRIu32 " cells under %" PRIu32 " headings", p->name,
                       p->line, n < p->n_columns ? n + 1 : p->n_columns + 1, n, p->n_columns);
    return finish_row(p, row, previous);
}

static pf_status parse_rows(parser *p, pf_csv *csv)
{
    const char *line, *line_end;
    uint64_t capacity = 0;
    bool ended = false; /* a blank line was seen */
    while (take_line(p, &line, &line_end)) {
        p->line++;
        if (line == line_end) {
            ended = true;
            continue;
        }
        if (ended)
            return pf_fail(p->failure, PF_ERR_FORMAT, "%s:%" PRIu64 ": a row after a blank line", p->name, p->line);
        if (csv->n == capacity) {
            capacity = capacity == 0 ? 1024 : 2 * capacity;
            pf_csv_row *grown = realloc(csv->rows, capacity * sizeof *grown);
            if (grown == NULL)
                return pf_fail(p->failure, PF_ERR_SPACE, "%s:%" PRIu64 ": no memory for so many rows", p->name,
                               p->line);
            csv->rows = grown;
        }
        pf_status status = parse_row(p, line, line_end, &csv->rows[csv->n], csv->n > 0 ? &csv->rows[csv->n - 1] : NULL);
        if (status != PF_OK)
            return status;
        csv->n++;
    }
    return PF_OK;
}

pf_status pf_csv_parse(pf_csv *csv, const char *bytes, size_t n, const char *name, pf_failure *failure)
{
    static const char mark[] = "\xEF\xBB\xBF"; /* UTF-8 byte order mark: spreadsheets write one */
    parser p = {.name = name, .at = bytes, .end = bytes + n, .failure = failure};
    if (n >= 3 && memcmp(bytes, mark, 3) == 0)
        p.at += 3;
    *csv = (pf_csv){NULL, 0};
    pf_status status = parse_headings(&p);
    if (status == PF_OK)
        status = parse_rows(&p, csv);
    if (status != PF_OK)
        pf_csv_free(csv);
    return status;
}

pf_status pf_csv_read(pf_csv *csv, const char *name, pf_failure *failure)
{
    struct stat info;
    int fd = open(name, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (fd < 0)
        return pf_fail(failure, errno == ENOENT ? PF_ERR_END : PF_ERR_IO, "%s: %s", name, strerror(errno));
    pf_status status = PF_OK;
    char *bytes = NULL;
    size_t done = 0, size = 0;
    if (fstat(fd, &info) != 0)
        status = pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
    else if (!S_ISREG(info.st_mode))
        status = pf_fail(failure, PF_ERR_IO, "%s: not a regular file", name);
    else if (info.st_size > FILE_MAX_BYTES)
        status = pf_fail(failure, PF_ERR_FORMAT, "%s: larger than 1 GiB: not telemetry", name);
    else if ((bytes = malloc((size_t)info.st_size + 1)) == NULL)
        status = pf_fail(failure, PF_ERR_SPACE, "%s: no memory for its %jd bytes", name, (intmax_t)info.st_size);
    else
        size = (size_t)info.st_size;
    while (status == PF_OK && done < size) {
        ssize_t k = read(fd, bytes + done, size - done);
        if (k < 0 && errno != EINTR)
            status = pf_fail(failure, PF_ERR_IO, "%s: %s", name, strerror(errno));
        if (k == 0)
            break;
        if (k > 0)
            done += (size_t)k;
    }
    close(fd);
    if (status == PF_OK)
        status = pf_csv_parse(csv, bytes, done, name, failure);
    free(bytes);
    return status;
}

void pf_csv_free(pf_csv *csv)
{
    free(csv->rows);
    *csv = (pf_csv){NULL, 0};
}
