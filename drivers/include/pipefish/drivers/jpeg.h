/* Grey JPEGs of frames (libjpeg-turbo), with the outside of the image circle blackened: it carries no picture, only
 * noise, and costs a tenth of the bytes. All memory is taken at opening. One thread at a time.
 */
#ifndef PIPEFISH_DRIVERS_JPEG_H
#define PIPEFISH_DRIVERS_JPEG_H

#include "pipefish/image.h"

#define PF_JPEG_PREVIEW_SHRINK 4u /* a preview pixel is the mean of 4 x 4, of fewer at the right and lower border */

typedef struct pf_jpeg_config {
    uint32_t width, height;                   /* pixels, 1..PF_IMAGE_SIZE_MAX */
    uint32_t quality;                         /* 1..100 */
    uint32_t preview_quality;                 /* 1..100 */
    double circle_u, circle_v, circle_radius; /* pixels (pf_camera's); radius 0 = no circle, everything is kept */
} pf_jpeg_config;

typedef struct pf_jpeg pf_jpeg;

/* On failure *jpeg is untouched and error[n] says what. PF_OK, PF_ERR_ARGUMENT, PF_ERR_SPACE (no memory), PF_ERR_IO. */
pf_status pf_jpeg_open(pf_jpeg **jpeg, const pf_jpeg_config *config, char *error, size_t n);
void pf_jpeg_close(pf_jpeg *jpeg); /* NULL is allowed */

/* Encodes a frame of the size given at opening. *bytes is the encoder's memory, valid until the next call of the same
 * function. A pixel is inside the circle if its centre is at most the radius away from the circle's centre.
 * PF_OK; PF_ERR_ARGUMENT (another size); PF_ERR_IO (libjpeg-turbo failed: pf_jpeg_error says how). */
pf_status pf_jpeg_encode(pf_jpeg *jpeg, const pf_image *image, const uint8_t **bytes, size_t *n);

typedef struct pf_jpeg_preview {
    const uint8_t *bytes; /* the encoder's memory */
    size_t n;
    uint32_t width, height, quality, shrink; /* as it was made */
} pf_jpeg_preview;

/* The same, shrunk to (width + 3) / 4 by (height + 3) / 4, in `most` bytes: what does not fit is made again at half the
 * quality, then at half the size, and so are all previews after it. Also PF_ERR_SPACE: no picture is that small. */
pf_status pf_jpeg_encode_preview(pf_jpeg *jpeg, const pf_image *image, size_t most, pf_jpeg_preview *preview);

/* The last failure in words; "" if there was none. */
const char *pf_jpeg_error(const pf_jpeg *jpeg);

#endif
