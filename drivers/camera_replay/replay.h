/* The replay driver's parts, for each other and for their tests and fuzzers. */
#ifndef PIPEFISH_CAMERA_REPLAY_REPLAY_H
#define PIPEFISH_CAMERA_REPLAY_REPLAY_H

#include "common/failure.h"
#include "pipefish/drivers/camera.h"

/* ---- Y4M: the luma of each frame by its number ---- */

typedef struct pf_y4m {
    const char *name; /* borrowed: stands in the messages */
    int fd;
    uint32_t width, height;
    double frame_rate; /* 0 = the file does not say */
    uint64_t frames;   /* at least 1 */
    uint64_t *offset;  /* of each frame's first pixel in the file */
} pf_y4m;

/* Opens the file, reads the header and finds every frame, so that one that is cut off is known before the replay
 * starts. PF_OK; PF_ERR_IO, PF_ERR_FORMAT, PF_ERR_TRUNCATED, PF_ERR_UNSUPPORTED (not 8 bits, interlaced, too large). */
pf_status pf_y4m_open(pf_y4m *y4m, const char *name, pf_failure *failure);

/* The same for a descriptor that the caller has opened (a regular file, or a memory file); it is y4m's from now on. */
pf_status pf_y4m_open_fd(pf_y4m *y4m, int fd, const char *name, pf_failure *failure);

/* Reads frame i < frames into pixels[width * height]. PF_OK, PF_ERR_IO, PF_ERR_TRUNCATED (the file has shrunk). */
pf_status pf_y4m_read(const pf_y4m *y4m, uint64_t i, uint8_t *pixels, pf_failure *failure);

void pf_y4m_close(pf_y4m *y4m);

/* ---- telemetry CSV ---- */

typedef struct pf_csv_row {
    uint64_t sequence, time_ns;
    pf_telemetry telemetry;
    bool has_sha256;
    uint8_t sha256[32];
} pf_csv_row;

typedef struct pf_csv {
    pf_csv_row *rows;
    uint64_t n;
} pf_csv;

/* Line of row i: there is one line of headings, and blank lines may only follow the last row. */
#define PF_CSV_LINE(i) ((uint64_t)(i) + 2)

/* Parses bytes[n]; `name` stands in the messages. PF_OK; PF_ERR_FORMAT, PF_ERR_SPACE (no memory): nothing to free. */
pf_status pf_csv_parse(pf_csv *csv, const char *bytes, size_t n, const char *name, pf_failure *failure);

/* Reads a file. Also PF_ERR_IO; PF_ERR_END if there is no such file. */
pf_status pf_csv_read(pf_csv *csv, const char *name, pf_failure *failure);

void pf_csv_free(pf_csv *csv);

/* ---- single images: PNG, JPEG, binary PGM ---- */

typedef struct pf_picture {
    const char *name; /* borrowed: stands in the messages */
    const uint8_t *bytes;
    size_t n;
    uint8_t *scratch; /* for colour and interlaced PNG; grows as needed, free() it after the last picture */
    size_t scratch_size;
} pf_picture;

/* The kind is told by the first bytes, not by the name. PF_OK; PF_ERR_FORMAT, PF_ERR_TRUNCATED, PF_ERR_UNSUPPORTED. */
pf_status pf_picture_size(pf_picture *picture, uint32_t *width, uint32_t *height, pf_failure *failure);

/* Grey pixels, width * height of them as pf_picture_size said; colour becomes the luma of ITU-R BT.601 (JPEG's), 16
 * bits are rounded to 8, transparency is ignored. Any warning of the decoder is an error: a damaged image measures
 * nothing. PF_OK; PF_ERR_FORMAT, PF_ERR_TRUNCATED, PF_ERR_UNSUPPORTED, PF_ERR_SPACE. */
pf_status pf_picture_decode(pf_picture *picture, uint32_t width, uint32_t height, uint8_t *pixels, pf_failure *failure);

/* ---- a folder of them ---- */

typedef struct pf_folder {
    uint32_t width, height;
    uint64_t frames; /* at least 1 */
    char **names;    /* full paths, in natural order */
    uint8_t *file;   /* one file's bytes */
    size_t file_size;
    uint8_t *scratch;
    size_t scratch_size;
} pf_folder;

/* Lists .png, .jpg, .jpeg and .pgm files (any case), and reads the size of each.
 * PF_OK; PF_ERR_IO, PF_ERR_FORMAT (none there, sizes differ, damaged), PF_ERR_TRUNCATED, PF_ERR_UNSUPPORTED. */
pf_status pf_folder_open(pf_folder *folder, const char *path, pf_failure *failure);
pf_status pf_folder_read(pf_folder *folder, uint64_t i, uint8_t *pixels, pf_failure *failure);
void pf_folder_close(pf_folder *folder);

/* Order of people: img2 before img10; runs of digits compare as numbers. A total order: equal only for equal names. */
int pf_natural_compare(const char *a, const char *b);

#endif
