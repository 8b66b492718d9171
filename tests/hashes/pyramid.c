#include "hashes.h"
#include "pipefish/image.h"

enum { WIDTH = 97, HEIGHT = 71, LEVELS = 4 };

static uint8_t frame[WIDTH * HEIGHT];
static _Alignas(16) uint8_t workspace[4096];

uint32_t hash_pyramid(size_t *ram)
{
    const pf_image image = {frame, WIDTH, HEIGHT, WIDTH};
    pf_pyramid pyramid;
    uint32_t state = 1, crc = 0;
    for (uint32_t i = 0; i < sizeof frame; i++)
        frame[i] = (uint8_t)hash_random(&state);
    *ram = pf_pyramid_workspace_size(WIDTH, HEIGHT, LEVELS);
    if (pf_pyramid_init(&pyramid, WIDTH, HEIGHT, LEVELS, workspace, sizeof workspace) != PF_OK ||
        pf_pyramid_build(&pyramid, &image) != PF_OK)
        return 0;
    for (uint32_t l = 0; l < LEVELS; l++)
        for (uint32_t y = 0; y < pyramid.level[l].height; y++)
            crc = pf_crc32c(crc, pyramid.level[l].data + (size_t)y * pyramid.level[l].stride, pyramid.level[l].width);
    return crc;
}
