#include "pipefish/image.h"

/* Rows of every stored level start on a multiple of this many bytes, for the vector kernels to come. */
#define ROW_ALIGN 16u

static size_t align_up(size_t n)
{
    return (n + ROW_ALIGN - 1u) / ROW_ALIGN * ROW_ALIGN;
}

static bool arguments_ok(uint32_t width, uint32_t height, uint32_t levels)
{
    return width >= 1u && width <= PF_IMAGE_SIZE_MAX && height >= 1u && height <= PF_IMAGE_SIZE_MAX && levels >= 1u &&
           levels <= PF_PYRAMID_LEVELS_MAX;
}

/* The row buffer holds one vertically filtered row, two mirrored pixels on either side. */
static size_t row_bytes(uint32_t width)
{
    return align_up((size_t)(width + 4u) * sizeof(uint16_t));
}

size_t pf_pyramid_workspace_size(uint32_t width, uint32_t height, uint32_t levels)
{
    if (!arguments_ok(width, height, levels))
        return 0;
    size_t size = row_bytes(width);
    for (uint32_t l = 1; l < levels; l++) {
        width = (width + 1u) / 2u;
        height = (height + 1u) / 2u;
        size += align_up(width) * height;
    }
    return size;
}

pf_status pf_pyramid_init(pf_pyramid *pyramid, uint32_t width, uint32_t height, uint32_t levels, void *workspace,
                          size_t size)
{
    if (!pyramid || !workspace || !arguments_ok(width, height, levels))
        return PF_ERR_ARGUMENT;
    if (size < pf_pyramid_workspace_size(width, height, levels))
        return PF_ERR_SPACE;
    uint8_t *at = workspace;
    *pyramid = (pf_pyramid){.levels = levels, .row = workspace};
    pyramid->level[0] = (pf_image){.data = NULL, .width = width, .height = height, .stride = width};
    at += row_bytes(width);
    for (uint32_t l = 1; l < levels; l++) {
        width = (width + 1u) / 2u;
        height = (height + 1u) / 2u;
        pyramid->store[l] = at;
        pyramid->level[l] =
            (pf_image){.data = at, .width = width, .height = height, .stride = (uint32_t)align_up(width)};
        at += align_up(width) * height;
    }
    return PF_OK;
}

/* Mirrors an index about the first and last sample, neither repeated: ... 2 1 | 0 1 2. */
static uint32_t mirror(int32_t i, uint32_t n)
{
    if (n == 1u)
        return 0;
    const int32_t last = (int32_t)n - 1;
    while (i < 0 || i > last)
        i = i < 0 ? -i : 2 * last - i;
    return (uint32_t)i;
}

/* One level from the one above it. Sums stay below 255 * 256, so 16 bits hold them until the one rounding. */
static void reduce(const pf_image *from, const pf_image *to, uint8_t *store, uint16_t *row)
{
    uint16_t *v = row + 2;
    for (uint32_t y = 0; y < to->height; y++) {
        const uint8_t *r[5];
        for (int32_t k = 0; k < 5; k++)
            r[k] = from->data + (size_t)mirror((int32_t)(2u * y) + k - 2, from->height) * from->stride;
        for (uint32_t x = 0; x < from->width; x++)
            v[x] = (uint16_t)(r[0][x] + r[4][x] + 4 * (r[1][x] + r[3][x]) + 6 * r[2][x]);
        for (int32_t k = 1; k <= 2; k++) {
            v[-k] = v[mirror(-k, from->width)];
            v[(int32_t)from->width - 1 + k] = v[mirror((int32_t)from->width - 1 + k, from->width)];
        }
        uint8_t *out = store + (size_t)y * to->stride;
        for (uint32_t x = 0; x < to->width; x++) {
            const uint16_t *p = row + 2u * x;
            out[x] = (uint8_t)((p[0] + p[4] + 4 * (p[1] + p[3]) + 6 * p[2] + 128) >> 8);
        }
    }
}

pf_status pf_pyramid_build(pf_pyramid *pyramid, const pf_image *frame)
{
    if (!pyramid || !frame || !frame->data || frame->width != pyramid->level[0].width ||
        frame->height != pyramid->level[0].height || frame->stride < frame->width)
        return PF_ERR_ARGUMENT;
    pyramid->level[0] = *frame;
    for (uint32_t l = 1; l < pyramid->levels; l++)
        reduce(&pyramid->level[l - 1u], &pyramid->level[l], pyramid->store[l], pyramid->row);
    return PF_OK;
}
