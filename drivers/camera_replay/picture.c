/* PNG (libpng), JPEG (libjpeg-turbo) and binary PGM to grey pixels. */
#include "replay.h"

#include <png.h>
#include <setjmp.h>
#include <stdlib.h>
#include <string.h>
#include <turbojpeg.h>

typedef enum kind { KIND_UNKNOWN, KIND_PNG, KIND_JPEG, KIND_PGM } kind;

static kind kind_of(const pf_picture *picture)
{
    static const uint8_t png[8] = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1A, '\n'};
    const uint8_t *b = picture->bytes;
    if (picture->n >= 8 && memcmp(b, png, 8) == 0)
        return KIND_PNG;
    if (picture->n >= 3 && b[0] == 0xFF && b[1] == 0xD8 && b[2] == 0xFF)
        return KIND_JPEG;
    if (picture->n >= 2 && b[0] == 'P' && b[1] == '5')
        return KIND_PGM;
    return KIND_UNKNOWN;
}

/* ITU-R BT.601 in 16-bit fixed point; the weights add up to 65536, so that white stays white. */
static uint8_t luma(uint32_t r, uint32_t g, uint32_t b)
{
    return (uint8_t)((19595u * r + 38470u * g + 7471u * b + 32768u) >> 16);
}

/* ---- PNG ---- */

typedef struct png_job {
    pf_picture *picture;
    size_t at;
    bool truncated;
    pf_failure *failure;
    png_structp png;
    png_infop info;
} png_job;

static void png_give(png_structp png, png_bytep out, png_size_t n)
{
    png_job *job = png_get_io_ptr(png);
    if (n > job->picture->n - job->at) {
        job->truncated = true;
        png_error(png, "the data end too early");
    }
    memcpy(out, job->picture->bytes + job->at, n);
    job->at += n;
}

static void png_on_error(png_structp png, png_const_charp text)
{
    png_job *job = png_get_error_ptr(png);
    (void)pf_fail(job->failure, PF_ERR_FORMAT, "%s: PNG: %s", job->picture->name, text);
    longjmp(png_jmpbuf(png), 1);
}

/* libpng warns of odd but harmless things (an unknown profile, a wrong gamma); what spoils pixels is an error there. */
static void png_on_warning(png_structp png, png_const_charp text)
{
    (void)png;
    (void)text;
}

static bool grow(pf_picture *picture, size_t size)
{
    if (picture->scratch_size >= size)
        return true;
    uint8_t *grown = realloc(picture->scratch, size);
    if (grown == NULL)
        return false;
    picture->scratch = grown;
    picture->scratch_size = size;
    return true;
}

/* Asks libpng for 8-bit grey or RGB, and reads the pixels. */
static void png_pixels(png_job *job, uint32_t width, uint32_t height, uint8_t *pixels)
{
    png_structp png = job->png;
    png_set_scale_16(png);
    png_set_palette_to_rgb(png);
    png_set_expand_gray_1_2_4_to_8(png);
    png_set_strip_alpha(png);
    int passes = png_set_interlace_handling(png);
    png_read_update_info(png, job->info);
    size_t channels = png_get_channels(png, job->info), row_size = png_get_rowbytes(png, job->info);
    if (row_size != channels * width || (channels != 1 && channels != 3))
        png_error(png, "unexpected layout of its pixels");
    if (!grow(job->picture, passes > 1 ? row_size * height : row_size))
        png_error(png, "no memory for its pixels");
    for (int pass = 0; pass < passes; pass++) {
        for (uint32_t y = 0; y < height; y++) {
            uint8_t *row = job->picture->scratch + (passes > 1 ? row_size * y : 0);
            png_read_row(png, row, NULL);
            if (pass + 1 < passes)
                continue;
            uint8_t *out = pixels + (size_t)y * width;
            if (channels == 1)
                memcpy(out, row, width);
            for (uint32_t x = 0; channels == 3 && x < width; x++)
                out[x] = luma(row[3 * (size_t)x], row[3 * (size_t)x + 1], row[3 * (size_t)x + 2]);
        }
    }
    png_read_end(png, NULL);
}

/* Reads the header, and the pixels too if there is room for them. */
static pf_status png_run(png_job *job, uint32_t *width, uint32_t *height, uint8_t *pixels)
{
    if (setjmp(png_jmpbuf(job->png)) != 0)
        return job->truncated ? PF_ERR_TRUNCATED : PF_ERR_FORMAT;
    png_set_read_fn(job->png, job, png_give);
    png_set_user_limits(job->png, PF_IMAGE_SIZE_MAX, PF_IMAGE_SIZE_MAX);
    png_read_info(job->png, job->info);
    uint32_t w = png_get_image_width(job->png, job->info), h = png_get_image_height(job->png, job->info);
    if (pixels == NULL) {
        *width = w;
        *height = h;
    } else if (w != *width || h != *height) {
        png_error(job->png, "its size has changed since it was opened");
    } else {
        png_pixels(job, w, h, pixels);
    }
    return PF_OK;
}

static pf_status png_decode(pf_picture *picture, uint32_t *width, uint32_t *height, uint8_t *pixels,
                            pf_failure *failure)
{
    png_job job = {.picture = picture, .failure = failure};
    pf_status status = PF_ERR_SPACE;
    job.png = png_create_read_struct(PNG_LIBPNG_VER_STRING, &job, png_on_error, png_on_warning);
    if (job.png != NULL)
        job.info = png_create_info_struct(job.png);
    if (job.info != NULL)
        status = png_run(&job, width, height, pixels);
    else
        (void)pf_fail(failure, status, "%s: libpng did not start", picture->name);
    png_destroy_read_struct(&job.png, &job.info, NULL);
    return status;
}

/* ---- JPEG ---- */

static pf_status jpeg_decode(pf_picture *picture, uint32_t *width, uint32_t *height, uint8_t *pixels,
                             pf_failure *failure)
{
    tjhandle turbo = tjInitDecompress();
    if (turbo == NULL)
        return pf_fail(failure, PF_ERR_SPACE, "%s: libjpeg-turbo: %s", picture->name, tjGetErrorStr2(NULL));
    int w = 0, h = 0, subsampling, colour;
    pf_status status = PF_OK;
    if (tjDecompressHeader3(turbo, picture->bytes, picture->n, &w, &h, &subsampling, &colour) != 0)
        status = pf_fail(failure, PF_ERR_FORMAT, "%s: JPEG: %s", picture->name, tjGetErrorStr2(turbo));
    else if (w < 1 || h < 1 || w > (int)PF_IMAGE_SIZE_MAX || h > (int)PF_IMAGE_SIZE_MAX)
        status = pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: JPEG: %d x %d pixels; at most %u a side", picture->name, w,
                         h, PF_IMAGE_SIZE_MAX);
    else if (colour == TJCS_CMYK || colour == TJCS_YCCK)
        status = pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: JPEG: printing colours (CMYK) have no luma", picture->name);
    else if (pixels == NULL) {
        *width = (uint32_t)w;
        *height = (uint32_t)h;
    } else if ((uint32_t)w != *width || (uint32_t)h != *height)
        status = pf_fail(failure, PF_ERR_FORMAT, "%s: JPEG: its size has changed since it was opened", picture->name);
    else if (tjDecompress2(turbo, picture->bytes, picture->n, pixels, w, w, h, TJPF_GRAY, TJFLAG_ACCURATEDCT) != 0)
        status = pf_fail(failure, PF_ERR_FORMAT, "%s: JPEG: %s", picture->name, tjGetErrorStr2(turbo));
    (void)tjDestroy(turbo);
    return status;
}

/* ---- PGM ---- */

/* A decimal number of the header after white space and comments. */
static bool pgm_number(const pf_picture *picture, size_t *at, uint32_t *value)
{
    const uint8_t *b = picture->bytes;
    size_t i = *at;
    while (i < picture->n && (b[i] == ' ' || (b[i] >= '\t' && b[i] <= '\r') || b[i] == '#')) {
        if (b[i] == '#')
            while (i < picture->n && b[i] != '\n')
                i++;
        else
            i++;
    }
    size_t first = i;
    for (*value = 0; i < picture->n && b[i] >= '0' && b[i] <= '9'; i++) {
        if (*value > 99999u)
            return false;
        *value = *value * 10 + (uint32_t)(b[i] - '0');
    }
    bool found = i > first && i > *at;
    *at = i;
    return found;
}

static pf_status pgm_decode(const pf_picture *picture, uint32_t *width, uint32_t *height, uint8_t *pixels,
                            pf_failure *failure)
{
    uint32_t w, h, max;
    size_t at = 2;
    if (!pgm_number(picture, &at, &w) || !pgm_number(picture, &at, &h) || !pgm_number(picture, &at, &max) || max < 1 ||
        max > 65535 || w < 1 || h < 1)
        return pf_fail(failure, at >= picture->n ? PF_ERR_TRUNCATED : PF_ERR_FORMAT,
                       "%s: byte %zu: PGM: no width, height and highest value", picture->name, at);
    if (w > PF_IMAGE_SIZE_MAX || h > PF_IMAGE_SIZE_MAX)
        return pf_fail(failure, PF_ERR_UNSUPPORTED, "%s: PGM: %u x %u pixels; at most %u a side", picture->name, w, h,
                       PF_IMAGE_SIZE_MAX);
    size_t depth = max > 255 ? 2 : 1, size = (size_t)w * h * depth;
    if (picture->n - at < size + 1)
        return pf_fail(failure, PF_ERR_TRUNCATED, "%s: byte %zu: PGM: the data end too early: %zu of %zu bytes",
                       picture->name, picture->n, picture->n - at, size + 1);
    const uint8_t *from = picture->bytes + at + 1; /* one white-space byte after the highest value */
    if (pixels == NULL) {
        *width = w;
        *height = h;
        return PF_OK;
    }
    if (w != *width || h != *height)
        return pf_fail(failure, PF_ERR_FORMAT, "%s: PGM: its size has changed since it was opened", picture->name);
    for (size_t i = 0; i < (size_t)w * h; i++) {
        uint32_t value = depth == 1 ? from[i] : (uint32_t)from[2 * i] << 8 | from[2 * i + 1];
        if (value > max)
            return pf_fail(failure, PF_ERR_FORMAT, "%s: byte %zu: PGM: %u is above the highest value %u", picture->name,
                           at + 1 + i * depth, value, max);
        pixels[i] = (uint8_t)((value * 255u + max / 2) / max);
    }
    return PF_OK;
}

static pf_status decode(pf_picture *picture, uint32_t *width, uint32_t *height, uint8_t *pixels, pf_failure *failure)
{
    switch (kind_of(picture)) {
    case KIND_PNG:
        return png_decode(picture, width, height, pixels, failure);
    case KIND_JPEG:
        return jpeg_decode(picture, width, height, pixels, failure);
    case KIND_PGM:
        return pgm_decode(picture, width, height, pixels, failure);
    case KIND_UNKNOWN:
        break;
    }
    return pf_fail(failure, PF_ERR_FORMAT, "%s: byte 0: neither PNG, JPEG nor binary PGM (P5)", picture->name);
}

pf_status pf_picture_size(pf_picture *picture, uint32_t *width, uint32_t *height, pf_failure *failure)
{
    return decode(picture, width, height, NULL, failure);
}

pf_status pf_picture_decode(pf_picture *picture, uint32_t width, uint32_t height, uint8_t *pixels, pf_failure *failure)
{
    return decode(picture, &width, &height, pixels, failure);
}
