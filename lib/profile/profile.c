/* The profile's binary format; docs/profile.md describes it. Encoding writes the bytes and then checks those bytes, so
 * there is one set of rules, and decoding can check before it touches the caller's profile without a copy of it. */
#include "pipefish/profile.h"

#include <string.h>

#define AT_MAGIC       0u
#define AT_VERSION     4u
#define AT_LENGTH      8u
#define AT_SOURCE      12u
#define AT_CREATED     16u
#define AT_RMS         24u
#define AT_COVERED     32u
#define AT_NAME        40u
#define AT_SERIAL      104u
#define AT_WIDTH       168u
#define AT_HEIGHT      172u
#define AT_RADIAL      176u
#define AT_FREE_COUNT  180u
#define AT_CAMERA      184u
#define AT_FREE_PARAM  544u
#define AT_COVARIANCE  584u
#define CHECKSUM_BYTES 4u
#define SMALLEST       (AT_COVARIANCE + CHECKSUM_BYTES)

/* 9999-12-31T23:59:59Z: the last second that the JSON form can write. */
#define CREATED_MAX 253402300799

#define THETA_MAX 3.1415926535897927 /* the last number before pi */

static const uint8_t MAGIC[4] = {'P', 'F', 'P', 'R'};

/* The doubles of pf_camera in the order of the file. */
typedef struct run {
    size_t offset, count;
} run;
#define RUN(field)                                                                                                     \
    {                                                                                                                  \
        offsetof(pf_camera, field), sizeof(((pf_camera *)0)->field) / sizeof(double)                                   \
    }
static const run CAMERA_RUNS[] = {
    RUN(f_u),
    RUN(f_v),
    RUN(skew),
    RUN(c_u),
    RUN(c_v),
    RUN(tilt),
    RUN(k2),
    RUN(k3),
    RUN(k4),
    RUN(k5),
    RUN(asym_radial_theta),
    RUN(asym_radial_phi),
    RUN(asym_tangential_theta),
    RUN(asym_tangential_phi),
    RUN(cpoly),
    RUN(mirror),
    RUN(pupil_e1),
    RUN(theta_max),
    RUN(circle_u),
    RUN(circle_v),
    RUN(circle_radius),
};

_Static_assert(AT_SERIAL == AT_NAME + PF_PROFILE_NAME_MAX && AT_WIDTH == AT_SERIAL + PF_PROFILE_NAME_MAX &&
                   AT_FREE_PARAM == AT_CAMERA + 45 * sizeof(double) &&
                   AT_COVARIANCE == AT_FREE_PARAM + PF_PROFILE_FREE_MAX,
               "the layout of the images that are on devices");
_Static_assert(SMALLEST + sizeof(((pf_profile *)0)->covariance) <= PF_PROFILE_BINARY_MAX, "PF_PROFILE_BINARY_MAX");

static void put_u32(uint8_t *p, uint32_t value)
{
    for (unsigned i = 0; i < 4; i++)
        p[i] = (uint8_t)(value >> (8 * i));
}

static uint32_t get_u32(const uint8_t *p)
{
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static void put_u64(uint8_t *p, uint64_t value)
{
    put_u32(p, (uint32_t)value);
    put_u32(p + 4, (uint32_t)(value >> 32));
}

static uint64_t get_u64(const uint8_t *p)
{
    return (uint64_t)get_u32(p) | (uint64_t)get_u32(p + 4) << 32;
}

static void put_f64(uint8_t *p, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    put_u64(p, bits);
}

static double get_f64(const uint8_t *p)
{
    uint64_t bits = get_u64(p);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* By the exponent's bits, for this room has no math.h. */
static bool is_finite(const uint8_t *p)
{
    return (get_u64(p) >> 52 & 0x7FFu) != 0x7FFu;
}

/* The only NaN a file may hold, so that one profile has one encoding. */
#define NAN_BITS 0x7FF8000000000000u

static size_t encoded_length(uint32_t free_count)
{
    return SMALLEST + (size_t)free_count * (free_count + 1) / 2 * sizeof(double);
}

static pf_status refuse(pf_status status, const char *text, const char **why)
{
    *why = text;
    return status;
}

/* Bytes of the UTF-8 character at p, at most `room`; 0 for a control character or what RFC 3629 section 4 excludes. */
static size_t utf8_character(const uint8_t *p, size_t room)
{
    static const struct {
        uint8_t first, last, second_min, second_max, bytes;
    } rule[] = {
        {0x20, 0x7E, 0, 0, 1},       {0xC2, 0xC2, 0xA0, 0xBF, 2}, /* U+0080..9F are controls */
        {0xC3, 0xDF, 0x80, 0xBF, 2}, {0xE0, 0xE0, 0xA0, 0xBF, 3}, {0xE1, 0xEC, 0x80, 0xBF, 3},
        {0xED, 0xED, 0x80, 0x9F, 3}, {0xEE, 0xEF, 0x80, 0xBF, 3}, {0xF0, 0xF0, 0x90, 0xBF, 4},
        {0xF1, 0xF3, 0x80, 0xBF, 4}, {0xF4, 0xF4, 0x80, 0x8F, 4},
    };
    for (size_t i = 0; i < sizeof rule / sizeof rule[0]; i++) {
        if (p[0] < rule[i].first || p[0] > rule[i].last)
            continue;
        size_t bytes = rule[i].bytes;
        if (bytes > room || (bytes > 1 && (p[1] < rule[i].second_min || p[1] > rule[i].second_max)))
            return 0;
        for (size_t j = 2; j < bytes; j++)
            if (p[j] < 0x80 || p[j] > 0xBF)
                return 0;
        return bytes;
    }
    return 0;
}

/* Text, then zeros to the end, at least one. */
static bool is_text(const uint8_t *p)
{
    size_t n = 0;
    while (n < PF_PROFILE_NAME_MAX && p[n] != 0) {
        size_t bytes = utf8_character(p + n, PF_PROFILE_NAME_MAX - n);
        if (bytes == 0)
            return false;
        n += bytes;
    }
    for (size_t i = n; i < PF_PROFILE_NAME_MAX; i++)
        if (p[i] != 0)
            return false;
    return n < PF_PROFILE_NAME_MAX;
}

static void read_camera(const uint8_t *bytes, pf_camera *camera)
{
    camera->width = get_u32(bytes + AT_WIDTH);
    camera->height = get_u32(bytes + AT_HEIGHT);
    camera->radial = get_u32(bytes + AT_RADIAL);
    const uint8_t *p = bytes + AT_CAMERA;
    for (size_t i = 0; i < sizeof CAMERA_RUNS / sizeof CAMERA_RUNS[0]; i++)
        for (size_t j = 0; j < CAMERA_RUNS[i].count; j++, p += sizeof(double)) {
            double value = get_f64(p);
            memcpy((uint8_t *)camera + CAMERA_RUNS[i].offset + j * sizeof value, &value, sizeof value);
        }
}

static pf_status check_covariance(const uint8_t *bytes, const char **why)
{
    uint32_t count = get_u32(bytes + AT_FREE_COUNT);
    const uint8_t *param = bytes + AT_FREE_PARAM, *row = bytes + AT_COVARIANCE;
    for (uint32_t i = 0; i < PF_PROFILE_FREE_MAX; i++) {
        if (i >= count && param[i] != 0)
            return refuse(PF_ERR_FORMAT, "free_param: not zero beyond free_count", why);
        if (i < count && param[i] >= PF_PROFILE_PARAMS)
            return refuse(PF_ERR_FORMAT, "free_param: no such parameter", why);
        if (i > 0 && i < count && param[i] <= param[i - 1])
            return refuse(PF_ERR_FORMAT, "free_param: not in increasing order", why);
    }
    double variance[PF_PROFILE_FREE_MAX];
    for (uint32_t i = 0; i < count; i++) {
        for (uint32_t j = 0; j <= i; j++)
            if (!is_finite(row + j * sizeof(double)))
                return refuse(PF_ERR_FORMAT, "covariance: not finite", why);
        variance[i] = get_f64(row + i * sizeof(double));
        if (!(variance[i] >= 0))
            return refuse(PF_ERR_FORMAT, "covariance: a negative variance", why);
        for (uint32_t j = 0; j < i; j++) {
            double c = get_f64(row + j * sizeof(double));
            if (c * c > variance[i] * variance[j] * (1 + 1e-9)) /* 1e-9: a correlation of 1 after rounding */
                return refuse(PF_ERR_FORMAT, "covariance: a correlation beyond 1", why);
        }
        row += (i + 1) * sizeof(double);
    }
    return PF_OK;
}

/* Everything between the length and the checksum, for bytes as long as encoded_length says. */
static pf_status check_fields(const uint8_t *bytes, const char **why)
{
    if (get_u32(bytes + AT_SOURCE) > PF_SOURCE_SIMULATED)
        return refuse(PF_ERR_FORMAT, "source: no such source", why);
    if (get_u64(bytes + AT_CREATED) > CREATED_MAX)
        return refuse(PF_ERR_FORMAT, "created_unix_s: before 1970 or after 9999", why);
    if (get_u64(bytes + AT_RMS) != NAN_BITS && !(is_finite(bytes + AT_RMS) && get_f64(bytes + AT_RMS) >= 0))
        return refuse(PF_ERR_FORMAT, "rms_px: neither a residual nor unknown", why);
    double covered = get_f64(bytes + AT_COVERED);
    if (!(covered >= 0 && covered <= THETA_MAX))
        return refuse(PF_ERR_FORMAT, "theta_covered: not within 0..pi radians, pi excluded", why);
    if (!is_text(bytes + AT_NAME))
        return refuse(PF_ERR_FORMAT, "name: not UTF-8 text of at most 63 bytes without control characters", why);
    if (!is_text(bytes + AT_SERIAL))
        return refuse(PF_ERR_FORMAT, "serial: not UTF-8 text of at most 63 bytes without control characters", why);
    pf_camera camera;
    read_camera(bytes, &camera);
    pf_status status = pf_camera_check(&camera, why);
    if (status != PF_OK)
        return status == PF_ERR_ARGUMENT ? PF_ERR_FORMAT : status;
    return check_covariance(bytes, why);
}

static void put_text(uint8_t *p, const char *text)
{
    size_t n = 0;
    while (n < PF_PROFILE_NAME_MAX && text[n] != 0)
        n++;
    memcpy(p, text, n);
    memset(p + n, 0, PF_PROFILE_NAME_MAX - n);
}

pf_status pf_profile_encode(const pf_profile *profile, uint8_t *out, size_t capacity, size_t *n, const char **why)
{
    const char *ignored;
    why = why ? why : &ignored;
    if (!profile || !out || !n)
        return refuse(PF_ERR_ARGUMENT, "profile: a null pointer", why);
    if (profile->free_count > PF_PROFILE_FREE_MAX)
        return refuse(PF_ERR_ARGUMENT, "free_count: more than 40", why);
    size_t length = encoded_length(profile->free_count);
    if (capacity < length)
        return refuse(PF_ERR_SPACE, "profile: the buffer is too small", why);

    memcpy(out + AT_MAGIC, MAGIC, sizeof MAGIC);
    put_u32(out + AT_VERSION, PF_PROFILE_FORMAT);
    put_u32(out + AT_LENGTH, (uint32_t)length);
    put_u32(out + AT_SOURCE, profile->source);
    put_u64(out + AT_CREATED, (uint64_t)profile->created_unix_s);
    if (profile->rms_px != profile->rms_px)
        put_u64(out + AT_RMS, NAN_BITS);
    else
        put_f64(out + AT_RMS, profile->rms_px);
    put_f64(out + AT_COVERED, profile->theta_covered);
    put_text(out + AT_NAME, profile->name);
    put_text(out + AT_SERIAL, profile->serial);
    put_u32(out + AT_WIDTH, profile->camera.width);
    put_u32(out + AT_HEIGHT, profile->camera.height);
    put_u32(out + AT_RADIAL, profile->camera.radial);
    put_u32(out + AT_FREE_COUNT, profile->free_count);
    uint8_t *p = out + AT_CAMERA;
    for (size_t i = 0; i < sizeof CAMERA_RUNS / sizeof CAMERA_RUNS[0]; i++)
        for (size_t j = 0; j < CAMERA_RUNS[i].count; j++, p += sizeof(double)) {
            double value;
            memcpy(&value, (const uint8_t *)&profile->camera + CAMERA_RUNS[i].offset + j * sizeof value, sizeof value);
            put_f64(p, value);
        }
    memset(out + AT_FREE_PARAM, 0, PF_PROFILE_FREE_MAX);
    memcpy(out + AT_FREE_PARAM, profile->free_param, profile->free_count);
    for (size_t i = 0; i < (size_t)profile->free_count * (profile->free_count + 1) / 2; i++)
        put_f64(out + AT_COVARIANCE + i * sizeof(double), profile->covariance[i]);
    put_u32(out + length - CHECKSUM_BYTES, pf_crc32c(0, out, length - CHECKSUM_BYTES));

    pf_status status = check_fields(out, why);
    if (status != PF_OK)
        return status == PF_ERR_FORMAT ? PF_ERR_ARGUMENT : status;
    *n = length;
    return refuse(PF_OK, "ok", why);
}

/* What every version of the format keeps: magic, version and length in front, checksum behind. The checksum comes
 * before the version, or a damaged version number would pass for a newer program's. */
static pf_status check_envelope(const uint8_t *bytes, size_t n, const char **why)
{
    if (memcmp(bytes, MAGIC, n < sizeof MAGIC ? n : sizeof MAGIC) != 0)
        return refuse(PF_ERR_FORMAT, "magic: this is not a profile", why);
    if (n < AT_LENGTH + 4)
        return refuse(PF_ERR_TRUNCATED, "length: the data end before it", why);
    uint32_t length = get_u32(bytes + AT_LENGTH);
    if (length < AT_LENGTH + 4 + CHECKSUM_BYTES)
        return refuse(PF_ERR_FORMAT, "length: shorter than any profile", why);
    if (n < length)
        return refuse(PF_ERR_TRUNCATED, "length: the data end before the profile does", why);
    if (n > length)
        return refuse(PF_ERR_FORMAT, "length: data follow the profile", why);
    if (get_u32(bytes + n - CHECKSUM_BYTES) != pf_crc32c(0, bytes, n - CHECKSUM_BYTES))
        return refuse(PF_ERR_CHECKSUM, "checksum: the profile is damaged", why);
    if (get_u32(bytes + AT_VERSION) != PF_PROFILE_FORMAT)
        return refuse(PF_ERR_VERSION, "version: written by a version that this one cannot read", why);
    return PF_OK;
}

pf_status pf_profile_decode(const uint8_t *bytes, size_t n, pf_profile *profile, const char **why)
{
    const char *ignored;
    why = why ? why : &ignored;
    if (!bytes || !profile)
        return refuse(PF_ERR_ARGUMENT, "profile: a null pointer", why);
    pf_status status = check_envelope(bytes, n, why);
    if (status != PF_OK)
        return status;
    uint32_t count = n < SMALLEST ? 0 : get_u32(bytes + AT_FREE_COUNT);
    if (count > PF_PROFILE_FREE_MAX)
        return refuse(PF_ERR_FORMAT, "free_count: more than 40", why);
    if (n != encoded_length(count))
        return refuse(PF_ERR_FORMAT, "length: does not agree with free_count", why);
    status = check_fields(bytes, why);
    if (status != PF_OK)
        return status;

    memset(profile, 0, sizeof *profile);
    read_camera(bytes, &profile->camera);
    memcpy(profile->name, bytes + AT_NAME, sizeof profile->name);
    memcpy(profile->serial, bytes + AT_SERIAL, sizeof profile->serial);
    profile->source = get_u32(bytes + AT_SOURCE);
    profile->created_unix_s = (int64_t)get_u64(bytes + AT_CREATED);
    profile->rms_px = get_f64(bytes + AT_RMS);
    profile->theta_covered = get_f64(bytes + AT_COVERED);
    profile->free_count = count;
    memcpy(profile->free_param, bytes + AT_FREE_PARAM, sizeof profile->free_param);
    for (size_t i = 0; i < (size_t)count * (count + 1) / 2; i++)
        profile->covariance[i] = get_f64(bytes + AT_COVARIANCE + i * sizeof(double));
    return refuse(PF_OK, "ok", why);
}
