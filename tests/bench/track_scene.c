#include "track_scene.h"

#include <stdbool.h>

#define TEXTURE 1024u

static uint8_t texture[TEXTURE * TEXTURE];
static bool made;

static uint32_t next_random(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 16;
}

/* Random dots, box-filtered along both directions. */
static void make_texture(void)
{
    uint32_t state = 7;
    made = true;
    for (uint32_t i = 0; i < TEXTURE * TEXTURE; i++)
        texture[i] = next_random(&state) % 6u == 0 ? 255 : 0;
    for (uint32_t pass = 0; pass < 4; pass++) {
        const uint32_t step = pass % 2u ? TEXTURE : 1u;
        for (uint32_t i = 0; i < TEXTURE * TEXTURE; i++) {
            uint32_t sum = 0;
            for (uint32_t k = 0; k < 4u; k++)
                sum += texture[(i + k * step) % (TEXTURE * TEXTURE)];
            texture[i] = (uint8_t)(sum / 4u);
        }
    }
}

void track_scene_frame(uint8_t *out, int width, int height, int radius, double zoom, uint32_t seed)
{
    uint32_t state = seed;
    if (!made)
        make_texture();
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            const int dx = x - width / 2, dy = y - height / 2;
            int v = 10;
            if (!radius || dx * dx + dy * dy <= radius * radius) {
                const int32_t u = (int32_t)((5000 + dx / zoom) * 256), w = (int32_t)((5000 + dy / zoom) * 256);
                const int a = u & 255, b = w & 255;
                const uint32_t x0 = (uint32_t)(u >> 8) % TEXTURE, y0 = (uint32_t)(w >> 8) % TEXTURE;
                const uint32_t x1 = (x0 + 1u) % TEXTURE, y1 = (y0 + 1u) % TEXTURE;
                const int top = texture[y0 * TEXTURE + x0] * (256 - a) + texture[y0 * TEXTURE + x1] * a;
                const int bottom = texture[y1 * TEXTURE + x0] * (256 - a) + texture[y1 * TEXTURE + x1] * a;
                v = 60 + (((top * (256 - b) + bottom * b) >> 16) * 3 / 2);
            }
            v += (int)(next_random(&state) % 7u) - 3;
            out[y * width + x] = (uint8_t)(v < 0 ? 0 : v > 255 ? 255 : v);
        }
}
