#include "pipefish/image.h"
#include "reduce.h"

/* Rows of every stored level start on a multiple of this many bytes: the length of a vector. */
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

static size_t row_bytes(uint32_t width)
{
    return align_up(PF_REDUCE_ROW(width) * sizeof(uint16_t));
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

/* One level from the one above it. */
static void reduce_level(const pf_image *from, const pf_image *to, uint8_t *store, uint16_t *row)
{
    for (uint32_t y = 0; y < to->height; y++) {
        const uint8_t *r[5];
        for (int32_t k = 0; k < 5; k++)
            r[k] = from->data + (size_t)pf_mirror((int32_t)(2u * y) + k - 2, from->height) * from->stride;
        pf_reduce(r, from->width, row, store + (size_t)y * to->stride);
    }
}

pf_status pf_pyramid_build(pf_pyramid *pyramid, const pf_image *frame)
{
    if (!pyramid || !frame || !frame->data || frame->width != pyramid->level[0].width ||
        frame->height != pyramid->level[0].height || frame->stride < frame->width)
        return PF_ERR_ARGUMENT;
    pyramid->level[0] = *frame;
    for (uint32_t l = 1; l < pyramid->levels; l++)
        reduce_level(&pyramid->level[l - 1u], &pyramid->level[l], pyramid->store[l], pyramid->row);
    return PF_OK;
}
