#include "pipefish/drivers/gpio.h"
#include "pipefish/drivers/sha256.h"
#include "replay.h"
#include "temporary.h"
#include "unity.h"

#include <errno.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>

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

#define W 6u
#define H 4u

/* Pixel of frame i: different in every frame and place. */
static uint8_t pixel(uint64_t i, uint32_t x, uint32_t y)
{
    return (uint8_t)(i * 31 + y * W + x + 1);
}

/* A Y4M of `frames` frames of W x H with `chroma` bytes after each luma; its size. */
static size_t make_y4m(char *out, const char *header, const char *frame_line, uint64_t frames, size_t chroma)
{
    char *at = out;
    at += sprintf(at, "%s\n", header);
    for (uint64_t i = 0; i < frames; i++) {
        at += sprintf(at, "%s\n", frame_line);
        for (uint32_t y = 0; y < H; y++)
            for (uint32_t x = 0; x < W; x++)
                *at++ = (char)pixel(i, x, y);
        memset(at, 0xC3, chroma);
        at += chroma;
    }
    return (size_t)(at - out);
}

static const char *write_y4m(const char *name, const char *header, uint64_t frames)
{
    static char bytes[1 << 20];
    return temporary_write(name, bytes, make_y4m(bytes, header, "FRAME", frames, 0));
}

static pf_status open_replay(const pf_replay_config *config)
{
    error[0] = '\0';
    return pf_replay_open(&camera, config, error, sizeof error);
}

static void open_ok(const pf_replay_config *config)
{
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, open_replay(config), error);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
}

static void refused(const pf_replay_config *config, pf_status expected, const char *words)
{
    char copy[256], *rest = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(expected, open_replay(config), error);
    TEST_ASSERT_NULL(camera.self);
    (void)snprintf(copy, sizeof copy, "%s", words);
    for (const char *word = strtok_r(copy, "|", &rest); word != NULL; word = strtok_r(NULL, "|", &rest))
        if (strstr(error, word) == NULL) {
            printf("\"%s\" is missing in \"%s\"\n", word, error);
            TEST_FAIL();
        }
}

static void check_pixels(const pf_frame *frame, uint64_t i)
{
    TEST_ASSERT_EQUAL_UINT32(W, frame->image.width);
    TEST_ASSERT_EQUAL_UINT32(H, frame->image.height);
    for (uint32_t y = 0; y < H; y++)
        for (uint32_t x = 0; x < W; x++)
            TEST_ASSERT_EQUAL_UINT8(pixel(i, x, y), frame->image.data[y * frame->image.stride + x]);
}

/* Takes the next frame, checks its pixels and stamps, and gives it back. */
static void expect_frame(uint64_t i, uint64_t sequence, uint64_t recorded_ns)
{
    pf_frame frame;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, camera.ops->next(camera.self, 10000, &frame), camera.ops->error(camera.self));
    check_pixels(&frame, i);
    TEST_ASSERT_EQUAL_UINT64(sequence, frame.sequence);
    TEST_ASSERT_EQUAL_UINT64(recorded_ns, frame.recorded_ns);
    camera.ops->release(camera.self, &frame);
}

static void expect_end(void)
{
    pf_frame frame;
    for (int i = 0; i < 2; i++)
        TEST_ASSERT_EQUAL_INT(PF_ERR_END, camera.ops->next(camera.self, 0, &frame));
}

/* ---- Y4M ---- */

/* Proves: header parameters in any order, every 8-bit colour space and FRAME lines with parameters are read; only the
 * luma is taken. */
static void test_y4m_variants(void)
{
    static const struct {
        const char *header, *frame;
        size_t chroma;
    } variants[] = {
        {"YUV4MPEG2 W6 H4 F10:1 Ip A1:1 Cmono", "FRAME", 0},
        {"YUV4MPEG2 Cmono XCOLORRANGE=FULL F10:1 H4 I? W6 XYSCSS=X", "FRAME Ip", 0},
        {"YUV4MPEG2  W6 H4  F10:1", "FRAME", 12}, /* no C: 420jpeg; doubled blanks */
        {"YUV4MPEG2 W6 H4 F10:1 C420", "FRAME", 12},
        {"YUV4MPEG2 W6 H4 F10:1 C420jpeg", "FRAME XNOTE=a", 12},
        {"YUV4MPEG2 W6 H4 F10:1 C420mpeg2", "FRAME", 12},
        {"YUV4MPEG2 W6 H4 F10:1 C420paldv", "FRAME", 12},
        {"YUV4MPEG2 W6 H4 F10:1 C422", "FRAME", 24},
        {"YUV4MPEG2 W6 H4 F10:1 C411", "FRAME", 16},
        {"YUV4MPEG2 W6 H4 F10:1 C444", "FRAME", 48},
        {"YUV4MPEG2 W6 H4 F10:1 C444alpha", "FRAME", 72},
    };
    char bytes[4096];
    for (size_t k = 0; k < sizeof variants / sizeof variants[0]; k++) {
        size_t n = make_y4m(bytes, variants[k].header, variants[k].frame, 3, variants[k].chroma);
        pf_replay_config config = {.path = temporary_write("v.y4m", bytes, n), .speed = PF_REPLAY_FAST, .loops = 1};
        open_ok(&config);
        const pf_camera_info *info = camera.ops->info(camera.self);
        TEST_ASSERT_EQUAL_UINT64(3, info->frames);
        TEST_ASSERT_EQUAL_DOUBLE(10, info->frame_rate);
        TEST_ASSERT_NOT_NULL(strstr(info->source, "v.y4m"));
        for (uint64_t i = 0; i < 3; i++)
            expect_frame(i, i, i * 100000000u);
        expect_end();
        camera.ops->close(camera.self);
        camera.self = NULL;
    }
}

/* Proves: what cannot be replayed is refused with the file's name and the reason. */
static void test_y4m_mistakes_are_named(void)
{
    static const struct {
        const char *header;
        pf_status status;
        const char *words;
    } mistakes[] = {
        {"YUV4MPEG2 W6 H4 F10:1 Cmono10", PF_ERR_UNSUPPORTED, "m.y4m|mono10|8-bit"},
        {"YUV4MPEG2 W6 H4 F10:1 C420p10", PF_ERR_UNSUPPORTED, "m.y4m|420p10"},
        {"YUV4MPEG2 W6 H4 F10:1 It Cmono", PF_ERR_UNSUPPORTED, "m.y4m|interlaced"},
        {"YUV4MPEG2 W16385 H4 F10:1 Cmono", PF_ERR_UNSUPPORTED, "m.y4m|W16385"},
        {"YUV4MPEG2 H4 F10:1 Cmono", PF_ERR_FORMAT, "m.y4m|width"},
        {"YUV4MPEG2 W6 F10:1 Cmono", PF_ERR_FORMAT, "m.y4m|height"},
        {"YUV4MPEG2 W0 H4 Cmono", PF_ERR_FORMAT, "m.y4m|W0"},
        {"YUV4MPEG2 W-6 H4 Cmono", PF_ERR_FORMAT, "m.y4m|W-6"},
        {"YUV4MPEG2 W6 W6 H4 Cmono", PF_ERR_FORMAT, "m.y4m|second|W6"},
        {"YUV4MPEG2 W6 H4 F10 Cmono", PF_ERR_FORMAT, "m.y4m|F10"},
        {"YUV4MPEG2 W6 H4 F1:0 Cmono", PF_ERR_FORMAT, "m.y4m|F1:0"},
        {"YUV4MPEG2 W6 H4 Q1 Cmono", PF_ERR_FORMAT, "m.y4m|Q1"},
        {"YUV4MPEG3 W6 H4 F10:1 Cmono", PF_ERR_FORMAT, "m.y4m|not a Y4M"},
        {"RIFF", PF_ERR_FORMAT, "m.y4m|not a Y4M"},
    };
    for (size_t k = 0; k < sizeof mistakes / sizeof mistakes[0]; k++) {
        pf_replay_config config = {.path = write_y4m("m.y4m", mistakes[k].header, 2), .loops = 1};
        refused(&config, mistakes[k].status, mistakes[k].words);
    }
    pf_replay_config config = {.path = temporary_text("m.y4m", "YUV4MPEG2 W6 H4 Cmono\nFRAMES\n"), .loops = 1};
    refused(&config, PF_ERR_FORMAT, "m.y4m|byte 22|FRAME");
    config.path = temporary_text("m.y4m", "YUV4MPEG2 W6 H4 Cmono\n");
    refused(&config, PF_ERR_TRUNCATED, "m.y4m|no frame");
    config.path = temporary_path("missing.y4m");
    refused(&config, PF_ERR_IO, "missing.y4m|No such file");
    config.path = "/dev/null";
    refused(&config, PF_ERR_UNSUPPORTED, "/dev/null|regular");
    config.path = "";
    refused(&config, PF_ERR_ARGUMENT, "no path");
    config.path = write_y4m("m.y4m", "YUV4MPEG2 W6 H4 F10:1 Cmono", 2);
    config.frame_rate = -1;
    refused(&config, PF_ERR_ARGUMENT, "frame rate");
}

/* Opens bytes[n] as a file in memory; every frame it promises must be there to be read. */
static pf_status try_y4m(const char *bytes, size_t n, uint64_t *frames)
{
    static uint8_t pixels[1 << 16];
    pf_y4m y4m;
    int fd = memfd_create("y4m", MFD_CLOEXEC);
    TEST_ASSERT_TRUE(fd >= 0);
    TEST_ASSERT_EQUAL_INT((int)n, write(fd, bytes, n));
    failure.text[0] = '\0';
    pf_status status = pf_y4m_open_fd(&y4m, fd, "some.y4m", &failure);
    *frames = 0;
    if (status != PF_OK) {
        TEST_ASSERT_EQUAL_INT(0, strncmp(failure.text, "some.y4m: ", 10));
        return status;
    }
    *frames = y4m.frames;
    TEST_ASSERT_TRUE(y4m.frames > 0);
    for (uint64_t i = 0; i < y4m.frames; i++)
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_y4m_read(&y4m, i, pixels, &failure));
    pf_y4m_close(&y4m);
    return PF_OK;
}

/* Proves: a file cut at any byte is refused as cut off, unless the cut is between two frames. */
static void test_y4m_truncation_at_each_byte(void)
{
    char bytes[1024];
    uint64_t frames;
    size_t n = make_y4m(bytes, "YUV4MPEG2 W6 H4 F10:1 Cmono", "FRAME Ip", 3, 0);
    size_t one = strlen("FRAME Ip\n") + (size_t)(W * H), header = n - 3 * one;
    for (size_t cut = 0; cut <= n; cut++) {
        pf_status status = try_y4m(bytes, cut, &frames);
        if (cut > header && (cut - header) % one == 0) {
            TEST_ASSERT_EQUAL_INT(PF_OK, status);
            TEST_ASSERT_EQUAL_UINT64((cut - header) / one, frames);
        } else {
            TEST_ASSERT_EQUAL_INT(cut <= strlen("YUV4MPEG2") ? PF_ERR_FORMAT : PF_ERR_TRUNCATED, status);
        }
    }
    n = make_y4m(bytes, "YUV4MPEG2 W6 H4 F10:1 C420", "FRAME", 3, 12); /* a cut in the last chroma counts too */
    for (size_t missing = 1; missing <= 12; missing++)
        TEST_ASSERT_EQUAL_INT(PF_ERR_TRUNCATED, try_y4m(bytes, n - missing, &frames));
}

/* Proves: random changes and random bytes give a status and a message; run under the sanitizers. */
static void test_y4m_mutations(void)
{
    static const char letters[] = "0123456789 \nWHFICAX:pmono42RAME";
    char good[1024], bytes[1024];
    uint64_t random = 7, frames;
    size_t n = make_y4m(good, "YUV4MPEG2 W6 H4 F10:1 Ip A1:1 Cmono", "FRAME", 3, 0);
    for (int round = 0; round < 4000; round++) {
        memcpy(bytes, good, n);
        for (uint64_t k = 1 + temporary_random(&random) % 3; k > 0; k--)
            bytes[temporary_random(&random) % (round % 2 == 0 ? 42 : n)] =
                round % 3 == 0 ? (char)temporary_random(&random)
                               : letters[temporary_random(&random) % (sizeof letters - 1)];
        if (round % 100 == 99)
            for (size_t i = 9; i < n; i++)
                bytes[i] = (char)temporary_random(&random);
        (void)try_y4m(bytes, n, &frames);
    }
}

/* Proves: frames beyond 4 GiB are found and read. The file is sparse: 17 frames of 256 MiB in blocks that do not exist.
 */
static void test_y4m_beyond_4_gib(void)
{
    static const char header[] = "YUV4MPEG2 W16384 H4096 F10:1 C444alpha\n", line[] = "FRAME\n";
    const uint64_t luma = 16384ull * 4096, one = sizeof line - 1 + 4 * luma;
    const char *path = temporary_path("large.y4m");
    int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    TEST_ASSERT_TRUE(fd >= 0);
    if (ftruncate(fd, (off_t)(sizeof header - 1 + 17 * one)) != 0) {
        close(fd);
        TEST_IGNORE_MESSAGE("no files above 4 GiB in the temporary folder: not tested");
    }
    TEST_ASSERT_EQUAL_INT((int)sizeof header - 1, pwrite(fd, header, sizeof header - 1, 0));
    for (uint64_t i = 0; i < 17; i++) {
        off_t at = (off_t)(sizeof header - 1 + i * one);
        TEST_ASSERT_EQUAL_INT((int)sizeof line - 1, pwrite(fd, line, sizeof line - 1, at));
        TEST_ASSERT_EQUAL_INT(1, pwrite(fd, &(uint8_t){(uint8_t)(100 + i)}, 1, at + (off_t)sizeof line - 1));
    }
    pf_y4m y4m;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_y4m_open_fd(&y4m, fd, path, &failure), failure.text);
    TEST_ASSERT_EQUAL_UINT64(17, y4m.frames);
    TEST_ASSERT_TRUE(y4m.offset[16] > 4ull << 30);
    uint8_t *pixels = malloc(luma);
    TEST_ASSERT_NOT_NULL(pixels);
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_y4m_read(&y4m, 16, pixels, &failure));
    TEST_ASSERT_EQUAL_UINT8(116, pixels[0]);
    TEST_ASSERT_EQUAL_UINT8(0, pixels[luma - 1]);
    free(pixels);
    pf_y4m_close(&y4m);
}

/* Proves: a file that shrinks while it is played is reported, not a crash. */
static void test_y4m_shrinks_while_played(void)
{
    pf_frame frame;
    const char *path = write_y4m("s.y4m", "YUV4MPEG2 W6 H4 F10:1 Cmono", 3);
    pf_replay_config config = {.path = path, .speed = PF_REPLAY_FAST, .loops = 1};
    open_ok(&config);
    expect_frame(0, 0, 0);
    TEST_ASSERT_EQUAL_INT(0, truncate(path, 100));
    expect_frame(1, 1, 100000000);
    TEST_ASSERT_EQUAL_INT(PF_ERR_TRUNCATED, camera.ops->next(camera.self, 0, &frame));
    TEST_ASSERT_NOT_NULL(strstr(camera.ops->error(camera.self), "s.y4m: byte 100: frame 2"));
    expect_end();
}

/* ---- telemetry ---- */

/* Proves: a frame comes with its row; gaps in the sequence stay gaps; loops go on rising by the span and one period. */
static void test_rows_belong_to_frames_and_loops_rise(void)
{
    pf_frame frame;
    temporary_text("t.csv", "sequence,time_ns,encoder_count,lamp\n10,1000,-5,0.5\n11,2000,,\n14,5000,7,1\n");
    pf_replay_config config = {
        .path = write_y4m("t.y4m", "YUV4MPEG2 W6 H4 F0:0 Cmono", 3), .speed = PF_REPLAY_FAST, .loops = 2};
    open_ok(&config);
    TEST_ASSERT_EQUAL_UINT64(6, camera.ops->info(camera.self)->frames);
    TEST_ASSERT_EQUAL_DOUBLE(500000, camera.ops->info(camera.self)->frame_rate); /* 2 periods in 4000 ns */
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &frame));
    TEST_ASSERT_TRUE(frame.telemetry.has_encoder && frame.telemetry.has_lamp && !frame.telemetry.has_gain);
    TEST_ASSERT_EQUAL_INT64(-5, frame.telemetry.encoder_count);
    TEST_ASSERT_EQUAL_DOUBLE(0.5, frame.telemetry.lamp);
    camera.ops->release(camera.self, &frame);
    expect_frame(1, 11, 2000);
    expect_frame(2, 14, 5000);
    expect_frame(0, 15, 7000); /* 5000 + the mean period of 2000 */
    expect_frame(1, 16, 8000);
    expect_frame(2, 19, 11000);
    expect_end();
}

/* Proves: without end, sequence and time of a recording without telemetry rise over the loops; F0:0 takes the rate of
 * the configuration. */
static void test_endless_loop(void)
{
    pf_replay_config config = {
        .path = write_y4m("e.y4m", "YUV4MPEG2 W6 H4 F0:0 Cmono", 3), .speed = PF_REPLAY_FAST, .frame_rate = 20};
    open_ok(&config);
    TEST_ASSERT_EQUAL_UINT64(0, camera.ops->info(camera.self)->frames);
    for (uint64_t i = 0; i < 100; i++)
        expect_frame(i % 3, i, i * 50000000u);
}

/* Proves: telemetry and frames that do not match in number, a named file that is missing, and mistakes in it are
 * refused; a default file may be missing. */
static void test_csv_must_match(void)
{
    pf_replay_config config = {.path = write_y4m("c.y4m", "YUV4MPEG2 W6 H4 F10:1 Cmono", 2), .loops = 1};
    temporary_text("c.csv", "sequence,time_ns\n1,10\n2,20\n3,30\n");
    refused(&config, PF_ERR_FORMAT, "c.csv:4|column sequence|3 rows|2 frames|c.y4m");
    temporary_text("c.csv", "sequence,time_ns\n1,10\n");
    refused(&config, PF_ERR_FORMAT, "c.csv:3|1 rows|2 frames");
    temporary_text("c.csv", "sequence,time_ns\n1,10\n2,x\n");
    refused(&config, PF_ERR_FORMAT, "c.csv:3|column time_ns|\"x\"");
    config.csv = temporary_path("other.csv");
    refused(&config, PF_ERR_IO, "other.csv|No such file");
    temporary_text("other.csv", "sequence,time_ns\n5,10\n6,20\n");
    config.speed = PF_REPLAY_FAST;
    open_ok(&config);
    expect_frame(0, 5, 10);
}

static void hex(const uint8_t hash[32], char *out)
{
    for (int i = 0; i < 32; i++)
        sprintf(out + 2 * i, "%02x", hash[i]);
}

/* Proves: a frame whose pixels do not have the recorded hash is an error that names frame and row, and the replay can
 * go on after it. */
static void test_sha256_is_verified(void)
{
    char csv[1024], digits[65];
    uint8_t pixels[W * H], hash[32];
    pf_frame frame;
    char *at = csv + sprintf(csv, "sequence,time_ns,sha256\n");
    for (uint64_t i = 0; i < 4; i++) {
        for (uint32_t k = 0; k < W * H; k++)
            pixels[k] = pixel(i == 2 ? 9 : i, k % W, k / W);
        TEST_ASSERT_EQUAL_INT(PF_OK, pf_sha256(pixels, sizeof pixels, hash));
        hex(hash, digits);
        at += sprintf(at, "%d,%d,%s\n", (int)i, (int)i * 10 + 10, i == 1 ? "" : digits);
    }
    temporary_text("h.csv", csv);
    pf_replay_config config = {
        .path = write_y4m("h.y4m", "YUV4MPEG2 W6 H4 F10:1 Cmono", 4), .speed = PF_REPLAY_FAST, .loops = 1};
    open_ok(&config);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &frame));
    TEST_ASSERT_TRUE(frame.has_sha256);
    camera.ops->release(camera.self, &frame);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &frame));
    TEST_ASSERT_FALSE(frame.has_sha256);
    camera.ops->release(camera.self, &frame);
    TEST_ASSERT_EQUAL_INT(PF_ERR_CHECKSUM, camera.ops->next(camera.self, 0, &frame));
    TEST_ASSERT_NOT_NULL(strstr(camera.ops->error(camera.self), "h.y4m: frame 2"));
    TEST_ASSERT_NOT_NULL(strstr(camera.ops->error(camera.self), "h.csv:4"));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &frame));
    check_pixels(&frame, 3);
    TEST_ASSERT_EQUAL_MEMORY(hash, frame.sha256, 32);
    camera.ops->release(camera.self, &frame);
    expect_end();
}

/* ---- pace, and who holds what ---- */

/* Proves: three frames can be held while all stay intact, a fourth is refused, and nothing comes before start. */
static void test_three_frames_are_held(void)
{
    pf_frame a, b, c, d;
    pf_replay_config config = {
        .path = write_y4m("b.y4m", "YUV4MPEG2 W6 H4 F10:1 Cmono", 5), .speed = PF_REPLAY_FAST, .loops = 1};
    TEST_ASSERT_EQUAL_INT(PF_OK, open_replay(&config));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, camera.ops->next(camera.self, 0, &a));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &a));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &b));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &d));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, camera.ops->next(camera.self, 0, &c));
    check_pixels(&a, 0);
    check_pixels(&b, 1);
    check_pixels(&d, 2);
    camera.ops->release(camera.self, &a);
    camera.ops->release(camera.self, &d);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 0, &c));
    check_pixels(&b, 1);
    check_pixels(&c, 3);
    /* stopped and started again, it goes on */
    camera.ops->release(camera.self, &b);
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->stop(camera.self));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, camera.ops->next(camera.self, 0, &a));
    TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->start(camera.self));
    expect_frame(4, 4, 400000000);
}

static uint64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

/* Proves: at recorded speed no frame comes before its time, and one that is over a period late is skipped once its
 * successor is due; the last frame comes however late. The clock is read here too: a slow machine does not matter. */
static void test_recorded_speed_skips_what_is_late(void)
{
    pf_frame frame;
    uint64_t period = 1000000, previous = 0;
    pf_replay_config config = {.path = write_y4m("p.y4m", "YUV4MPEG2 W6 H4 F1000:1 Cmono", 200), .loops = 1};
    uint64_t before = now_ns();
    open_ok(&config);
    uint64_t after = now_ns();
    usleep(20000);
    for (int i = 0; i < 5; i++) {
        uint64_t asked = now_ns();
        TEST_ASSERT_EQUAL_INT(PF_OK, camera.ops->next(camera.self, 10000, &frame));
        TEST_ASSERT_TRUE(now_ns() - before >= frame.recorded_ns);
        uint64_t late_from = asked - after > period ? asked - after - period : 0;
        TEST_ASSERT_TRUE(frame.recorded_ns >= late_from || frame.sequence == 199);
        TEST_ASSERT_TRUE(i == 0 ? frame.sequence > 10 : frame.sequence > previous);
        TEST_ASSERT_EQUAL_UINT64(frame.sequence * period, frame.recorded_ns);
        previous = frame.sequence;
        camera.ops->release(camera.self, &frame);
        if (previous == 199) /* this machine stood still for the rest of them */
            break;
    }
    usleep(220000);
    if (previous < 199)
        expect_frame(199, 199, 199 * period);
    expect_end();
}

/* Proves: a late frame stays as long as its successor is not due; then there is nothing, until the timeout. */
static void test_recorded_speed_keeps_the_newest(void)
{
    pf_frame frame;
    temporary_text("g.csv", "sequence,time_ns\n0,5\n1,3600000000005\n");
    pf_replay_config config = {.path = write_y4m("g.y4m", "YUV4MPEG2 W6 H4 F1000:1 Cmono", 2), .loops = 1};
    open_ok(&config);
    usleep(10000);
    expect_frame(0, 0, 5);
    TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, camera.ops->next(camera.self, 0, &frame));
    TEST_ASSERT_EQUAL_INT(PF_ERR_AGAIN, camera.ops->next(camera.self, 5, &frame));
}

/* Proves: times are of the monotonic clock, on which the daemon stamps everything else: the first frame is due at the
 * start, the others at their recorded distances, at any speed and over a wrap; the recording's own time is kept. */
static void test_times_are_mapped_to_the_start(void)
{
    for (int speed = PF_REPLAY_RECORDED; speed <= PF_REPLAY_FAST; speed++) {
        pf_frame frame;
        temporary_text("r.csv", "sequence,time_ns\n0,3600000000000\n1,3600001000000\n2,3600009000000\n");
        pf_replay_config config = {.path = write_y4m("r.y4m", "YUV4MPEG2 W6 H4 F1000:1 Cmono", 3),
                                   .speed = (pf_replay_speed)speed,
                                   .loops = 2};
        uint64_t before = now_ns();
        open_ok(&config);
        uint64_t after = now_ns(), frames = 0;
        while (camera.ops->next(camera.self, 10000, &frame) == PF_OK) {
            uint64_t start = frame.time_ns - (frame.recorded_ns - 3600000000000u);
            TEST_ASSERT_TRUE(frame.recorded_ns >= 3600000000000u && start >= before && start <= after);
            frames++;
            camera.ops->release(camera.self, &frame);
        }
        TEST_ASSERT_TRUE(speed == PF_REPLAY_RECORDED ? frames > 0 : frames == 6);
        camera.ops->close(camera.self);
        camera.self = NULL;
    }
}

/* Proves: at a wrap, where the scene jumps back, the sequence leaves the gap that makes it a break. */
static void test_a_wrap_leaves_a_gap(void)
{
    pf_replay_config config = {.path = write_y4m("w.y4m", "YUV4MPEG2 W6 H4 F1000:1 Cmono", 2),
                               .speed = PF_REPLAY_FAST,
                               .loops = 3,
                               .loop_gap = 6};
    open_ok(&config);
    for (uint64_t i = 0; i < 6; i++)
        expect_frame(i % 2, i % 2 + i / 2 * 8, i * 1000000);
    expect_end();
}

/* Proves: a board without lines says so at every call. */
static void test_gpio_none(void)
{
    pf_gpio gpio;
    double level;
    int64_t count;
    uint32_t missed;
    pf_gpio_state state;
    TEST_ASSERT_EQUAL_INT(PF_OK, pf_gpio_none_open(&gpio));
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, gpio.ops->set_lamp(gpio.self, 0.5));
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, gpio.ops->lamp(gpio.self, &level));
    TEST_ASSERT_EQUAL_INT(PF_ERR_UNSUPPORTED, gpio.ops->encoder(gpio.self, 0, &count, &missed));
    gpio.ops->state(gpio.self, &state);
    TEST_ASSERT_FALSE(state.has_stop || state.is_stopped || state.limits != 0);
    gpio.ops->close(gpio.self);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_y4m_variants);
    RUN_TEST(test_y4m_mistakes_are_named);
    RUN_TEST(test_y4m_truncation_at_each_byte);
    RUN_TEST(test_y4m_mutations);
    RUN_TEST(test_y4m_beyond_4_gib);
    RUN_TEST(test_y4m_shrinks_while_played);
    RUN_TEST(test_rows_belong_to_frames_and_loops_rise);
    RUN_TEST(test_endless_loop);
    RUN_TEST(test_csv_must_match);
    RUN_TEST(test_sha256_is_verified);
    RUN_TEST(test_three_frames_are_held);
    RUN_TEST(test_recorded_speed_skips_what_is_late);
    RUN_TEST(test_recorded_speed_keeps_the_newest);
    RUN_TEST(test_times_are_mapped_to_the_start);
    RUN_TEST(test_a_wrap_leaves_a_gap);
    RUN_TEST(test_gpio_none);
    return UNITY_END();
}
