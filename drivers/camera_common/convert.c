#include "camera_common/convert.h"

#include <linux/videodev2.h>
#include <string.h>
#include <sys/mman.h>
#include <turbojpeg.h>

#ifndef V4L2_PIX_FMT_Y12P /* not in the kernel headers of Debian 12 */
#define V4L2_PIX_FMT_Y12P v4l2_fourcc('Y', '1', '2', 'P')
#endif

static const pf_pixel_format formats[] = {
    {V4L2_PIX_FMT_GREY, "GREY", PF_LAYOUT_LUMA, 8},       {V4L2_PIX_FMT_NV12, "NV12", PF_LAYOUT_LUMA, 8},
    {V4L2_PIX_FMT_NV12M, "NM12", PF_LAYOUT_LUMA, 8},      {V4L2_PIX_FMT_NV21, "NV21", PF_LAYOUT_LUMA, 8},
    {V4L2_PIX_FMT_YUV420, "YU12", PF_LAYOUT_LUMA, 8},     {V4L2_PIX_FMT_Y10P, "Y10P", PF_LAYOUT_PACKED_10, 10},
    {V4L2_PIX_FMT_Y12P, "Y12P", PF_LAYOUT_PACKED_12, 12}, {V4L2_PIX_FMT_Y10, "Y10", PF_LAYOUT_WORDS, 10},
    {V4L2_PIX_FMT_Y12, "Y12", PF_LAYOUT_WORDS, 12},       {V4L2_PIX_FMT_YUYV, "YUYV", PF_LAYOUT_LUMA_EVEN, 8},
    {V4L2_PIX_FMT_UYVY, "UYVY", PF_LAYOUT_LUMA_ODD, 8},   {V4L2_PIX_FMT_RGB24, "RGB3", PF_LAYOUT_RGB, 8},
    {V4L2_PIX_FMT_BGR24, "BGR3", PF_LAYOUT_BGR, 8},       {V4L2_PIX_FMT_MJPEG, "MJPG", PF_LAYOUT_JPEG, 8},
    {V4L2_PIX_FMT_JPEG, "JPEG", PF_LAYOUT_JPEG, 8},
};

const pf_pixel_format *pf_pixel_formats(uint32_t *n)
{
    *n = sizeof formats / sizeof formats[0];
    return formats;
}

const pf_pixel_format *pf_pixel_format_find(uint32_t fourcc)
{
    for (size_t i = 0; i < sizeof formats / sizeof formats[0]; i++)
        if (formats[i].fourcc == fourcc)
            return &formats[i];
    return NULL;
}

const pf_pixel_format *pf_pixel_format_named(const char *name)
{
    for (size_t i = 0; i < sizeof formats / sizeof formats[0]; i++)
        if (strcmp(formats[i].name, name) == 0)
            return &formats[i];
    return NULL;
}

uint32_t pf_pixel_format_row(const pf_pixel_format *format, uint32_t width)
{
    switch (format->layout) {
    case PF_LAYOUT_LUMA:
        return width;
    case PF_LAYOUT_LUMA_EVEN:
    case PF_LAYOUT_LUMA_ODD:
    case PF_LAYOUT_WORDS:
        return 2 * width;
    case PF_LAYOUT_PACKED_10:
        return (width + 3) / 4 * 5;
    case PF_LAYOUT_PACKED_12:
        return (width + 1) / 2 * 3;
    case PF_LAYOUT_RGB:
    case PF_LAYOUT_BGR:
        return 3 * width;
    case PF_LAYOUT_JPEG:
        break;
    }
    return 0;
}

bool pf_pixel_format_fits(const pf_pixel_format *format, uint32_t width, uint32_t height, uint32_t stride, size_t n)
{
    uint32_t row = pf_pixel_format_row(format, width);
    if (format->layout == PF_LAYOUT_JPEG)
        return n > 0;
    return height > 0 && stride >= row && n >= (size_t)stride * (height - 1) + row;
}

static void unpack_words(const uint8_t *from, uint32_t width, uint32_t shift, uint8_t *to)
{
    const uint32_t top = (256u << shift) - 1;
    for (uint32_t x = 0; x < width; x++) {
        uint32_t v = (uint32_t)from[2 * x] | (uint32_t)from[2 * x + 1] << 8;
        to[x] = (uint8_t)((v > top ? top : v) >> shift);
    }
}

/* Luma of ITU-R BT.601, in 256ths; `red` is the offset of the red byte, 0 or 2. */
static void mix_colours(const uint8_t *from, uint32_t width, uint32_t red, uint8_t *to)
{
    for (uint32_t x = 0; x < width; x++, from += 3)
        to[x] = (uint8_t)((77u * from[red] + 150u * from[1] + 29u * from[2 - red] + 128u) >> 8);
}

void pf_pixels_to_grey(const pf_pixel_format *format, const uint8_t *from, uint32_t width, uint32_t height,
                       uint32_t stride, uint8_t *grey)
{
    for (uint32_t y = 0; y < height; y++, from += stride, grey += width) {
        switch (format->layout) {
        case PF_LAYOUT_LUMA:
            memcpy(grey, from, width);
            break;
        case PF_LAYOUT_LUMA_EVEN:
            for (uint32_t x = 0; x < width; x++)
                grey[x] = from[2 * x];
            break;
        case PF_LAYOUT_LUMA_ODD:
            for (uint32_t x = 0; x < width; x++)
                grey[x] = from[2 * x + 1];
            break;
        case PF_LAYOUT_WORDS:
            unpack_words(from, width, format->bits - 8, grey);
            break;
        case PF_LAYOUT_PACKED_10: /* the high eight bits are bytes of their own */
            for (uint32_t x = 0; x < width; x++)
                grey[x] = from[x / 4 * 5 + x % 4];
            break;
        case PF_LAYOUT_PACKED_12:
            for (uint32_t x = 0; x < width; x++)
                grey[x] = from[x / 2 * 3 + x % 2];
            break;
        case PF_LAYOUT_RGB:
            mix_colours(from, width, 0, grey);
            break;
        case PF_LAYOUT_BGR:
            mix_colours(from, width, 2, grey);
            break;
        case PF_LAYOUT_JPEG:
            return;
        }
    }
}

/* Whether the end marker is there, whatever a camera puts after it: a frame that was cut short on its way has none, and
 * the decoder makes grey of what is missing. */
static bool is_whole(const uint8_t *from, size_t n)
{
    while (n >= 2 && !(from[n - 2] == 0xFF && from[n - 1] == 0xD9))
        n--;
    return n >= 2;
}

pf_status pf_jpeg_to_grey(void *turbo, const uint8_t *from, size_t n, uint32_t width, uint32_t height, uint8_t *grey,
                          pf_failure *failure)
{
    int w, h, sampling, space;
    if (tjDecompressHeader3(turbo, from, (unsigned long)n, &w, &h, &sampling, &space) != 0)
        return pf_fail(failure, PF_ERR_CHECKSUM, "a frame's JPEG is damaged: %s", tjGetErrorStr2(turbo));
    if (w != (int)width || h != (int)height)
        return pf_fail(failure, PF_ERR_CHECKSUM, "a frame's JPEG is of %d x %d", w, h);
    if (!is_whole(from, n))
        return pf_fail(failure, PF_ERR_CHECKSUM, "a frame's JPEG is cut short");
    /* Warnings are damage, but for bytes too many before a marker, with which some cameras pad. */
    if (tjDecompress2(turbo, from, (unsigned long)n, grey, w, w, h, TJPF_GRAY, 0) != 0 &&
        (tjGetErrorCode(turbo) == TJERR_FATAL || strstr(tjGetErrorStr2(turbo), "extraneous bytes") == NULL))
        return pf_fail(failure, PF_ERR_CHECKSUM, "a frame's JPEG is damaged: %s", tjGetErrorStr2(turbo));
    return PF_OK;
}

bool pf_mapping_keep(void *memory, size_t n)
{
    void *copy = mmap(NULL, n, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (copy == MAP_FAILED)
        return false;
    memcpy(copy, memory, n);
    if (mremap(copy, n, n, MREMAP_MAYMOVE | MREMAP_FIXED, memory) == memory)
        return true;
    (void)munmap(copy, n);
    return false;
}
