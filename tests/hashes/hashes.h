/* One hash per room: a fixed piece of work, its results through CRC-32C, the same constant on every target. The work is
 * made of integers (and of doubles that are integers), so nothing but the room itself can differ.
 * Does not prove that the results are right: the unit tests do. */
#ifndef PIPEFISH_TESTS_HASHES_H
#define PIPEFISH_TESTS_HASHES_H

#include "pipefish/base.h"

/* The constants: a room that changes what it computes changes its line. */
#define HASH_PYRAMID      0xE7D88B04u
#define HASH_CAMERA_REAL  0xC2558C27u
#define HASH_CAMERA_FIXED 0x38143ED2u
#define HASH_TRACK        0x9566bdeeu
#define HASH_LINK         0x168E8C19u
#define HASH_PROFILE      0xC3F18A3Fu

/* Each returns its room's hash, and through *ram the bytes of workspace and tables that the caller had to lend. */
uint32_t hash_pyramid(size_t *ram);
uint32_t hash_camera_real(size_t *ram);
uint32_t hash_camera_fixed(size_t *ram);
uint32_t hash_track(size_t *ram);
uint32_t hash_link(size_t *ram);
uint32_t hash_profile(size_t *ram);

static inline uint32_t hash_u32(uint32_t crc, uint32_t v)
{
    const uint8_t bytes[4] = {(uint8_t)v, (uint8_t)(v >> 8), (uint8_t)(v >> 16), (uint8_t)(v >> 24)};
    return pf_crc32c(crc, bytes, 4);
}

static inline uint32_t hash_double(uint32_t crc, double v)
{
    union {
        double value;
        uint64_t bits;
    } u = {v};
    return hash_u32(hash_u32(crc, (uint32_t)u.bits), (uint32_t)(u.bits >> 32));
}

static inline uint32_t hash_random(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 8;
}

#endif
