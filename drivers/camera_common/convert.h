/* Pixel formats of cameras as grey bytes, without a device. All sizes are checked: a driver may hand over less than it
 * announced. */
#ifndef PIPEFISH_CAMERA_CONVERT_H
#define PIPEFISH_CAMERA_CONVERT_H

#include "common/failure.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum pf_layout {
    PF_LAYOUT_LUMA = 0,  /* a plane of grey bytes first: GREY, NV12, NV21, YU12. Used where it lies */
    PF_LAYOUT_LUMA_EVEN, /* a grey byte, a colour byte: YUYV */
    PF_LAYOUT_LUMA_ODD,  /* the other way round: UYVY */
    PF_LAYOUT_WORDS,     /* 16 bits little-endian, the significant ones low: Y10, Y12 */
    PF_LAYOUT_PACKED_10, /* four pixels in five bytes, the fifth has the low bits: Y10P */
    PF_LAYOUT_PACKED_12, /* two pixels in three bytes: Y12P */
    PF_LAYOUT_RGB,       /* red, green, blue bytes: RGB3 */
    PF_LAYOUT_BGR,       /* the other way round: BGR3 */
    PF_LAYOUT_JPEG,      /* MJPEG: a JPEG a frame */
} pf_layout;

typedef struct pf_pixel_format {
    uint32_t fourcc; /* V4L2_PIX_FMT_* */
    char name[8];    /* as in camera.format */
    pf_layout layout;
    uint32_t bits; /* significant bits of a pixel */
} pf_pixel_format;

/* All formats that are read, best first: no copy and no loss, then no loss of what 8 bits hold, then MJPEG. */
const pf_pixel_format *pf_pixel_formats(uint32_t *n);

const pf_pixel_format *pf_pixel_format_find(uint32_t fourcc); /* NULL: not read */
const pf_pixel_format *pf_pixel_format_named(const char *name);

/* Fewest bytes between two rows; 0 for MJPEG. */
uint32_t pf_pixel_format_row(const pf_pixel_format *format, uint32_t width);

/* Whether n bytes hold a frame whose rows lie `stride` bytes apart; a last row need not be padded. MJPEG: any n > 0. */
bool pf_pixel_format_fits(const pf_pixel_format *format, uint32_t width, uint32_t height, uint32_t stride, size_t n);

/* Writes width x height grey bytes. Not for MJPEG, and the frame must fit. */
void pf_pixels_to_grey(const pf_pixel_format *format, const uint8_t *from, uint32_t width, uint32_t height,
                       uint32_t stride, uint8_t *grey);

/* The same for a JPEG of n bytes; `turbo` is a handle of tjInitDecompress. PF_OK; PF_ERR_CHECKSUM (damaged, or of
 * another size). */
pf_status pf_jpeg_to_grey(void *turbo, const uint8_t *from, size_t n, uint32_t width, uint32_t height, uint8_t *grey,
                          pf_failure *failure);

/* Puts memory of our own, with the same bytes, where a mapping was: as long as one is left the device counts as open,
 * and a camera that is plugged in again gets another name. Readers of other threads notice nothing. False: no memory;
 * the mapping is as it was. */
bool pf_mapping_keep(void *memory, size_t n);

#ifdef __cplusplus
}
#endif

#endif
