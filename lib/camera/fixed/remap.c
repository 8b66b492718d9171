/* Remap tables: their entries, and the drawing. */
#include "fixed.h"

static pf_remap_q8 entry_at(const pf_camera_fixed *fixed, pf_point_q16 pixel)
{
    pf_remap_q8 entry = {PF_REMAP_OUTSIDE, 0, 0, 0};
    if (!pf_camera_fixed_in_image(fixed, pixel))
        return entry;
    int32_t right = (int32_t)(fixed->width - 1) * 256, bottom = (int32_t)(fixed->height - 1) * 256;
    int32_t x = (int32_t)round_shift(pixel.x, 8), y = (int32_t)round_shift(pixel.y, 8);
    x = x < 0 ? 0 : x > right ? right : x;
    y = y < 0 ? 0 : y > bottom ? bottom : y;
    entry.x = (int16_t)(x >> 8);
    entry.y = (int16_t)(y >> 8);
    entry.x_q8 = (uint8_t)(x & 255);
    entry.y_q8 = (uint8_t)(y & 255);
    return entry;
}

void pf_remap_from_pixels(const pf_camera_fixed *fixed, size_t n, const pf_point_q16 *pixels, pf_remap_q8 *map)
{
    for (size_t i = 0; i < n; i++)
        map[i] = entry_at(fixed, pixels[i]);
}

void pf_remap_from_rays(const pf_camera_fixed *fixed, size_t n, const pf_ray_q30 *rays, pf_remap_q8 *map)
{
    for (size_t i = 0; i < n; i++) {
        pf_point_q16 pixel;
        if (pf_camera_fixed_project(fixed, rays[i], &pixel) == PF_OK)
            map[i] = entry_at(fixed, pixel);
        else
            map[i] = (pf_remap_q8){PF_REMAP_OUTSIDE, 0, 0, 0};
    }
}

/* What lies on the last column or row has no way to go to the next. */
static bool entry_fits(const pf_remap_q8 *entry, uint32_t width, uint32_t height)
{
    if (entry->x == PF_REMAP_OUTSIDE)
        return true;
    return entry->x >= 0 && entry->y >= 0 && (uint32_t)entry->x + (entry->x_q8 != 0) < width &&
           (uint32_t)entry->y + (entry->y_q8 != 0) < height;
}

pf_status pf_remap_apply(const pf_image *source, uint32_t channels, size_t n, const pf_remap_q8 *map, uint8_t fill,
                         uint8_t *out)
{
    if (channels < 1 || channels > 4 || source->width > PF_IMAGE_SIZE_MAX || source->height > PF_IMAGE_SIZE_MAX ||
        source->stride < source->width * channels)
        return PF_ERR_ARGUMENT;
    for (size_t i = 0; i < n; i++)
        if (!entry_fits(&map[i], source->width, source->height))
            return PF_ERR_ARGUMENT;
    for (size_t i = 0; i < n; i++, out += channels) {
        const pf_remap_q8 e = map[i];
        if (e.x == PF_REMAP_OUTSIDE) {
            for (uint32_t c = 0; c < channels; c++)
                out[c] = fill;
            continue;
        }
        const size_t x = (uint16_t)e.x, y = (uint16_t)e.y, stride = source->stride;
        const uint8_t *p = source->data + y * stride + x * channels;
        const size_t next = e.x_q8 ? channels : 0, below = e.y_q8 ? source->stride : 0;
        const uint32_t right = e.x_q8, left = 256 - right, low = e.y_q8, high = 256 - low;
        for (uint32_t c = 0; c < channels; c++) {
            const uint32_t top = p[c] * left + p[c + next] * right;
            const uint32_t bottom = p[c + below] * left + p[c + below + next] * right;
            out[c] = (uint8_t)((top * high + bottom * low + 32768u) >> 16);
        }
    }
    return PF_OK;
}
