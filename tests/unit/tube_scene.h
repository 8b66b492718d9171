/* A textured tube as an equidistant fisheye on its axis sees it: what the tracker's tests on states, masks and
 * prediction drive through. Positions are known in closed form. */
#ifndef PIPEFISH_TEST_TUBE_SCENE_H
#define PIPEFISH_TEST_TUBE_SCENE_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "pipefish/track.h"

#define TUBE_W      320
#define TUBE_H      240
#define TUBE_CIRCLE 116.0
#define TUBE_FOCAL  75.0 /* px/rad: the circle lies at 88.6 degrees */
#define TUBE_TEXELS 512
#define TUBE_RADIUS (TUBE_TEXELS / 6.283185307179586) /* texels */
#define TUBE_PI     3.14159265358979323846

typedef struct tube_view {
    double z;          /* how far in the camera is, texels along the axis: 81.5 are a radius */
    double roll;       /* rad */
    double gain, bias; /* of the picture */
    double contrast;   /* of the texture; 1 = sigma 30 */
    double noise;      /* sigma, grey */
} tube_view;

static const tube_view tube_usual = {0, 0, 1, 0, 1, 2};

static float tube_texture[TUBE_TEXELS][TUBE_TEXELS];
static float tube_along[TUBE_H][TUBE_W], tube_around[TUBE_H][TUBE_W], tube_fade[TUBE_H][TUBE_W];
static float tube_noise[1 << 16];
static uint32_t tube_seed;

static inline double tube_uniform(void)
{
    tube_seed = tube_seed * 1664525u + 1013904223u;
    return (double)(tube_seed >> 8) / 16777216.0;
}

/* Noise of sigma 1: the sum of four uniform numbers, near enough to normal. */
static inline double tube_normal(void)
{
    return (tube_uniform() + tube_uniform() + tube_uniform() + tube_uniform() - 2) * 1.7320508;
}

/* Random blobs of three sizes, periodic both ways. */
static inline void tube_make(void)
{
    static float scratch[TUBE_TEXELS][TUBE_TEXELS];
    tube_seed = 99;
    memset(tube_texture, 0, sizeof tube_texture);
    for (int size = 2; size <= 8; size *= 2) {
        double sum = 0, square = 0;
        for (int i = 0; i < TUBE_TEXELS * TUBE_TEXELS; i++)
            (&scratch[0][0])[i] = (float)tube_normal();
        for (int pass = 0; pass < 6; pass++)
            for (int y = 0; y < TUBE_TEXELS; y++) {
                float line[TUBE_TEXELS];
                for (int x = 0; x < TUBE_TEXELS; x++) {
                    line[x] = 0;
                    for (int k = 0; k < size; k++)
                        line[x] += pass % 2 ? scratch[(x + k) % TUBE_TEXELS][y] : scratch[y][(x + k) % TUBE_TEXELS];
                }
                for (int x = 0; x < TUBE_TEXELS; x++)
                    *(pass % 2 ? &scratch[x][y] : &scratch[y][x]) = line[x];
            }
        for (int i = 0; i < TUBE_TEXELS * TUBE_TEXELS; i++) {
            sum += (&scratch[0][0])[i];
            square += (double)(&scratch[0][0])[i] * (&scratch[0][0])[i];
        }
        const double n = TUBE_TEXELS * TUBE_TEXELS, sigma = sqrt(square / n - sum / n * (sum / n));
        for (int i = 0; i < TUBE_TEXELS * TUBE_TEXELS; i++)
            (&tube_texture[0][0])[i] += (float)(17.3 / sigma) * (&scratch[0][0])[i];
    }
    for (int i = 0; i < 1 << 16; i++)
        tube_noise[i] = (float)tube_normal();
    for (int y = 0; y < TUBE_H; y++)
        for (int x = 0; x < TUBE_W; x++) {
            const double dx = x - TUBE_W / 2, dy = y - TUBE_H / 2, theta = hypot(dx, dy) / TUBE_FOCAL;
            tube_around[y][x] = (float)(atan2(dy, dx) * TUBE_RADIUS);
            const double far = theta < 0.05 ? 1e9 : TUBE_RADIUS / tan(theta < 1.55 ? theta : 1.55);
            tube_along[y][x] = (float)far;
            tube_fade[y][x] = far < 8 * TUBE_RADIUS && hypot(dx, dy) < TUBE_CIRCLE
                                  ? (float)(1 / (1 + far * far / (9 * TUBE_RADIUS * TUBE_RADIUS)))
                                  : 0;
        }
}

static inline double tube_wall(double along, double around)
{
    const double u = along + 1024 * TUBE_TEXELS, v = around + 1024 * TUBE_TEXELS; /* positive */
    const int i = (int)u % TUBE_TEXELS, j = (int)v % TUBE_TEXELS;
    const int i1 = (i + 1) % TUBE_TEXELS, j1 = (j + 1) % TUBE_TEXELS;
    const double a = u - (int)u, b = v - (int)v;
    return (1 - b) * ((1 - a) * tube_texture[j][i] + a * tube_texture[j][i1]) +
           b * ((1 - a) * tube_texture[j1][i] + a * tube_texture[j1][i1]);
}

static inline void tube_render(uint8_t *out, const tube_view *view)
{
    const uint32_t at = (uint32_t)(tube_uniform() * 65536);
    for (int y = 0; y < TUBE_H; y++)
        for (int x = 0; x < TUBE_W; x++) {
            double v = 0;
            if (tube_fade[y][x] > 0)
                v = tube_fade[y][x] * (130 + view->contrast * tube_wall(tube_along[y][x] + view->z,
                                                                        tube_around[y][x] - view->roll * TUBE_RADIUS));
            v = view->gain * v + view->bias + view->noise * tube_noise[(at + (uint32_t)(y * TUBE_W + x)) & 0xFFFFu];
            out[y * TUBE_W + x] = (uint8_t)(v < 0 ? 0 : v > 255 ? 255 : lrint(v));
        }
}

/* Where the wall point seen at p in view `a` lies in view `b`. */
static inline void tube_move(const double p[2], const tube_view *a, const tube_view *b, double q[2])
{
    const double dx = p[0] - TUBE_W / 2, dy = p[1] - TUBE_H / 2, theta = hypot(dx, dy) / TUBE_FOCAL;
    const double along = TUBE_RADIUS / tan(theta) - (b->z - a->z), around = atan2(dy, dx) + b->roll - a->roll;
    const double r = TUBE_FOCAL * atan2(TUBE_RADIUS, along);
    q[0] = TUBE_W / 2 + r * cos(around);
    q[1] = TUBE_H / 2 + r * sin(around);
}

static const pf_tracker_config tube_config = {.width = TUBE_W,
                                              .height = TUBE_H,
                                              .max_tracks = 80,
                                              .window = 15,
                                              .circle = {(TUBE_W / 2) << 16, (TUBE_H / 2) << 16},
                                              .circle_radius_q16 = (uint32_t)TUBE_CIRCLE << 16};

#endif
