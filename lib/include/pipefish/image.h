/* Images: borrowed views of 8-bit grey pixels, and pyramids of them. Integers only; bit-exact on all targets. */
#ifndef PIPEFISH_IMAGE_H
#define PIPEFISH_IMAGE_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_IMAGE_SIZE_MAX     16384u
#define PF_PYRAMID_LEVELS_MAX 6u

/* A view; pixel (x, y) is data[y * stride + x]. Owns nothing. */
typedef struct pf_image {
    const uint8_t *data;
    uint32_t width, height, stride; /* stride >= width */
} pf_image;

/* level[0] is the caller's frame (borrowed, not copied); each further level is half the size of the one before,
 * rounded up, filtered with the binomial (1 4 6 4 1)/16 in both directions, rounded, borders mirrored (gfedcb|abc...).
 * Pixel (x, y) of level l lies over pixel (2x, 2y) of level l - 1. */
typedef struct pf_pyramid {
    uint32_t levels;
    pf_image level[PF_PYRAMID_LEVELS_MAX];
    /* private: where the caller's block is written */
    uint8_t *store[PF_PYRAMID_LEVELS_MAX];
    uint16_t *row;
} pf_pyramid;

/* Bytes that pf_pyramid_init needs for frames of this size; 0 if the arguments are out of range. */
size_t pf_pyramid_workspace_size(uint32_t width, uint32_t height, uint32_t levels);

/* Lays a pyramid into the caller's block. Returns PF_OK, PF_ERR_ARGUMENT, PF_ERR_SPACE. */
pf_status pf_pyramid_init(pf_pyramid *pyramid, uint32_t width, uint32_t height, uint32_t levels, void *workspace,
                          size_t size);

/* Fills the pyramid from `frame`, which must have the size given at init and stay valid and unchanged for as long as
 * the pyramid is used. Returns PF_OK, PF_ERR_ARGUMENT. */
pf_status pf_pyramid_build(pf_pyramid *pyramid, const pf_image *frame);

#ifdef __cplusplus
}
#endif
#endif
