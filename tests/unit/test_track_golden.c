/* One integer-generated sequence, replayed on every target: the same constant must come out of x86 with and without
 * sanitizers, aarch64 and Cortex-M7. Proves: tracks, covariances and keyframe choices are the same bits everywhere.
 * Does not prove that they are right: test_track does. */
#include "pipefish/track.h"
#include "unity.h"

#define WIDTH   320
#define HEIGHT  240
#define TEXTURE 512
#define FRAMES  60
#define GOLDEN  0x9BDA1CBDu

static uint8_t texture[TEXTURE * TEXTURE], frame[2][WIDTH * HEIGHT];
static _Alignas(16) uint8_t workspace[400000];
static pf_keyframe_state keyframes;
static pf_ray_q30 rays[PF_TRACKS_MAX];

void setUp(void) {}
void tearDown(void) {}

static uint32_t next_random(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state >> 16;
}

/* Random dots, box-filtered twice: corners of a few pixels. */
static void make_texture(void)
{
    uint32_t state = 7;
    for (uint32_t i = 0; i < TEXTURE * TEXTURE; i++)
        texture[i] = next_random(&state) % 5u == 0 ? 255 : 0;
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

/* Frame k: the texture scaled (zooming in), turned and shifted a little more each frame, under light that swells and
 * fades, with noise. Integers only. */
static void make_frame(uint32_t k, uint8_t *out)
{
    const int32_t i = (int32_t)k, scale = 65536 - 350 * i, turn = 150 * i, light = 200 + 3 * (i % 20);
    uint32_t state = 1000u + k;
    for (int32_t y = 0; y < HEIGHT; y++)
        for (int32_t x = 0; x < WIDTH; x++) {
            const int32_t dx = x - WIDTH / 2, dy = y - HEIGHT / 2;
            const int32_t u = (256 << 16) + dx * scale - dy * turn + i * 50000;
            const int32_t v = (256 << 16) + dx * turn + dy * scale + i * 20000;
            const uint8_t *p = texture + (v >> 16) * TEXTURE + (u >> 16);
            const int32_t a = (u >> 8) & 255, b = (v >> 8) & 255;
            const int32_t top = p[0] * (256 - a) + p[1] * a, bottom = p[TEXTURE] * (256 - a) + p[TEXTURE + 1] * a;
            const int32_t value = (((top * (256 - b) + bottom * b) >> 16) * light >> 7) + 10;
            const int32_t noisy = value + (int32_t)(next_random(&state) % 5u) - 2;
            out[y * WIDTH + x] = (uint8_t)(noisy > 255 ? 255 : noisy < 0 ? 0 : noisy);
        }
}

static uint32_t hash_u32(uint32_t crc, uint32_t v)
{
    const uint8_t bytes[4] = {(uint8_t)v, (uint8_t)(v >> 8), (uint8_t)(v >> 16), (uint8_t)(v >> 24)};
    return pf_crc32c(crc, bytes, 4);
}

static uint32_t hash_track(uint32_t crc, const pf_track *t)
{
    crc = hash_u32(crc, (uint32_t)t->id);
    crc = hash_u32(crc, (uint32_t)t->pos.x);
    crc = hash_u32(crc, (uint32_t)t->pos.y);
    crc = hash_u32(crc, t->cov_xx_q20);
    crc = hash_u32(crc, t->cov_yy_q20);
    crc = hash_u32(crc, (uint32_t)t->cov_xy_q20);
    crc = hash_u32(crc, t->age);
    return hash_u32(crc, (uint32_t)t->status | (uint32_t)t->reason << 8 | (uint32_t)t->quality << 16);
}

static void test_replayed_sequence_has_the_golden_hash(void)
{
    const pf_tracker_config config = {.width = WIDTH,
                                      .height = HEIGHT,
                                      .max_tracks = 60,
                                      .window = 15,
                                      .circle = {(WIDTH / 2) << 16, (HEIGHT / 2) << 16},
                                      .circle_radius_q16 = 150u << 16};
    const pf_keyframe_config choice = {.step_counts = 30, .parallax_urad = 60000, .min_common = 40};
    pf_tracker *tracker;
    uint32_t crc = 0, tracked = 0, chosen = 0;
    make_texture();
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_init(&tracker, &config, workspace, sizeof workspace));
    for (uint32_t k = 0; k < FRAMES; k++) {
        const pf_image image = {frame[k % 2u], WIDTH, HEIGHT, WIDTH};
        make_frame(k, frame[k % 2u]);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_tracker_frame(tracker, &image, NULL, NULL));
        uint32_t n, common;
        const pf_track *tracks = pf_tracker_tracks(tracker, &n);
        for (uint32_t i = 0; i < n; i++) {
            crc = hash_track(crc, &tracks[i]);
            /* directions, roughly of unit length, as a 120-pixel-per-radian camera would see them */
            rays[i] =
                (pf_ray_q30){(tracks[i].pos.x - (160 << 16)) * 100, (tracks[i].pos.y - (120 << 16)) * 100, 900000000};
        }
        const int64_t encoder = 7 * (int64_t)k;
        const pf_keyframe_cause cause =
            pf_keyframe_decide(&keyframes, &choice, tracks, rays, n, k < 40 ? NULL : &encoder, &common);
        crc = hash_u32(crc, (uint32_t)cause << 16 | common);
        chosen += cause != PF_KEYFRAME_NO;
        tracked += pf_tracker_last_stats(tracker)->tracked;
    }
    TEST_ASSERT_GREATER_THAN_UINT32(FRAMES * 30, tracked);
    TEST_ASSERT_GREATER_THAN_UINT32(5, chosen);
    TEST_ASSERT_EQUAL_HEX32(GOLDEN, crc);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_replayed_sequence_has_the_golden_hash);
    return UNITY_END();
}
