/* The profile's binary format: what is written is read, old images load, and no damage passes. */
#include "profile_samples.h"
#include "unity.h"

#include <math.h>
#include <string.h>

void setUp(void) {}
void tearDown(void) {}

#define COVARIANCE_AT 808u
#define VECTORS_AT    (COVARIANCE_AT + 3 * 8u) /* of sample() */

/* What version 1 has of sample(), as it wrote it. Devices hold such images: this must never change. */
static const char GOLDEN_1[] = "5046505201000000640200000100000000f1536500000000000000000000d03f000000000000f83f"
                               "476f6c64656e20c3b620310000000000000000000000000000000000000000000000000000000000"
                               "000000000000000000000000000000000000000000000000534e2d34320000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "000000000000000000050000200300000000000002000000000000000044764000000000003e7640"
                               "000000000000c03f00000000003c844000000000004c794000000000000000000000000000000000"
                               "000000000000a0bf000000000000703f00000000000050bf000000000000103f0000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "0000000000000000000000000000000000000000000000000000000000000000000000000000fa3f"
                               "00000000000484400000000000087940000000000082814000080000000000000000000000000000"
                               "000000000000000000000000000000000000000000000000000000000000d03f000000000000b0bf"
                               "000000000000e03fff80ab92";

/* sample() as version 2 wrote it. */
static const char GOLDEN_2[] = "5046505202000000440500000100000000f1536500000000000000000000d03f000000000000f83f"
                               "476f6c64656e20c3b620310000000000000000000000000000000000000000000000000000000000"
                               "000000000000000000000000000000000000000000000000534e2d34320000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "000000000000000000050000200300000000000002000000000000000044764000000000003e7640"
                               "000000000000c03f00000000003c844000000000004c794000000000000000000000000000000000"
                               "000000000000a0bf000000000000703f00000000000050bf000000000000103f0000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000000000000000000000"
                               "0000000000000000000000000000000000000000000000000000000000000000000000000000fa3f"
                               "00000000000484400000000000087940000000000082814000080000000000000000000000000000"
                               "0000000000000000000000000000000000000000000000000100000005000000000000000000d43f"
                               "14000000e0060000662f3220312e36206d6d00000000000000000000000000000000000000000000"
                               "00000000000000000000000000000000000000000000000000000000000000007069706566697368"
                               "000000000000000000000000000000000000000000000000302e312e300000000000000000000000"
                               "0000000000000000000000000000000070393a206c65617374206572726f72206f6e2068656c642d"
                               "6f757420766965777300000000000000000000000000000000000000000000000000000000000000"
                               "0800000000000000000000000000d03f000000000000b0bf000000000000e03f0000000000000000"
                               "0000000000000000000000000000f03f00000000003c844000000000004c79400000000000000000"
                               "0000000000000000000000000000f03f44dc082181f6d2bfbc0e1e43d76fcc3f72b53f8289b9ed3f"
                               "2a5414c101df804018629f5821567e4044dc082181f6d2bfbc0e1e43d76fcc3f72b53f8289b9ed3f"
                               "7e1e1433e21fd13f4ffff1e73b88e4bf3a5b78b6a700e73fc1f4220fea778740fe98639a63946340"
                               "7d1e1433e21fd13f4efff1e73b88e4bf395b78b6a700e73f07983c29b13e35bf9092a2097e90ed3f"
                               "5003f80e8a7dd83f00000000003c84401a023862de3f894007983c29b13e35bf9092a2097e90ed3f"
                               "5003f80e8a7dd83fcc23a407832ae33fb00b0aeb1391e93f57e6afd8ddbcabbfa295737fd9538e40"
                               "7a31e09f81178a40cb23a407832ae33fb00b0aeb1391e93f57e6afd8ddbcabbf10e56286e77eedbf"
                               "e467fc218093d83fd7e6afd8ddbcabbf5acf087d0bd86240482733ef151c834012e56286e77eedbf"
                               "e767fc218093d83f97e6afd8ddbcabbf3c6ac3c5d90edebf022921f0ab32ecbf57e6afd8ddbcabbf"
                               "cc2423a9fea27840fc0b3ab58a6d51c03c6ac3c5d90edebf022921f0ab32ecbf57e6afd8ddbcabbf"
                               "323fb971d5acee3f8ab2b6d759e4d1bff7e5afd8ddbcabbfc179366489309240a6ec2e2228c76f40"
                               "323fb971d5acee3f8ab2b6d759e4d1bff7e5afd8ddbcabbfab32146f";

static size_t encode_ok(const pf_profile *profile, uint8_t *out)
{
    size_t n = 0;
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_profile_encode(profile, out, PF_PROFILE_BINARY_MAX, &n, &why), why);
    TEST_ASSERT_EQUAL_STRING("ok", why);
    return n;
}

/* Expects a refusal that leaves the profile as it was and names the field. */
static void refused(pf_status expected, const uint8_t *bytes, size_t n, const char *field)
{
    static pf_profile profile, before;
    memset(&profile, 0x5A, sizeof profile);
    memcpy(&before, &profile, sizeof profile);
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT(expected, pf_profile_decode(bytes, n, &profile, &why));
    TEST_ASSERT_EQUAL_STRING_LEN(field, why, strlen(field));
    TEST_ASSERT_EQUAL_CHAR(':', why[strlen(field)]);
    TEST_ASSERT_EQUAL_MEMORY(&before, &profile, sizeof profile);
    TEST_ASSERT_EQUAL_INT(expected, pf_profile_decode(bytes, n, &profile, NULL));
}

static size_t from_hex(const char *hex, uint8_t *bytes)
{
    size_t n = strlen(hex) / 2;
    for (size_t i = 0; i < 2 * n; i++)
        bytes[i / 2] = (uint8_t)(bytes[i / 2] << 4 | (hex[i] <= '9' ? hex[i] - '0' : hex[i] - 'a' + 10));
    return n;
}

/* Proves: what version 1 of the format wrote is read, and what it did not have is unknown. */
static void test_stored_bytes_of_version_1_load(void)
{
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = from_hex(GOLDEN_1, bytes);
    pf_profile expected = sample(), profile;
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_profile_decode(bytes, n, &profile, &why), why);
    TEST_ASSERT_EQUAL_MEMORY(&expected.camera, &profile.camera, sizeof profile.camera);
    TEST_ASSERT_EQUAL_STRING(expected.name, profile.name);
    TEST_ASSERT_EQUAL_STRING(expected.serial, profile.serial);
    TEST_ASSERT_EQUAL_UINT32(expected.source, profile.source);
    TEST_ASSERT_EQUAL_INT64(expected.created_unix_s, profile.created_unix_s);
    TEST_ASSERT_EQUAL_DOUBLE(expected.rms_px, profile.rms_px);
    TEST_ASSERT_EQUAL_DOUBLE(expected.theta_covered, profile.theta_covered);
    TEST_ASSERT_EQUAL_MEMORY(expected.free_param, profile.free_param, sizeof profile.free_param);
    TEST_ASSERT_EQUAL_MEMORY(expected.covariance, profile.covariance, sizeof profile.covariance);
    TEST_ASSERT_TRUE(isnan(profile.held_out_rms_px));
    TEST_ASSERT_EQUAL_STRING("", profile.lens);
    TEST_ASSERT_EQUAL_STRING("", profile.model_choice);
    TEST_ASSERT_EQUAL_UINT32(0, profile.views + profile.points + profile.held_out_views);
    for (size_t bit = 0; bit < 8 * n; bit++) {
        bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
        TEST_ASSERT_TRUE(pf_profile_decode(bytes, n, &profile, NULL) < 0);
        bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
    }
}

/* Proves: the writer writes version 2 byte for byte up to the vectors, whose last bits are the model's; and what was
 * written is read. */
static void test_stored_bytes_of_version_2_load(void)
{
    uint8_t golden[PF_PROFILE_BINARY_MAX], bytes[PF_PROFILE_BINARY_MAX];
    size_t n = from_hex(GOLDEN_2, golden);
    pf_profile expected = sample(), profile;
    const char *why = NULL;
    TEST_ASSERT_EQUAL_size_t(n, encode_ok(&expected, bytes));
    TEST_ASSERT_EQUAL_HEX8_ARRAY(golden, bytes, VECTORS_AT);
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_profile_decode(golden, n, &profile, &why), why);
    TEST_ASSERT_EQUAL_MEMORY(&expected, &profile, sizeof profile);
}

static void assert_round_trip(const pf_profile *profile)
{
    static pf_profile back;
    uint8_t bytes[PF_PROFILE_BINARY_MAX], again[PF_PROFILE_BINARY_MAX];
    size_t n = encode_ok(profile, bytes);
    const char *why = NULL;
    TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_profile_decode(bytes, n, &back, &why), why);
    TEST_ASSERT_EQUAL_size_t(n, encode_ok(&back, again));
    TEST_ASSERT_EQUAL_MEMORY(bytes, again, n);
    TEST_ASSERT_EQUAL_MEMORY(&profile->camera, &back.camera, sizeof back.camera);
    TEST_ASSERT_EQUAL_STRING(profile->name, back.name);
    TEST_ASSERT_EQUAL_STRING(profile->serial, back.serial);
    TEST_ASSERT_EQUAL_STRING(profile->lens, back.lens);
    TEST_ASSERT_EQUAL_STRING(profile->tool, back.tool);
    TEST_ASSERT_EQUAL_STRING(profile->tool_version, back.tool_version);
    TEST_ASSERT_EQUAL_STRING(profile->model_choice, back.model_choice);
    TEST_ASSERT_EQUAL_UINT32(profile->views, back.views);
    TEST_ASSERT_EQUAL_UINT32(profile->points, back.points);
    TEST_ASSERT_EQUAL_UINT32(profile->held_out_views, back.held_out_views);
    TEST_ASSERT_TRUE(isnan(profile->held_out_rms_px) ? isnan(back.held_out_rms_px)
                                                     : profile->held_out_rms_px == back.held_out_rms_px);
    TEST_ASSERT_EQUAL_UINT32(profile->source, back.source);
    TEST_ASSERT_EQUAL_INT64(profile->created_unix_s, back.created_unix_s);
    TEST_ASSERT_TRUE(isnan(profile->rms_px) ? isnan(back.rms_px) : profile->rms_px == back.rms_px);
    TEST_ASSERT_EQUAL_DOUBLE(profile->theta_covered, back.theta_covered);
    TEST_ASSERT_EQUAL_UINT32(profile->free_count, back.free_count);
    TEST_ASSERT_EQUAL_MEMORY(profile->free_param, back.free_param, sizeof back.free_param);
    TEST_ASSERT_EQUAL_MEMORY(profile->covariance, back.covariance, sizeof back.covariance);
    TEST_ASSERT_EQUAL_UINT32(profile->integers_count, back.integers_count);
    TEST_ASSERT_EQUAL_MEMORY(profile->integers, back.integers, sizeof back.integers);
}

/* Proves: every field survives, at its extremes too, and with 0 to 40 free parameters. */
static void test_round_trip_of_every_field_and_extreme(void)
{
    static pf_profile profile;
    profile = sample();
    assert_round_trip(&profile);
    for (int32_t i = 0; i < (int32_t)PF_PROFILE_INTEGERS; i++) {
        profile.integers[i] = (pf_profile_integers){{INT32_MIN, INT32_MAX}, {i, -i, 1 << 30}, {65536 * i, -0x01020304}};
        profile.integers_count = (uint32_t)i + 1;
        assert_round_trip(&profile);
    }
    for (uint32_t count = 0; count <= PF_PROFILE_FREE_MAX; count++) {
        profile = sample();
        memset(profile.covariance, 0, sizeof profile.covariance);
        memset(profile.free_param, 0, sizeof profile.free_param);
        profile.free_count = count;
        size_t at = 0;
        for (uint32_t i = 0; i < count; i++) {
            profile.free_param[i] = (uint8_t)(i + 1);
            for (uint32_t j = 0; j <= i; j++)
                profile.covariance[at++] = i == j ? 1e3 / (i + 1) : (i + j) % 2 ? -1e-3 * i : 1e-200;
        }
        assert_round_trip(&profile);
    }
    memset(&profile, 0, sizeof profile);
    profile.camera.width = profile.camera.height = 16384;
    profile.camera.f_u = profile.camera.f_v = 1e5;
    profile.camera.skew = -1e5;
    profile.camera.c_u = profile.camera.circle_radius = 1e5;
    profile.camera.c_v = -1e5;
    profile.camera.k2 = profile.camera.k5 = 1e6;
    profile.camera.theta_max = profile.theta_covered = 3.1415926535897927;
    memset(profile.name, 'x', 63);
    memset(profile.lens, 'x', 63);
    memset(profile.tool, 'x', 31);
    memset(profile.tool_version, 'x', 31);
    memset(profile.model_choice, 'x', 63);
    profile.views = profile.points = profile.held_out_views = UINT32_MAX;
    profile.held_out_rms_px = 1e300;
    memcpy(profile.serial, "\xF4\x8F\xBF\xBF\xED\x9F\xBF\xC2\xA0", 10);
    profile.source = PF_SOURCE_SIMULATED;
    profile.created_unix_s = 253402300799;
    profile.rms_px = (double)NAN;
    profile.free_count = 1;
    profile.free_param[0] = PF_CAMERA_PARAMS - 1;
    profile.covariance[0] = 1.7976931348623157e308;
    assert_round_trip(&profile);
    profile.rms_px = -(double)NAN;
    profile.covariance[0] = 4.9406564584124654e-324;
    assert_round_trip(&profile);
    profile.rms_px = -0.0;
    profile.camera.k2 = -0.0;
    assert_round_trip(&profile);
}

/* Proves: bytes behind a text's end in memory are not written. */
static void test_text_is_padded_with_zeros(void)
{
    pf_profile clean = sample(), dirty = sample();
    uint8_t a[PF_PROFILE_BINARY_MAX], b[PF_PROFILE_BINARY_MAX];
    memset(dirty.serial + strlen(dirty.serial) + 1, 0xEE, 8);
    dirty.free_param[7] = 0xEE;
    size_t n = encode_ok(&clean, a);
    TEST_ASSERT_EQUAL_size_t(n, encode_ok(&dirty, b));
    TEST_ASSERT_EQUAL_MEMORY(a, b, n);
}

/* Proves: cut at any length, the profile is refused as cut, with room for nothing read behind the end (ASan). */
static void test_truncation_at_every_length(void)
{
    pf_profile profile = sample();
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = encode_ok(&profile, bytes);
    for (size_t cut = 0; cut < n; cut++) {
        uint8_t exact[PF_PROFILE_BINARY_MAX];
        uint8_t *end = exact + sizeof exact - cut; /* the cut data end where the array ends */
        memcpy(end, bytes, cut);
        refused(PF_ERR_TRUNCATED, end, cut, "length");
    }
    bytes[n] = 0;
    refused(PF_ERR_FORMAT, bytes, n + 1, "length");
}

/* Proves: a single flipped bit anywhere is detected; outside magic and length it is called damage. */
static void test_every_flipped_bit_is_detected(void)
{
    pf_profile profile = sample();
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = encode_ok(&profile, bytes);
    for (size_t bit = 0; bit < 8 * n; bit++) {
        bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
        pf_profile out;
        pf_status status = pf_profile_decode(bytes, n, &out, NULL);
        bool envelope = bit < 32 || (bit >= 64 && bit < 96);
        TEST_ASSERT_TRUE(envelope ? status == PF_ERR_FORMAT || status == PF_ERR_TRUNCATED : status == PF_ERR_CHECKSUM);
        bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
    }
}

/* Proves: an intact profile of another version is called that, whatever follows its envelope and however long. */
static void test_other_versions_are_named_as_such(void)
{
    pf_profile profile = sample();
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = encode_ok(&profile, bytes);
    const uint32_t versions[] = {0, 3, 256, UINT32_MAX};
    for (int i = 0; i < 4; i++) {
        put_u32(bytes + 4, versions[i]);
        repair(bytes, n);
        refused(PF_ERR_VERSION, bytes, n, "version");
    }
    put_u32(bytes + 4, 3);
    put_u32(bytes + 8, 16);
    repair(bytes, 16);
    refused(PF_ERR_VERSION, bytes, 16, "version");
}

/* Proves: with a correct checksum, every field out of range is refused and named. */
static void test_bad_fields_are_refused_and_named(void)
{
    static const struct {
        size_t at, count;
        uint8_t byte;
        pf_status status;
        const char *field;
    } item[] = {
        {0, 1, 'X', PF_ERR_FORMAT, "magic"},
        {12, 1, 5, PF_ERR_FORMAT, "source"},
        {23, 1, 0x80, PF_ERR_FORMAT, "created_unix_s"},
        {20, 1, 0xFF, PF_ERR_FORMAT, "created_unix_s"},
        {31, 1, 0xBF, PF_ERR_FORMAT, "rms_px"},
        {24, 8, 0xFF, PF_ERR_FORMAT, "rms_px"},
        {39, 1, 0xBF, PF_ERR_FORMAT, "theta_covered"},
        {39, 1, 0x7F, PF_ERR_FORMAT, "theta_covered"},
        {40, 1, 0x1F, PF_ERR_FORMAT, "name"},
        {40, 64, 'x', PF_ERR_FORMAT, "name"},
        {100, 1, 'x', PF_ERR_FORMAT, "name"},
        {47, 1, 0x80, PF_ERR_FORMAT, "name"},
        {104, 1, 0xC1, PF_ERR_FORMAT, "serial"},
        {104, 1, 0xFF, PF_ERR_FORMAT, "serial"},
        {104, 1, 0x7F, PF_ERR_FORMAT, "serial"},
        {168, 2, 0, PF_ERR_FORMAT, "width"},
        {175, 1, 1, PF_ERR_FORMAT, "height"},
        {176, 1, 7, PF_ERR_FORMAT, "radial"},
        {180, 1, 41, PF_ERR_FORMAT, "free_count"},
        {180, 4, 0xFF, PF_ERR_FORMAT, "free_count"},
        {183, 1, 1, PF_ERR_FORMAT, "free_count"},
        {180, 1, 3, PF_ERR_FORMAT, "length"},
        {180, 1, 0, PF_ERR_FORMAT, "length"},
        {184, 8, 0, PF_ERR_FORMAT, "f_u"},
        {192, 8, 0xFF, PF_ERR_FORMAT, "f_v"},
        {224, 8, 0xFF, PF_ERR_FORMAT, "tilt[0]"},
        {240 + 7, 1, 0xFF, PF_ERR_FORMAT, "k2"},
        {248 + 7, 1, 0xBF, PF_ERR_DOMAIN, "theta_max"}, /* k3 = -0.0039, doubled below */
        {272, 8, 0xFF, PF_ERR_FORMAT, "asym_radial_theta"},
        {296, 8, 0xFF, PF_ERR_FORMAT, "asym_radial_phi"},
        {328, 8, 0xFF, PF_ERR_FORMAT, "asym_tangential_theta"},
        {352, 8, 0xFF, PF_ERR_FORMAT, "asym_tangential_phi"},
        {384 + 8 * 13, 8, 0xFF, PF_ERR_FORMAT, "cpoly"},
        {496, 8, 0xFF, PF_ERR_FORMAT, "mirror"},
        {504, 8, 0xFF, PF_ERR_FORMAT, "pupil_e1"},
        {512, 8, 0, PF_ERR_FORMAT, "theta_max"},
        {536, 8, 0xBF, PF_ERR_FORMAT, "circle_radius"},
        {544, 1, 8, PF_ERR_FORMAT, "free_param"},
        {545, 1, 41, PF_ERR_FORMAT, "free_param"},
        {546, 1, 9, PF_ERR_FORMAT, "free_param"},
        {583, 1, 1, PF_ERR_FORMAT, "free_param"},
        {584, 1, 2, PF_ERR_FORMAT, "units"},
        {592 + 7, 1, 0xBF, PF_ERR_FORMAT, "held_out_rms_px"},
        {592, 8, 0xFF, PF_ERR_FORMAT, "held_out_rms_px"},
        {608, 1, 0x7F, PF_ERR_FORMAT, "lens"},
        {672, 32, 'x', PF_ERR_FORMAT, "tool"},
        {735, 1, 'x', PF_ERR_FORMAT, "tool_version"},
        {736, 1, 9, PF_ERR_FORMAT, "model_choice"},
        {800, 1, 0, PF_ERR_FORMAT, "vectors"},
        {800, 1, 9, PF_ERR_FORMAT, "vectors"},
        {800, 1, 7, PF_ERR_FORMAT, "vectors"},
        {804, 1, 9, PF_ERR_FORMAT, "integers"},
        {804, 1, 1, PF_ERR_FORMAT, "length"},
        {COVARIANCE_AT + 7, 1, 0xBF, PF_ERR_FORMAT, "covariance"},
        {COVARIANCE_AT, 8, 0xFF, PF_ERR_FORMAT, "covariance"},
        {COVARIANCE_AT + 8 + 7, 1, 0x7F, PF_ERR_FORMAT, "covariance"},
        {COVARIANCE_AT + 8 + 7, 1, 0xC0, PF_ERR_FORMAT, "covariance"},
    };
    for (size_t i = 0; i < sizeof item / sizeof item[0]; i++) {
        pf_profile profile = sample();
        if (item[i].at == 248 + 7)
            profile.camera.k3 = 0.4; /* its sign bit makes r' = 1 - .09 s - 2 s^2 .. turn at 0.82 */
        uint8_t bytes[PF_PROFILE_BINARY_MAX];
        size_t n = encode_ok(&profile, bytes);
        memset(bytes + item[i].at, item[i].byte, item[i].count);
        repair(bytes, n);
        refused(item[i].status, bytes, n, item[i].field);
    }
    uint8_t tiny[16] = {'P', 'F', 'P', 'R'};
    put_u32(tiny + 8, 16);
    for (uint8_t version = 1; version <= 2; version++) {
        tiny[4] = version;
        repair(tiny, 16);
        refused(PF_ERR_FORMAT, tiny, 16, "length");
    }
    put_u32(tiny + 8, 15);
    refused(PF_ERR_FORMAT, tiny, 15, "length");
}

/* Proves: vectors that are right but all in one place, which would show nothing, are refused. */
static void test_vectors_that_lie_elsewhere_are_refused(void)
{
    pf_profile profile = sample();
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = encode_ok(&profile, bytes);
    for (uint32_t vector = 1; vector < PF_PROFILE_VECTORS; vector++)
        memcpy(bytes + VECTORS_AT + 64 * vector, bytes + VECTORS_AT, 64);
    repair(bytes, n);
    refused(PF_ERR_SELF_TEST, bytes, n, "self_test");
}

/* Proves: a covariance that no variables can have is refused, whatever its scale; one of rank 1 is not. */
static void test_a_covariance_that_cannot_be_is_refused(void)
{
    static const double scales[3] = {1e-300, 1, 1e300};
    for (int i = 0; i < 9; i++) {
        const double scale = scales[i / 3], r = i % 3 == 0 ? 1 : i % 3 == 1 ? -0.9 : 2;
        const double lower[6] = {scale, r * scale, scale, r * scale, r * scale, scale};
        pf_profile profile = sample();
        uint8_t bytes[PF_PROFILE_BINARY_MAX];
        size_t n;
        const char *why = "";
        memset(profile.free_param, 0, sizeof profile.free_param);
        memset(profile.covariance, 0, sizeof profile.covariance);
        memcpy(profile.covariance, lower, sizeof lower);
        profile.free_count = 3;
        for (uint32_t k = 0; k < 3; k++)
            profile.free_param[k] = (uint8_t)k;
        pf_status status = pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why);
        TEST_ASSERT_EQUAL_INT_MESSAGE(i % 3 == 0 ? PF_OK : PF_ERR_ARGUMENT, status, why);
        if (i % 3)
            TEST_ASSERT_EQUAL_STRING(
                i % 3 == 1 ? "covariance: not positive semidefinite" : "covariance: a correlation beyond 1", why);
    }
}

/* Proves: intact bytes whose vectors this device does not compute are refused as that, and by no more than the
 * tolerance: half of it passes. */
static void test_a_profile_that_disagrees_is_refused(void)
{
    static const struct {
        size_t at; /* in a vector */
        double error;
    } item[] = {{24, 2e-9}, {32, -2e-9}, {40, 2e-12}, {56, -2e-12}, {0, 1e-6}, {16, 1e-6}};
    pf_profile profile = sample(), out;
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = encode_ok(&profile, bytes);
    for (uint32_t vector = 0; vector < PF_PROFILE_VECTORS; vector++)
        for (size_t i = 0; i < sizeof item / sizeof item[0]; i++) {
            uint8_t *p = bytes + VECTORS_AT + 64 * vector + item[i].at, kept[8];
            double value, changed;
            memcpy(kept, p, 8);
            memcpy(&value, p, 8);
            changed = value + item[i].error;
            if (item[i].at == 16 && vector == 0)
                changed = -value; /* on the axis every distance has the same pixel */
            memcpy(p, &changed, 8);
            repair(bytes, n);
            refused(PF_ERR_SELF_TEST, bytes, n, "self_test");
            changed = value + item[i].error / 4;
            memcpy(p, &changed, 8);
            repair(bytes, n);
            if (item[i].at >= 40)
                TEST_ASSERT_EQUAL_INT(PF_OK, pf_profile_decode(bytes, n, &out, NULL));
            changed = (double)NAN;
            memcpy(p, &changed, 8);
            repair(bytes, n);
            refused(PF_ERR_FORMAT, bytes, n, "self_test");
            memcpy(p, kept, 8);
        }
}

/* Proves: the self-test of every model sees each of its parameters: with one of them off by a millionth the intact
 * bytes are refused. A model that the camera room of this build does not evaluate is refused as that. */
static void test_the_vectors_see_every_parameter_of_every_model(void)
{
    static const uint16_t place[PF_CAMERA_PARAMS] = {
        184, 192, 200, 208, 216, 240, 248, 256, 264, 272, 280, 288, 296, 304, 312, 320, 328, 336, 344, 352, 360,
        368, 376, 224, 232, 496, 504, 384, 392, 400, 408, 416, 424, 432, 440, 448, 456, 464, 472, 480, 488};
    uint32_t seen = 0;
    for (uint32_t n = 0; n <= 10; n++) {
        pf_profile profile = sample();
        uint8_t bytes[PF_PROFILE_BINARY_MAX], changed[PF_PROFILE_BINARY_MAX];
        size_t size = 0;
        const char *why = NULL;
        profile.camera = family(n);
        pf_status status = pf_profile_encode(&profile, bytes, sizeof bytes, &size, &why);
        if (status == PF_ERR_UNSUPPORTED)
            continue;
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, status, why);
        TEST_ASSERT_EQUAL_INT_MESSAGE(PF_OK, pf_profile_decode(bytes, size, &profile, &why), why);
        for (uint32_t i = 0; i < PF_CAMERA_PARAMS; i++) {
            double value = *pf_camera_param_at(&profile.camera, i);
            if (value == 0)
                continue;
            memcpy(changed, bytes, size);
            value += 9e-7; /* the norm of a Fourier vector may be off by a millionth */
            memcpy(changed + place[i], &value, 8);
            repair(changed, size);
            refused(PF_ERR_SELF_TEST, changed, size, "self_test");
            seen++;
        }
    }
    TEST_ASSERT_TRUE(seen >= 9);
}

/* Proves: what RFC 3629 excludes is no text: overlong forms, surrogates, beyond U+10FFFF, cut and stray bytes, C1. */
static void test_text_must_be_utf8(void)
{
    static const char *const bad[] = {
        "\xC0\x80", "\xE0\x9F\xBF", "\xED\xA0\x80", "\xF0\x8F\xBF\xBF", "\xF4\x90\x80\x80", "\xF5",
        "\xE2\x82", "\xE2\x28\xA1", "a\xBF",        "\xC2\x9F"};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        pf_profile profile = sample();
        uint8_t bytes[PF_PROFILE_BINARY_MAX];
        size_t n = encode_ok(&profile, bytes);
        memset(bytes + 104, 0, 64);
        memcpy(bytes + 104, bad[i], strlen(bad[i]));
        repair(bytes, n);
        refused(PF_ERR_FORMAT, bytes, n, "serial");
        memset(bytes + 104, 'x', 64);
        memcpy(bytes + 168 - strlen(bad[i]), bad[i], strlen(bad[i]));
        repair(bytes, n);
        refused(PF_ERR_FORMAT, bytes, n, "serial");
    }
}

/* Proves: random bytes, bare or behind a right envelope, never pass and never read out of bounds (ASan). */
static void test_garbage(void)
{
    uint32_t state = 1;
    for (int round = 0; round < 4000; round++) {
        uint8_t bytes[1024];
        size_t n = 16 + (size_t)round % 1000;
        for (size_t i = 0; i < n; i++) {
            state = state * 1664525u + 1013904223u;
            bytes[i] = (uint8_t)(state >> 24);
        }
        if (round % 2) {
            memcpy(bytes, "PFPR\2\0\0\0", 8);
            bytes[4] = (uint8_t)(1 + round / 2 % 2);
            put_u32(bytes + 8, (uint32_t)n);
            repair(bytes, n);
        }
        pf_profile profile;
        TEST_ASSERT_TRUE(pf_profile_decode(bytes, n, &profile, NULL) < 0);
    }
}

/* Proves: encode refuses what decode would, and says why; a buffer one byte short is refused before it is touched. */
static void test_encode_refuses(void)
{
    uint8_t bytes[PF_PROFILE_BINARY_MAX];
    size_t n = 12345;
    const char *why = NULL;
    pf_profile profile = sample();
    memset(bytes, 0x5A, sizeof bytes);
    TEST_ASSERT_EQUAL_INT(PF_ERR_SPACE, pf_profile_encode(&profile, bytes, sizeof GOLDEN_2 / 2 - 1, &n, &why));
    TEST_ASSERT_EACH_EQUAL_HEX8(0x5A, bytes, sizeof bytes);
    profile.integers_count = 9;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why));
    profile = sample();
    profile.free_count = 41;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why));
    profile = sample();
    memset(profile.name, 'x', sizeof profile.name);
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why));
    TEST_ASSERT_EQUAL_STRING_LEN("name:", why, 5);
    profile = sample();
    profile.created_unix_s = -1;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why));
    profile = sample();
    profile.camera.f_u = (double)NAN;
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, bytes, sizeof bytes, &n, NULL));
    profile = sample();
    profile.camera.k2 = -1;
    TEST_ASSERT_EQUAL_INT(PF_ERR_DOMAIN, pf_profile_encode(&profile, bytes, sizeof bytes, &n, &why));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(NULL, bytes, sizeof bytes, &n, &why));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, NULL, sizeof bytes, &n, &why));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_encode(&profile, bytes, sizeof bytes, NULL, &why));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_decode(NULL, 0, &profile, &why));
    TEST_ASSERT_EQUAL_INT(PF_ERR_ARGUMENT, pf_profile_decode(bytes, 0, NULL, &why));
    TEST_ASSERT_EQUAL_size_t(12345, n);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_stored_bytes_of_version_1_load);
    RUN_TEST(test_stored_bytes_of_version_2_load);
    RUN_TEST(test_round_trip_of_every_field_and_extreme);
    RUN_TEST(test_text_is_padded_with_zeros);
    RUN_TEST(test_truncation_at_every_length);
    RUN_TEST(test_every_flipped_bit_is_detected);
    RUN_TEST(test_other_versions_are_named_as_such);
    RUN_TEST(test_bad_fields_are_refused_and_named);
    RUN_TEST(test_a_profile_that_disagrees_is_refused);
    RUN_TEST(test_vectors_that_lie_elsewhere_are_refused);
    RUN_TEST(test_a_covariance_that_cannot_be_is_refused);
    RUN_TEST(test_the_vectors_see_every_parameter_of_every_model);
    RUN_TEST(test_text_must_be_utf8);
    RUN_TEST(test_garbage);
    RUN_TEST(test_encode_refuses);
    return UNITY_END();
}
