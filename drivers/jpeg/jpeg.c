#include "pipefish/drivers/jpeg.h"

#include "common/failure.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <turbojpeg.h>

#define PREVIEW_QUALITY_LEAST 20u /* below it a smaller picture shows more */

typedef struct span {
    uint32_t begin, end; /* columns of one row inside the circle: begin <= x < end */
} span;

struct pf_jpeg {
    pf_jpeg_config config;
    uint32_t preview_quality, preview_shrink; /* as far as was needed so far */
    tjhandle turbo;
    span *spans;      /* height of them; NULL without a circle */
    uint8_t *masked;  /* width x height, black outside the spans for good; NULL without a circle */
    uint8_t *preview; /* preview_width x preview_height */
    uint8_t *out, *preview_out;
    unsigned long out_size, preview_out_size;
    pf_failure failure;
};

/* Columns of row y whose centres are at most `radius` from (u, v). */
static span row_span(const pf_jpeg_config *config, uint32_t y)
{
    span s = {0, 0};
    double dv = (double)y - config->circle_v;
    double half = config->circle_radius * config->circle_radius - dv * dv;
    if (half < 0)
        return s;
    half = sqrt(half);
    double first = ceil(config->circle_u - half), last = floor(config->circle_u + half);
    double right = (double)config->width - 1;
    if (first < 0)
        first = 0;
    if (last > right)
        last = right;
    if (first > last)
        return s;
    s.begin = (uint32_t)first;
    s.end = (uint32_t)last + 1;
    return s;
}

static pf_status check(const pf_jpeg_config *config, pf_failure *failure)
{
    if (config->width < 1 || config->width > PF_IMAGE_SIZE_MAX || config->height < 1 ||
        config->height > PF_IMAGE_SIZE_MAX)
        return pf_fail(failure, PF_ERR_ARGUMENT, "JPEG size %u x %u: must be 1..%u", config->width, config->height,
                       PF_IMAGE_SIZE_MAX);
    if (config->quality < 1 || config->quality > 100 || config->preview_quality < 1 || config->preview_quality > 100)
        return pf_fail(failure, PF_ERR_ARGUMENT, "JPEG quality %u, of previews %u: must be 1..100", config->quality,
                       config->preview_quality);
    if (!isfinite(config->circle_u) || !isfinite(config->circle_v) || !isfinite(config->circle_radius) ||
        config->circle_radius < 0)
        return pf_fail(failure, PF_ERR_ARGUMENT, "image circle (%g, %g), radius %g: must be finite, radius >= 0",
                       config->circle_u, config->circle_v, config->circle_radius);
    return PF_OK;
}

static pf_status open_parts(pf_jpeg *jpeg)
{
    const pf_jpeg_config *config = &jpeg->config;
    uint32_t width = (config->width + PF_JPEG_PREVIEW_SHRINK - 1) / PF_JPEG_PREVIEW_SHRINK;
    uint32_t height = (config->height + PF_JPEG_PREVIEW_SHRINK - 1) / PF_JPEG_PREVIEW_SHRINK;
    jpeg->preview_quality = config->preview_quality;
    jpeg->preview_shrink = PF_JPEG_PREVIEW_SHRINK;
    jpeg->out_size = tjBufSize((int)config->width, (int)config->height, TJSAMP_GRAY);
    jpeg->preview_out_size = tjBufSize((int)width, (int)height, TJSAMP_GRAY);
    jpeg->turbo = tjInitCompress();
    if (jpeg->turbo == NULL)
        return pf_fail(&jpeg->failure, PF_ERR_IO, "libjpeg-turbo: %s", tjGetErrorStr2(NULL));
    jpeg->out = malloc(jpeg->out_size);
    jpeg->preview_out = malloc(jpeg->preview_out_size);
    jpeg->preview = malloc((size_t)width * height);
    bool complete = jpeg->out != NULL && jpeg->preview_out != NULL && jpeg->preview != NULL;
    if (complete && config->circle_radius > 0) {
        jpeg->spans = malloc(config->height * sizeof *jpeg->spans);
        jpeg->masked = calloc(config->height, config->width);
        complete = jpeg->spans != NULL && jpeg->masked != NULL;
        for (uint32_t y = 0; complete && y < config->height; y++)
            jpeg->spans[y] = row_span(config, y);
    }
    if (!complete)
        return pf_fail(&jpeg->failure, PF_ERR_SPACE, "no memory for a %u x %u JPEG encoder", config->width,
                       config->height);
    return PF_OK;
}

pf_status pf_jpeg_open(pf_jpeg **jpeg, const pf_jpeg_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_status status = check(config, &failure);
    if (status != PF_OK)
        return pf_failure_copy(&failure, status, error, n);
    pf_jpeg *self = calloc(1, sizeof *self);
    if (self == NULL) {
        status = pf_fail(&failure, PF_ERR_SPACE, "no memory for a JPEG encoder");
        return pf_failure_copy(&failure, status, error, n);
    }
    self->config = *config;
    status = open_parts(self);
    if (status != PF_OK) {
        pf_failure_copy(&self->failure, status, error, n);
        pf_jpeg_close(self);
        return status;
    }
    *jpeg = self;
    return PF_OK;
}

void pf_jpeg_close(pf_jpeg *jpeg)
{
    if (jpeg == NULL)
        return;
    if (jpeg->turbo != NULL)
        (void)tjDestroy(jpeg->turbo);
    free(jpeg->spans);
    free(jpeg->masked);
    free(jpeg->preview);
    free(jpeg->out);
    free(jpeg->preview_out);
    free(jpeg);
}

const char *pf_jpeg_error(const pf_jpeg *jpeg)
{
    return jpeg->failure.text;
}

/* Turns a view of the caller's frame into one of a copy with its outside black; leaves it if there is no circle. */
static pf_status mask(pf_jpeg *jpeg, pf_image *image)
{
    uint32_t width = jpeg->config.width, height = jpeg->config.height;
    if (image->data == NULL || image->width != width || image->height != height || image->stride < width)
        return pf_fail(&jpeg->failure, PF_ERR_ARGUMENT, "a frame of %u x %u for a JPEG encoder of %u x %u",
                       image->width, image->height, width, height);
    if (jpeg->masked == NULL)
        return PF_OK;
    for (uint32_t y = 0; y < height; y++) {
        span s = jpeg->spans[y];
        memcpy(jpeg->masked + (size_t)y * width + s.begin, image->data + (size_t)y * image->stride + s.begin,
               s.end - s.begin);
    }
    image->data = jpeg->masked;
    image->stride = width;
    return PF_OK;
}

static pf_status compress(pf_jpeg *jpeg, const pf_image *image, uint32_t quality, uint8_t *out, unsigned long size,
                          const uint8_t **bytes, size_t *n)
{
    if (tjCompress2(jpeg->turbo, image->data, (int)image->width, (int)image->stride, (int)image->height, TJPF_GRAY,
                    &out, &size, TJSAMP_GRAY, (int)quality, TJFLAG_NOREALLOC) != 0)
        return pf_fail(&jpeg->failure, PF_ERR_IO, "libjpeg-turbo: %s", tjGetErrorStr2(jpeg->turbo));
    *bytes = out;
    *n = size;
    return PF_OK;
}

pf_status pf_jpeg_encode(pf_jpeg *jpeg, const pf_image *image, const uint8_t **bytes, size_t *n)
{
    pf_image masked = *image;
    pf_status status = mask(jpeg, &masked);
    if (status != PF_OK)
        return status;
    return compress(jpeg, &masked, jpeg->config.quality, jpeg->out, jpeg->out_size, bytes, n);
}

/* Box filter: each pixel the rounded mean of the source pixels it covers. */
static void shrink(const pf_image *from, uint32_t by, uint32_t width, uint32_t height, uint8_t *to)
{
    for (uint32_t y = 0; y < height; y++) {
        uint32_t y0 = y * by, y1 = y0 + by;
        if (y1 > from->height)
            y1 = from->height;
        for (uint32_t x = 0; x < width; x++) {
            uint32_t x0 = x * by, x1 = x0 + by, sum = 0;
            if (x1 > from->width)
                x1 = from->width;
            for (uint32_t v = y0; v < y1; v++)
                for (uint32_t u = x0; u < x1; u++)
                    sum += from->data[(size_t)v * from->stride + u];
            uint32_t area = (y1 - y0) * (x1 - x0);
            to[(size_t)y * width + x] = (uint8_t)((sum + area / 2) / area);
        }
    }
}

pf_status pf_jpeg_encode_preview(pf_jpeg *jpeg, const pf_image *image, size_t most, pf_jpeg_preview *p)
{
    pf_image masked = *image;
    pf_status status = mask(jpeg, &masked);
    if (status != PF_OK)
        return status;
    for (;;) {
        uint32_t by = jpeg->preview_shrink;
        p->shrink = by;
        p->quality = jpeg->preview_quality;
        p->width = (masked.width + by - 1) / by;
        p->height = (masked.height + by - 1) / by;
        pf_image preview = {jpeg->preview, p->width, p->height, p->width};
        shrink(&masked, by, p->width, p->height, jpeg->preview);
        status = compress(jpeg, &preview, p->quality, jpeg->preview_out, jpeg->preview_out_size, &p->bytes, &p->n);
        if (status != PF_OK || p->n <= most)
            return status;
        if (p->width == 1 && p->height == 1)
            return pf_fail(&jpeg->failure, PF_ERR_SPACE, "a preview of one pixel has more than %zu bytes", most);
        if (jpeg->preview_quality > PREVIEW_QUALITY_LEAST)
            jpeg->preview_quality =
                jpeg->preview_quality / 2 > PREVIEW_QUALITY_LEAST ? jpeg->preview_quality / 2 : PREVIEW_QUALITY_LEAST;
        else
            jpeg->preview_shrink *= 2;
    }
}
