#include "replay.h"
#include "temporary.h"
#include "unity.h"

#include <math.h>
#include <png.h>
#include <sys/stat.h>
#include <turbojpeg.h>

static pf_camera_source camera;
static char error[512];
static pf_failure failure;

void setUp(void)
{
    temporary_make();
}

void tearDown(void)
{
    if (camera.self != NULL)
        camera.ops->close(camera.self);
    camera.self = NULL;
    temporary_remove();
}

#define W 19u
#define H 13u

static uint8_t encoded[65536];
static size_t encoded_size;
static uint8_t expected[W * H], decoded[W * H];

/* ---- fixtures ---- */

static void png_take(png_structp png, png_bytep bytes, png_size_t n)
{
    (void)png;
    TEST_ASSERT_TRUE(encoded_size + n <= sizeof encoded);
    memcpy(encoded + encoded_size, bytes, n);
    encoded_size += n;
}

static void png_flush_nothing(png_structp png)
{
    (void)png;
}

static uint32_t sample(uint32_t x, uint32_t y, uint32_t channel, uint32_t depth)
{
    return ((x * 2731 + y * 5923 + channel * 9173) * 7u) & ((1u << depth) - 1);
}

/* What the luma of the colour must be, in double precision: Rec. 601. */
static uint8_t luma(double r, double g, double b)
{
    return (uint8_t)lround(0.299 * r + 0.587 * g + 0.114 * b);
}

static const png_color palette[4] = {{0, 0, 0}, {255, 0, 0}, {10, 200, 30}, {255, 255, 255}};

/* Writes a PNG of this kind into `encoded`, and the grey picture it must give into `expected`. */
static void make_png(int type, uint32_t depth, bool interlaced, bool transparent)
{
    static uint8_t rows[H][W * 8 + 8];
    png_bytep pointers[H];
    uint32_t channels = type == PNG_COLOR_TYPE_RGB          ? 3
                        : type == PNG_COLOR_TYPE_RGB_ALPHA  ? 4
                        : type == PNG_COLOR_TYPE_GRAY_ALPHA ? 2
                                                            : 1;
    memset(rows, 0, sizeof rows);
    for (uint32_t y = 0; y < H; y++) {
        pointers[y] = rows[y];
        for (uint32_t x = 0; x < W; x++) {
            double value[4] = {0};
            for (uint32_t c = 0; c < channels; c++) {
                uint32_t v = sample(x, y, c, depth), i = x * channels + c;
                value[c] = round(v * 255.0 / ((1u << depth) - 1));
                if (depth == 16) {
                    rows[y][2 * i] = (uint8_t)(v >> 8);
                    rows[y][2 * i + 1] = (uint8_t)v;
                } else {
                    rows[y][i * depth / 8] |= (uint8_t)(v << (8 - depth - i * depth % 8));
                }
            }
            const png_color *p = &palette[sample(x, y, 0, depth) & 3];
            expected[y * W + x] = type == PNG_COLOR_TYPE_PALETTE ? luma(p->red, p->green, p->blue)
                                  : channels >= 3                ? luma(value[0], value[1], value[2])
                                                                 : (uint8_t)value[0];
        }
    }
    encoded_size = 0;
    png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, NULL, NULL, NULL);
    png_infop info = png_create_info_struct(png);
    png_set_write_fn(png, NULL, png_take, png_flush_nothing);
    png_set_IHDR(png, info, W, H, (int)depth, type, interlaced ? PNG_INTERLACE_ADAM7 : PNG_INTERLACE_NONE,
                 PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    if (type == PNG_COLOR_TYPE_PALETTE)
        png_set_PLTE(png, info, palette, 4);
    png_set_gAMA(png, info, 1 / 2.2); /* must not change the pixels */
    png_color_16 clear = {.index = 1, .gray = 1, .red = 1};
    if (transparent)
        png_set_tRNS(png, info, (const png_byte *)"\x10\x20", 2, &clear);
    png_write_info(png, info);
    png_write_image(png, pointers);
    png_write_end(png, NULL);
    png_destroy_write_struct(&png, &info);
}

static void make_jpeg(bool colour, int subsampling)
{
    static uint8_t pixels[W * H * 3];
    unsigned char *out = encoded;
    unsigned long size = sizeof encoded;
    for (uint32_t i = 0; i < W * H; i++) {
        uint8_t v = (uint8_t)(40 + i % W * 5 + i / W * 6);
        uint8_t rgb[3] = {v, (uint8_t)(v / 2 + 40), (uint8_t)(200 - v / 2)};
        memcpy(pixels + (colour ? 3 * i : i), colour ? rgb : &v, colour ? 3 : 1);
        expected[i] = colour ? luma(rgb[0], rgb[1], rgb[2]) : v;
    }
    tjhandle turbo = tjInitCompress();
    TEST_ASSERT_EQUAL_INT(0, tjCompress2(turbo, pixels, (int)W, 0, (int)H, colour ? TJPF_RGB : TJPF_GRAY, &out, &size,
                                         subsampling, 100, TJFLAG_NOREALLOC));
    tjDestroy(turbo);
    encoded_size = size;
}

static void make_pgm(const char *header, uint32_t max)
{
    encoded_size = (size_t)sprintf((char *)encoded, "%s", header);
    for (uint32_t i = 0; i < W * H; i++) {
        uint32_t v = i * 269 % (max + 1);
        if (max > 255)
            encoded[encoded_size++] = (uint8_t)(v >> 8);
        encoded[encoded_size++] = (uint8_t)v;
        expected[i] = (uint8_t)lround(v * 255.0 / max);
    }
}

/* Decodes bytes[n] from a block of exactly that size, so that the sanitizer sees a byte too far. */
static pf_status decode(const uint8_t *bytes, size_t n)
{
    uint8_t *exact = malloc(n > 0 ? n : 1);
    TEST_ASSERT_NOT_NULL(exact);
    memcpy(exact, bytes, n);
    pf_picture picture = {"some.img", exact, n, NULL, 0};
    uint32_t w = 0, h = 0;
    failure.text[0] = '\0';
    memset(decoded, 0x55, sizeof decoded);
    pf_status status = pf_picture_size(&picture, &w, &h, &failure);
    if (status == PF_OK && (w != W || h != H))
        status = pf_fail(&failure, PF_ERR_DOMAIN, "some.img: another size");
    if (status == PF_OK)
        status = pf_picture_decode(&picture, w, h, decoded, &failure);
    if (status != PF_OK)
        TEST_ASSERT_EQUAL_INT_MESSAGE(0, strncmp(failure.text, "some.img: ", 10), failure.text);
    free(picture.scratch);
    free(exact);
    return status;
}

static void expect_decoded(unsigned tolerance, const char *what)
{
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, decode(encoded, encoded_size), failure.text);
    for (uint32_t i = 0; i < W * H; i++)
        TEST_ASSERT_INT_WITHIN_MESSAGE(tolerance, expected[i], decoded[i], what);
}

/* ---- variants ---- */

/* Proves: every kind of PNG (grey, colour, palette, alpha, transparent colour, 1 to 16 bits, interlaced or not) gives
 * the grey that its samples say; 16-bit colour may round twice, hence 1. */
static void test_png_variants(void)
{
    static const struct {
        int type;
        uint32_t depth;
    } kinds[] = {
        {PNG_COLOR_TYPE_GRAY, 1},        {PNG_COLOR_TYPE_GRAY, 2},      {PNG_COLOR_TYPE_GRAY, 4},
        {PNG_COLOR_TYPE_GRAY, 8},        {PNG_COLOR_TYPE_GRAY, 16},     {PNG_COLOR_TYPE_RGB, 8},
        {PNG_COLOR_TYPE_RGB, 16},        {PNG_COLOR_TYPE_PALETTE, 2},   {PNG_COLOR_TYPE_GRAY_ALPHA, 8},
        {PNG_COLOR_TYPE_GRAY_ALPHA, 16}, {PNG_COLOR_TYPE_RGB_ALPHA, 8}, {PNG_COLOR_TYPE_RGB_ALPHA, 16},
    };
    for (size_t k = 0; k < sizeof kinds / sizeof kinds[0]; k++)
        for (int interlaced = 0; interlaced < 2; interlaced++)
            for (int transparent = 0; transparent < (kinds[k].type & PNG_COLOR_MASK_ALPHA ? 1 : 2); transparent++) {
                char what[64];
                (void)snprintf(what, sizeof what, "type %d depth %u interlaced %d tRNS %d", kinds[k].type,
                               kinds[k].depth, interlaced, transparent);
                make_png(kinds[k].type, kinds[k].depth, interlaced != 0, transparent != 0);
                expect_decoded(kinds[k].type & PNG_COLOR_MASK_COLOR && kinds[k].depth == 16 ? 1 : 0, what);
            }
}

/* Proves: grey and colour JPEGs give their luma; 2 for quantisation by 1 and the colour conversion. */
static void test_jpeg_variants(void)
{
    make_jpeg(false, TJSAMP_GRAY);
    expect_decoded(2, "grey");
    make_jpeg(true, TJSAMP_444);
    expect_decoded(2, "4:4:4");
    make_jpeg(true, TJSAMP_420);
    expect_decoded(2, "4:2:0");
}

/* Proves: PGM with comments, any highest value and 16 bits is scaled to 8 bits with rounding. */
static void test_pgm_variants(void)
{
    make_pgm("P5 19 13 255\n", 255);
    expect_decoded(0, "plain");
    make_pgm("P5\n# made by hand\n19 # width\n13\n255\n", 255);
    expect_decoded(0, "comments");
    make_pgm("P5\n19 13\n100\n", 100);
    expect_decoded(0, "100 steps");
    make_pgm("P5\n19 13\n4095\n", 4095);
    expect_decoded(0, "12 bits");
    make_pgm("P5\n19 13\n65535\n", 65535);
    expect_decoded(0, "16 bits");
    make_pgm("P5\n19 13\n100\n", 100);
    encoded[encoded_size - 1] = 101;
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, decode(encoded, encoded_size));
    make_pgm("P5 19 13 65536\n", 255);
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, decode(encoded, encoded_size));
    make_pgm("P5 19 99999 255\n", 255);
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, decode(encoded, encoded_size));
    make_pgm("P2 19 13 255\n", 255);
    TEST_ASSERT_EQUAL_INT(PF_ERR_FORMAT, decode(encoded, encoded_size));
}

/* ---- damage ---- */

static void make_kind(int kind)
{
    switch (kind) {
    case 0:
        make_png(PNG_COLOR_TYPE_GRAY, 8, false, false);
        break;
    case 1:
        make_png(PNG_COLOR_TYPE_RGB_ALPHA, 16, true, false);
        break;
    case 2:
        make_png(PNG_COLOR_TYPE_PALETTE, 2, true, true);
        break;
    case 3:
        make_jpeg(true, TJSAMP_420);
        break;
    default:
        make_pgm("P5\n# c\n19 13\n4095\n", 4095);
    }
}

/* Proves: a picture cut at any byte is refused in words, never read as if it were whole. */
static void test_truncation_at_each_byte(void)
{
    for (int kind = 0; kind < 5; kind++) {
        make_kind(kind);
        expect_decoded(2, "whole");
        /* A JPEG's last marker carries nothing: without its second byte the picture is whole. */
        for (size_t cut = 0; cut < encoded_size - (kind == 3 ? 2 : 0); cut++)
            TEST_ASSERT_TRUE(decode(encoded, cut) != PF_OK);
    }
}

/* Proves: random changes give a status and a message; run under the sanitizers. */
static void test_mutations(void)
{
    uint64_t random = 11;
    for (int kind = 0; kind < 5; kind++) {
        make_kind(kind);
        for (int round = 0; round < 600; round++) {
            static uint8_t bad[sizeof encoded];
            memcpy(bad, encoded, encoded_size);
            for (uint64_t k = 1 + temporary_random(&random) % 4; k > 0; k--)
                bad[temporary_random(&random) % (round % 2 == 0 ? 40 : encoded_size)] =
                    (uint8_t)temporary_random(&random);
            (void)decode(bad, encoded_size);
        }
    }
}

/* ---- folders ---- */

/* Proves: people's order of names: numbers by value, and a total order whatever the zeros. */
static void test_natural_order(void)
{
    static const char *const sorted[] = {"1.png",
                                         "2.png",
                                         "10.png",
                                         "img.png",
                                         "img2.png",
                                         "img2b.png",
                                         "img10.png",
                                         "img010b.png",
                                         "img11.png",
                                         "img99999999999999999999.png",
                                         "img100000000000000000000.png",
                                         "img_1.png",
                                         "jpg"};
    size_t n = sizeof sorted / sizeof sorted[0];
    for (size_t a = 0; a < n; a++)
        for (size_t b = 0; b < n; b++) {
            int order = pf_natural_compare(sorted[a], sorted[b]);
            TEST_ASSERT_EQUAL_INT_MESSAGE((a > b) - (a < b), (order > 0) - (order < 0), sorted[a]);
        }
    TEST_ASSERT_TRUE(pf_natural_compare("img1", "img01") != 0);
    TEST_ASSERT_TRUE((pf_natural_compare("img1", "img01") < 0) == (pf_natural_compare("img01", "img1") > 0));
}

static const char *in_folder(const char *name)
{
    static char path[300];
    (void)snprintf(path, sizeof path, "folder/%s", name);
    return path;
}

static void make_folder(void)
{
    TEST_ASSERT_EQUAL_INT(0, mkdir(temporary_path("folder"), 0700));
}

static pf_replay_config config_of_folder(void)
{
    pf_replay_config config = {.path = temporary_path("folder"), .speed = PF_REPLAY_FAST, .loops = 1};
    return config;
}

static void refused(pf_status status, const char *word, const char *second)
{
    pf_replay_config config = config_of_folder();
    error[0] = '\0';
    TEST_ASSERT_EQUAL_INT_MESSAGE(status, pf_replay_open(&camera, &config, error, sizeof error), error);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, word), error);
    TEST_ASSERT_NOT_NULL_MESSAGE(strstr(error, second), error);
}

/* One-coloured PGM of 19 x 13, told apart by its value. */
static void write_plain(const char *name, uint8_t value)
{
    encoded_size = (size_t)sprintf((char *)encoded, "P5 19 13 255\n");
    memset(encoded + encoded_size, value, W * H);
    temporary_write(in_folder(name), encoded, encoded_size + W * H);
}

/* Proves: pictures of all kinds come in natural order, with the telemetry's rows if there is one; other files, hidden
 * ones and folders are not pictures; what a file is, its bytes say. */
static void test_folder_in_order(void)
{
    pf_frame frame;
    uint64_t first = 0;
    make_folder();
    write_plain("img10.pgm", 10);
    write_plain("img2.PGM", 2);
    write_plain("img1.jpg", 1); /* not a JPEG, and no matter */
    write_plain(".img0.pgm", 0);
    temporary_text(in_folder("notes.txt"), "x");
    TEST_ASSERT_EQUAL_INT(0, mkdir(temporary_path(in_folder("img3.png")), 0700));
    make_png(PNG_COLOR_TYPE_RGB, 8, false, false);
    temporary_write(in_folder("img11.png"), encoded, encoded_size);
    for (int with_csv = 0; with_csv < 2; with_csv++) {
        static const uint8_t values[] = {1, 2, 10};
        if (with_csv)
            temporary_text(in_folder("telemetry.csv"), "time_ns,sequence\n5,1\n6,2\n7,4\n9,5\n");
        pf_replay_config config = config_of_folder();
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_replay_open(&camera, &config, error, sizeof error), error);
        TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
        TEST_ASSERT_EQUAL_UINT64(4, camera.ops->info(camera.self)->frames);
        for (uint64_t i = 0; i < 4; i++) {
            TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &frame));
            if (i < 3)
                TEST_ASSERT_EACH_EQUAL_UINT8(values[i], frame.image.data, W * H);
            else
                TEST_ASSERT_EQUAL_MEMORY(expected, frame.image.data, W * H);
            TEST_ASSERT_EQUAL_UINT64(with_csv ? (i < 2 ? i + 1 : i + 2) : i, frame.sequence);
            uint64_t recorded = with_csv ? (i < 3 ? i + 5 : 9) : i * 100000000; /* 10 a second without times */
            first = i == 0 ? frame.time_ns - recorded : first;
            TEST_ASSERT_EQUAL_UINT64(recorded, frame.recorded_ns);
            TEST_ASSERT_EQUAL_UINT64(first + recorded, frame.time_ns);
            camera.ops->release(camera.self, &frame);
        }
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, camera.ops->next(camera.self, 0, &frame));
        camera.ops->close(camera.self);
        camera.self = NULL;
    }
    temporary_text(in_folder("telemetry.csv"), "time_ns,sequence\n5,1\n6,2\n7,4\n");
    refused(PF_ERR_FORMAT, "telemetry.csv:5", "4 frames");
}

/* Proves: an empty folder, another size, and what is no picture are refused with the file's name. */
static void test_folder_mistakes_are_named(void)
{
    make_folder();
    refused(PF_ERR_FORMAT, "folder", "no .png");
    temporary_text(in_folder("readme.txt"), "x");
    refused(PF_ERR_FORMAT, "folder", "no .png");
    write_plain("a1.pgm", 1);
    temporary_write(in_folder("a3.pgm"), "P5 2 1 255\nxx", 13);
    refused(PF_ERR_FORMAT, "a3.pgm: 2 x 1", "a1.pgm has 19 x 13");
    temporary_text(in_folder("a3.pgm"), "hello");
    refused(PF_ERR_FORMAT, "a3.pgm: byte 0", "neither PNG");
    temporary_text(in_folder("a3.pgm"), "");
    refused(PF_ERR_FORMAT, "a3.pgm: byte 0", "neither PNG");
    make_png(PNG_COLOR_TYPE_GRAY, 8, false, false);
    temporary_write(in_folder("a3.pgm"), encoded, 20);
    refused(PF_ERR_TRUNCATED, "a3.pgm: PNG", "too early");
}

/* Proves: a damaged picture in the middle is named when its turn comes, and the rest still plays; so is one that was
 * swapped for another size or grew since the folder was opened. */
static void test_damage_in_the_middle(void)
{
    pf_frame frame;
    make_folder();
    write_plain("a1.pgm", 1);
    make_png(PNG_COLOR_TYPE_GRAY, 8, false, false);
    encoded[encoded_size - 40] ^= 0x40; /* in the pixels: the header stays readable */
    temporary_write(in_folder("a2.png"), encoded, encoded_size);
    write_plain("a3.pgm", 3);
    write_plain("a4.pgm", 4);
    write_plain("a5.pgm", 5);
    pf_replay_config config = config_of_folder();
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_replay_open(&camera, &config, error, sizeof error), error);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
    temporary_write(in_folder("a3.pgm"), "P5 2 1 255\nxx", 13);
    memset(encoded, 'x', 60000);
    temporary_write(in_folder("a4.pgm"), encoded, 60000);
    static const struct {
        pf_status status;
        const char *word;
    } answers[] = {{PF_OK, ""},
                   {PF_ERR_FORMAT, "a2.png: PNG"},
                   {PF_ERR_FORMAT, "a3.pgm: PGM: its size has changed"},
                   {PF_ERR_IO, "a4.pgm: has grown"},
                   {PF_OK, ""},
                   {PF_ERR_END, ""}};
    for (size_t i = 0; i < sizeof answers / sizeof answers[0]; i++) {
        pf_status status = camera.ops->next(camera.self, 0, &frame);
        TEST_ASSERT_EQUAL_INT_MESSAGE(answers[i].status, status, camera.ops->error(camera.self));
        TEST_ASSERT_NOT_NULL(strstr(camera.ops->error(camera.self), answers[i].word));
        if (status == PF_OK)
            camera.ops->release(camera.self, &frame);
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_png_variants);
    RUN_TEST(test_jpeg_variants);
    RUN_TEST(test_pgm_variants);
    RUN_TEST(test_truncation_at_each_byte);
    RUN_TEST(test_mutations);
    RUN_TEST(test_natural_order);
    RUN_TEST(test_folder_in_order);
    RUN_TEST(test_folder_mistakes_are_named);
    RUN_TEST(test_damage_in_the_middle);
    return UNITY_END();
}
