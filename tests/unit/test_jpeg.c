#include "pipefish/drivers/jpeg.h"
#include "pipefish/drivers/sha256.h"
#include "unity.h"

#include <stdlib.h>
#include <string.h>
#include <turbojpeg.h>

void setUp(void) {}
void tearDown(void) {}

#define W 203u
#define H 117u

static uint8_t pixels[H * 256], decoded[W * H];
static const pf_image image = {pixels, W, H, 256};
static char error[256];

/* A smooth picture, which JPEG keeps well, with rubbish in the padding of its rows. */
static void paint(void)
{
    for (uint32_t y = 0; y < H; y++)
        for (uint32_t x = 0; x < 256; x++)
            pixels[y * 256 + x] = (uint8_t)(x < W ? 60 + x / 2 + y / 2 : (x * 37 + y * 91) & 255);
}

static void decode(const uint8_t *bytes, size_t n, uint32_t width, uint32_t height)
{
    int w, h, subsampling, colour;
    tjhandle turbo = tjInitDecompress();
    TEST_ASSERT_EQUAL_INT(0, tjDecompressHeader3(turbo, bytes, n, &w, &h, &subsampling, &colour));
    TEST_ASSERT_EQUAL_INT((int)width, w);
    TEST_ASSERT_EQUAL_INT((int)height, h);
    TEST_ASSERT_EQUAL_INT(TJSAMP_GRAY, subsampling);
    TEST_ASSERT_EQUAL_INT(0, tjDecompress2(turbo, bytes, n, decoded, w, w, h, TJPF_GRAY, 0));
    tjDestroy(turbo);
}

/* Proves: a frame with a stride comes back as it was, and the caller's pixels are not touched. Quality 100 quantises
 * by 1: a pixel is off by 2 at most here. */
static void test_frame_survives(void)
{
    pf_jpeg *jpeg = NULL;
    pf_jpeg_config config = {.width = W, .height = H, .quality = 100, .preview_quality = 50};
    const uint8_t *bytes;
    size_t n;
    static uint8_t before[sizeof pixels];
    paint();
    memcpy(before, pixels, sizeof pixels);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_open(&jpeg, &config, error, sizeof error));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode(jpeg, &image, &bytes, &n));
    decode(bytes, n, W, H);
    for (uint32_t y = 0; y < H; y++)
        for (uint32_t x = 0; x < W; x++)
            TEST_ASSERT_INT_WITHIN(2, pixels[y * 256 + x], decoded[y * W + x]);
    TEST_ASSERT_EQUAL_MEMORY(before, pixels, sizeof pixels);
    pf_jpeg_close(jpeg);
}

/* Proves: outside the image circle it is black, inside it is the picture; also where the circle leaves the image, and
 * for a second frame. Pixels whose 8x8 block has both may ring: only blocks of one kind are looked at. */
static void test_circle_masks_the_outside(void)
{
    static const double circles[][3] = {{100, 58, 50}, {20, 30, 80}, {-10, 200, 120}, {100, 58, 1000}, {500, 500, 10}};
    paint();
    for (size_t k = 0; k < sizeof circles / sizeof circles[0]; k++) {
        double u = circles[k][0], v = circles[k][1], r = circles[k][2];
        pf_jpeg *jpeg = NULL;
        pf_jpeg_config config = {.width = W, .height = H, .quality = 100, .preview_quality = 90};
        config.circle_u = u, config.circle_v = v, config.circle_radius = r;
        const uint8_t *bytes;
        size_t n;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_open(&jpeg, &config, error, sizeof error));
        for (int again = 0; again < 2; again++)
            TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode(jpeg, &image, &bytes, &n));
        decode(bytes, n, W, H);
        for (uint32_t by = 0; by + 8 <= H; by += 8)
            for (uint32_t bx = 0; bx + 8 <= W; bx += 8) {
                int inside = 0;
                for (uint32_t y = by; y < by + 8; y++)
                    for (uint32_t x = bx; x < bx + 8; x++)
                        inside += (x - u) * (x - u) + (y - v) * (y - v) <= r * r;
                for (uint32_t y = by; y < by + 8 && (inside == 0 || inside == 64); y++)
                    for (uint32_t x = bx; x < bx + 8; x++)
                        TEST_ASSERT_INT_WITHIN(2, inside == 0 ? 0 : pixels[y * 256 + x], decoded[y * W + x]);
            }
        pf_jpeg_close(jpeg);
    }
}

/* Proves: a preview pixel is the mean of the 4 x 4 it covers, also at the ragged right and lower border. */
static void test_preview_is_the_mean(void)
{
    pf_jpeg_preview preview;
    pf_jpeg *jpeg = NULL;
    pf_jpeg_config config = {.width = W, .height = H, .quality = 80, .preview_quality = 100};
    const uint8_t *bytes;
    size_t n;
    uint32_t w = (W + 3) / 4, h = (H + 3) / 4;
    paint();
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_open(&jpeg, &config, error, sizeof error));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode_preview(jpeg, &image, 1 << 20, &preview));
    bytes = preview.bytes;
    n = preview.n;
    decode(bytes, n, w, h);
    for (uint32_t y = 0; y < h; y++)
        for (uint32_t x = 0; x < w; x++) {
            double sum = 0, count = 0;
            for (uint32_t v = 4 * y; v < 4 * y + 4 && v < H; v++)
                for (uint32_t u = 4 * x; u < 4 * x + 4 && u < W; u++)
                    sum += pixels[v * 256 + u], count++;
            TEST_ASSERT_DOUBLE_WITHIN(2.5, sum / count, decoded[y * w + x]);
        }
    pf_jpeg_close(jpeg);
}

/* Proves: a preview that is too large is made again with less until it fits, and the next one begins there. */
static void test_preview_is_made_to_fit(void)
{
    pf_jpeg_preview first, preview;
    pf_jpeg *jpeg = NULL;
    pf_jpeg_config config = {.width = W, .height = H, .quality = 80, .preview_quality = 100};
    paint();
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_open(&jpeg, &config, error, sizeof error));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode_preview(jpeg, &image, 1 << 20, &first));
    size_t most = first.n, whole = first.n;
    while (most > whole / 4 && most > 400) {
        most -= 20;
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode_preview(jpeg, &image, most, &preview));
        TEST_ASSERT_TRUE(preview.n <= most);
        decode(preview.bytes, preview.n, (W + preview.shrink - 1) / preview.shrink,
               (H + preview.shrink - 1) / preview.shrink);
    }
    TEST_ASSERT_TRUE(preview.quality < 100);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode_preview(jpeg, &image, 1 << 20, &first));
    TEST_ASSERT_EQUAL_UINT32(preview.quality, first.quality);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_jpeg_encode_preview(jpeg, &image, 10, &preview));
    pf_jpeg_close(jpeg);
}

/* Proves: noise at quality 100, the worst case, fits the memory taken at opening. */
static void test_worst_case_fits(void)
{
    pf_jpeg_preview preview;
    pf_jpeg *jpeg = NULL;
    pf_jpeg_config config = {.width = W, .height = H, .quality = 100, .preview_quality = 100};
    const uint8_t *bytes;
    size_t n;
    uint32_t random = 1;
    for (size_t i = 0; i < sizeof pixels; i++) {
        random = random * 1664525u + 1013904223u;
        pixels[i] = random >> 31 ? 255 : 0;
    }
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_open(&jpeg, &config, error, sizeof error));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode(jpeg, &image, &bytes, &n));
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_encode_preview(jpeg, &image, 1 << 20, &preview));
    bytes = preview.bytes;
    n = preview.n;
    pf_jpeg_close(jpeg);
}

/* Proves: wrong settings and frames of another size are refused in words. */
static void test_wrong_arguments_are_refused(void)
{
    static const pf_jpeg_config wrong[] = {
        {.width = 0, .height = 10, .quality = 80, .preview_quality = 50},
        {.width = 10, .height = 16385, .quality = 80, .preview_quality = 50},
        {.width = 10, .height = 10, .quality = 0, .preview_quality = 50},
        {.width = 10, .height = 10, .quality = 80, .preview_quality = 101},
        {.width = 10, .height = 10, .quality = 80, .preview_quality = 50, .circle_radius = -1},
    };
    pf_jpeg *jpeg = NULL;
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++) {
        error[0] = '\0';
        TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_jpeg_open(&jpeg, &wrong[i], error, sizeof error));
        TEST_ASSERT_NULL(jpeg);
        TEST_ASSERT_TRUE(error[0] != '\0');
    }
    pf_jpeg_config config = {.width = 10, .height = 10, .quality = 80, .preview_quality = 50};
    const uint8_t *bytes;
    size_t n;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_jpeg_open(&jpeg, &config, error, sizeof error));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_jpeg_encode(jpeg, &image, &bytes, &n));
    TEST_ASSERT_NOT_NULL(strstr(pf_jpeg_error(jpeg), "203 x 117"));
    pf_jpeg_close(jpeg);
}

/* Proves: SHA-256 is the published function (FIPS 180-4, "abc"), and an image's hash does not see its padding. */
static void test_sha256(void)
{
    static const uint8_t abc[32] = {0xba, 0x78, 0x16, 0xbf, 0x8f, 0x01, 0xcf, 0xea, 0x41, 0x41, 0x40,
                                    0xde, 0x5d, 0xae, 0x22, 0x23, 0xb0, 0x03, 0x61, 0xa3, 0x96, 0x17,
                                    0x7a, 0x9c, 0xb4, 0x10, 0xff, 0x61, 0xf2, 0x00, 0x15, 0xad};
    uint8_t hash[32];
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256("abc", 3, hash));
    TEST_ASSERT_EQUAL_MEMORY(abc, hash, 32);
    pf_image padded = {(const uint8_t *)"axxbyyczz", 1, 3, 3}, packed = {(const uint8_t *)"abc", 3, 1, 3};
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256_image(&padded, hash));
    TEST_ASSERT_EQUAL_MEMORY(abc, hash, 32);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256_image(&packed, hash));
    TEST_ASSERT_EQUAL_MEMORY(abc, hash, 32);
    padded.stride = 0;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_sha256_image(&padded, hash));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_frame_survives);
    RUN_TEST(test_circle_masks_the_outside);
    RUN_TEST(test_preview_is_the_mean);
    RUN_TEST(test_preview_is_made_to_fit);
    RUN_TEST(test_worst_case_fits);
    RUN_TEST(test_wrong_arguments_are_refused);
    RUN_TEST(test_sha256);
    return UNITY_END();
}
