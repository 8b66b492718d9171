/* The profile's binary format; SPEC.md describes it. Encoding writes the bytes and then checks those bytes, so there is
 * one set of rules, and decoding can check before it touches the caller's profile without a copy of it. */
#include "pipefish/profile.h"

#include "bytes.h"
#include "vectors.h"

#define AT_MAGIC        0u
#define AT_VERSION      4u
#define AT_LENGTH       8u
#define AT_SOURCE       12u
#define AT_CREATED      16u
#define AT_RMS          24u
#define AT_COVERED      32u
#define AT_NAME         40u
#define AT_SERIAL       104u
#define AT_WIDTH        168u
#define AT_HEIGHT       172u
#define AT_RADIAL       176u
#define AT_FREE_COUNT   180u
#define AT_CAMERA       184u
#define AT_FREE_PARAM   544u
#define AT_COVARIANCE_1 584u /* where version 1 has its covariance */

/* What version 2 puts in front of the covariance; behind it come the self-test vectors. */
#define AT_UNITS        584u
#define AT_HELD_VIEWS   588u
#define AT_HELD_RMS     592u
#define AT_VIEWS        600u
#define AT_POINTS       604u
#define AT_LENS         608u
#define AT_TOOL         672u
#define AT_TOOL_VERSION 704u
#define AT_MODEL_CHOICE 736u
#define AT_VECTORS      800u
#define AT_INTEGERS     804u
#define AT_COVARIANCE_2 808u

#define CHECKSUM_BYTES 4u
#define INTEGERS_BYTES 28u

#define UNITS 1u /* pixels with the centre of the top-left one at (0, 0), radians, metres: there are no others */

/* 9999-12-31T23:59:59Z: the last second that the JSON form can write. */
#define CREATED_MAX 253402300799

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
                   AT_COVARIANCE_1 == AT_FREE_PARAM + PF_PROFILE_FREE_MAX && AT_TOOL == AT_LENS + PF_PROFILE_NAME_MAX &&
                   AT_TOOL_VERSION == AT_TOOL + PF_PROFILE_TOOL_MAX &&
                   AT_MODEL_CHOICE == AT_TOOL_VERSION + PF_PROFILE_TOOL_MAX &&
                   AT_VECTORS == AT_MODEL_CHOICE + PF_PROFILE_NAME_MAX,
               "the layout of the images that are on devices");
_Static_assert(AT_COVARIANCE_2 + sizeof(((pf_profile *)0)->covariance) + PF_PROFILE_VECTORS * PF_VECTOR_BYTES +
                       PF_PROFILE_INTEGERS * INTEGERS_BYTES + CHECKSUM_BYTES <=
                   PF_PROFILE_BINARY_MAX,
               "PF_PROFILE_BINARY_MAX");

typedef struct text_field {
    uint32_t since; /* version of the format */
    size_t at, size, offset;
    const char *why;
} text_field;
#define TEXT(since, at, field)                                                                                         \
    {                                                                                                                  \
        since, at, sizeof(((pf_profile *)0)->field), offsetof(pf_profile, field),                                      \
            #field ": not UTF-8 text without control characters, or too long"                                          \
    }
static const text_field TEXTS[] = {
    TEXT(1, AT_NAME, name),
    TEXT(1, AT_SERIAL, serial),
    TEXT(2, AT_LENS, lens),
    TEXT(2, AT_TOOL, tool),
    TEXT(2, AT_TOOL_VERSION, tool_version),
    TEXT(2, AT_MODEL_CHOICE, model_choice),
};
#define TEXT_COUNT (sizeof TEXTS / sizeof TEXTS[0])

/* By the exponent's bits, for this room has no math.h. */
static bool is_finite(const uint8_t *p)
{
    return (get_u64(p) >> 52 & 0x7FFu) != 0x7FFu;
}

/* The only NaN a file may hold, so that one profile has one encoding. */
#define NAN_BITS 0x7FF8000000000000u

static size_t covariance_bytes(uint32_t free_count)
{
    return (size_t)free_count * (free_count + 1) / 2 * sizeof(double);
}

/* Where what changed with the version lies; lengths as the counts in the bytes say. */
typedef struct layout {
    uint32_t version, vectors, integers;
    size_t covariance, vectors_at, length;
} layout;

static layout layout_of(uint32_t version, uint32_t free_count, uint32_t vectors, uint32_t integers)
{
    layout l = {.version = version, .vectors = vectors, .integers = integers};
    l.covariance = version == 1 ? AT_COVARIANCE_1 : AT_COVARIANCE_2;
    l.vectors_at = l.covariance + covariance_bytes(free_count);
    l.length = l.vectors_at + (size_t)vectors * PF_VECTOR_BYTES + (size_t)integers * INTEGERS_BYTES + CHECKSUM_BYTES;
    return l;
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
static bool is_text(const uint8_t *p, size_t size)
{
    size_t n = 0;
    while (n < size && p[n] != 0) {
        size_t bytes = utf8_character(p + n, size - n);
        if (bytes == 0)
            return false;
        n += bytes;
    }
    for (size_t i = n; i < size; i++)
        if (p[i] != 0)
            return false;
    return n < size;
}

static bool is_rms(const uint8_t *p)
{
    return get_u64(p) == NAN_BITS || (is_finite(p) && get_f64(p) >= 0);
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

/* 2^-k with 2^2k <= v < 2^(2k + 2): brings a variance of any size to 1..4. */
static double half_scale(double v)
{
    uint64_t bits;
    memcpy(&bits, &v, sizeof bits);
    int32_t exponent = (int32_t)(bits >> 52 & 0x7FFu) - 1023,
            half = exponent >= 0 ? exponent / 2 : -((1 - exponent) / 2);
    bits = (uint64_t)(1023 - half) << 52;
    memcpy(&v, &bits, sizeof v);
    return v;
}

/* Finite, and positive semidefinite up to rounding: with the variances scaled to 1..4 and 1e-9 on the diagonal, more
 * than the rounding of 40 rows by far, Cholesky's pivots (of L D L^T, for this room has no sqrt) are positive. */
static pf_status check_matrix(const uint8_t *row, uint32_t count, const char **why)
{
    double factor[PF_PROFILE_FREE_MAX * (PF_PROFILE_FREE_MAX + 1) / 2], pivot[PF_PROFILE_FREE_MAX],
        scale[PF_PROFILE_FREE_MAX], variance[PF_PROFILE_FREE_MAX], *at = factor;
    for (uint32_t i = 0; i < count; row += (i + 1) * sizeof(double), at += i + 1, i++) {
        for (uint32_t j = 0; j <= i; j++)
            if (!is_finite(row + j * sizeof(double)))
                return refuse(PF_ERR_FORMAT, "covariance: not finite", why);
        double v = get_f64(row + i * sizeof(double));
        if (!(v >= 0))
            return refuse(PF_ERR_FORMAT, "covariance: a negative variance", why);
        scale[i] = half_scale(v);
        variance[i] = v * scale[i] * scale[i];
        pivot[i] = variance[i] + 1e-9;
        for (uint32_t j = 0; j < i; j++) {
            const double *other = factor + j * (j + 1) / 2;
            double c = get_f64(row + j * sizeof(double)) * scale[i] * scale[j], sum = c;
            if (!(c * c <= variance[i] * variance[j] * (1 + 1e-9))) /* 1e-9: a correlation of 1 after rounding */
                return refuse(PF_ERR_FORMAT, "covariance: a correlation beyond 1", why);
            for (uint32_t k = 0; k < j; k++)
                sum -= at[k] * pivot[k] * other[k];
            at[j] = sum / pivot[j];
            pivot[i] -= at[j] * sum;
        }
        if (!(pivot[i] > 0))
            return refuse(PF_ERR_FORMAT, "covariance: not positive semidefinite", why);
    }
    return PF_OK;
}

static pf_status check_covariance(const uint8_t *bytes, const uint8_t *row, const char **why)
{
    uint32_t count = get_u32(bytes + AT_FREE_COUNT);
    const uint8_t *param = bytes + AT_FREE_PARAM;
    for (uint32_t i = 0; i < PF_PROFILE_FREE_MAX; i++) {
        if (i >= count && param[i] != 0)
            return refuse(PF_ERR_FORMAT, "free_param: not zero beyond free_count", why);
        if (i < count && param[i] >= PF_CAMERA_PARAMS)
            return refuse(PF_ERR_FORMAT, "free_param: no such parameter", why);
        if (i > 0 && i < count && param[i] <= param[i - 1])
            return refuse(PF_ERR_FORMAT, "free_param: not in increasing order", why);
    }
    return check_matrix(row, count, why);
}

/* Everything between the length and the vectors, for bytes as long as the layout says. */
static pf_status check_fields(const uint8_t *bytes, const layout *l, const char **why)
{
    if (get_u32(bytes + AT_SOURCE) > PF_SOURCE_SIMULATED)
        return refuse(PF_ERR_FORMAT, "source: no such source", why);
    if (get_u64(bytes + AT_CREATED) > CREATED_MAX)
        return refuse(PF_ERR_FORMAT, "created_unix_s: before 1970 or after 9999", why);
    if (!is_rms(bytes + AT_RMS))
        return refuse(PF_ERR_FORMAT, "rms_px: neither a residual nor unknown", why);
    double covered = get_f64(bytes + AT_COVERED);
    if (!(covered >= 0 && covered <= PF_CAMERA_THETA_MAX))
        return refuse(PF_ERR_FORMAT, "theta_covered: not within 0..pi radians, pi excluded", why);
    for (size_t i = 0; i < TEXT_COUNT; i++)
        if (TEXTS[i].since <= l->version && !is_text(bytes + TEXTS[i].at, TEXTS[i].size))
            return refuse(PF_ERR_FORMAT, TEXTS[i].why, why);
    if (l->version >= 2) {
        if (get_u32(bytes + AT_UNITS) != UNITS)
            return refuse(PF_ERR_FORMAT, "units: not pixels, radians and metres", why);
        if (!is_rms(bytes + AT_HELD_RMS))
            return refuse(PF_ERR_FORMAT, "held_out_rms_px: neither a residual nor unknown", why);
    }
    pf_camera camera;
    read_camera(bytes, &camera);
    pf_status status = pf_camera_check(&camera, why);
    if (status != PF_OK)
        return status == PF_ERR_ARGUMENT ? PF_ERR_FORMAT : status;
    return check_covariance(bytes, bytes + l->covariance, why);
}

/* The self-test, of fields that have been checked. */
static pf_status check_vectors(const uint8_t *bytes, const layout *l, const char **why)
{
    pf_camera camera;
    read_camera(bytes, &camera);
    return pf_vectors_check(&camera, bytes + l->vectors_at, l->vectors, why);
}

static void put_text(uint8_t *p, const char *value, size_t size)
{
    size_t n = 0;
    while (n < size && value[n] != 0)
        n++;
    memcpy(p, value, n);
    memset(p + n, 0, size - n);
}

static void put_rms(uint8_t *p, double value)
{
    if (value != value)
        put_u64(p, NAN_BITS);
    else
        put_f64(p, value);
}

static void put_integers(uint8_t *p, const pf_profile *profile)
{
    for (uint32_t i = 0; i < profile->integers_count; i++) {
        const pf_profile_integers *v = profile->integers + i;
        const int32_t value[7] = {v->pixel.x, v->pixel.y, v->ray.x, v->ray.y, v->ray.z, v->back.x, v->back.y};
        for (uint32_t j = 0; j < 7; j++, p += 4)
            put_u32(p, (uint32_t)value[j]);
    }
}

static void read_integers(const uint8_t *p, uint32_t count, pf_profile *profile)
{
    profile->integers_count = count;
    for (uint32_t i = 0; i < count; i++) {
        int32_t value[7];
        for (uint32_t j = 0; j < 7; j++, p += 4)
            value[j] = (int32_t)get_u32(p);
        profile->integers[i] =
            (pf_profile_integers){{value[0], value[1]}, {value[2], value[3], value[4]}, {value[5], value[6]}};
    }
}

static void put_fields(const pf_profile *profile, const layout *l, uint8_t *out)
{
    memcpy(out + AT_MAGIC, MAGIC, sizeof MAGIC);
    put_u32(out + AT_VERSION, l->version);
    put_u32(out + AT_LENGTH, (uint32_t)l->length);
    put_u32(out + AT_SOURCE, profile->source);
    put_u64(out + AT_CREATED, (uint64_t)profile->created_unix_s);
    put_rms(out + AT_RMS, profile->rms_px);
    put_f64(out + AT_COVERED, profile->theta_covered);
    for (size_t i = 0; i < TEXT_COUNT; i++)
        put_text(out + TEXTS[i].at, (const char *)profile + TEXTS[i].offset, TEXTS[i].size);
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
    put_u32(out + AT_UNITS, UNITS);
    put_u32(out + AT_HELD_VIEWS, profile->held_out_views);
    put_rms(out + AT_HELD_RMS, profile->held_out_rms_px);
    put_u32(out + AT_VIEWS, profile->views);
    put_u32(out + AT_POINTS, profile->points);
    put_u32(out + AT_VECTORS, l->vectors);
    put_u32(out + AT_INTEGERS, l->integers);
    for (size_t i = 0; i < covariance_bytes(profile->free_count) / sizeof(double); i++)
        put_f64(out + l->covariance + i * sizeof(double), profile->covariance[i]);
}

pf_status pf_profile_encode(const pf_profile *profile, uint8_t *out, size_t capacity, size_t *n, const char **why)
{
    const char *ignored;
    why = why ? why : &ignored;
    if (!profile || !out || !n)
        return refuse(PF_ERR_ARGUMENT, "profile: a null pointer", why);
    if (profile->free_count > PF_PROFILE_FREE_MAX)
        return refuse(PF_ERR_ARGUMENT, "free_count: more than 40", why);
    if (profile->integers_count > PF_PROFILE_INTEGERS)
        return refuse(PF_ERR_ARGUMENT, "integers: more than 8", why);
    layout l = layout_of(PF_PROFILE_FORMAT, profile->free_count, PF_PROFILE_VECTORS, profile->integers_count);
    if (capacity < l.length)
        return refuse(PF_ERR_SPACE, "profile: the buffer is too small", why);

    put_fields(profile, &l, out);
    pf_status status = check_fields(out, &l, why);
    if (status != PF_OK)
        return status == PF_ERR_FORMAT ? PF_ERR_ARGUMENT : status;
    if (pf_vectors_write(&profile->camera, out + l.vectors_at) != PF_OK)
        return refuse(PF_ERR_DOMAIN, "self_test: the camera cannot be evaluated", why);
    put_integers(out + l.vectors_at + PF_PROFILE_VECTORS * PF_VECTOR_BYTES, profile);
    put_u32(out + l.length - CHECKSUM_BYTES, pf_crc32c(0, out, l.length - CHECKSUM_BYTES));
    *n = l.length;
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
    if (get_u32(bytes + AT_VERSION) < 1 || get_u32(bytes + AT_VERSION) > PF_PROFILE_FORMAT)
        return refuse(PF_ERR_VERSION, "version: written by a version that this one cannot read", why);
    return PF_OK;
}

/* The counts, which the length must agree with. */
static pf_status check_layout(const uint8_t *bytes, size_t n, layout *l, const char **why)
{
    uint32_t version = get_u32(bytes + AT_VERSION), vectors = 0, integers = 0;
    if (n < (version == 1 ? AT_COVARIANCE_1 : AT_COVARIANCE_2) + CHECKSUM_BYTES)
        return refuse(PF_ERR_FORMAT, "length: shorter than any profile of its version", why);
    uint32_t free_count = get_u32(bytes + AT_FREE_COUNT);
    if (free_count > PF_PROFILE_FREE_MAX)
        return refuse(PF_ERR_FORMAT, "free_count: more than 40", why);
    if (version >= 2) {
        vectors = get_u32(bytes + AT_VECTORS);
        integers = get_u32(bytes + AT_INTEGERS);
        if (vectors != PF_PROFILE_VECTORS)
            return refuse(PF_ERR_FORMAT, "vectors: not 8", why);
        if (integers > PF_PROFILE_INTEGERS)
            return refuse(PF_ERR_FORMAT, "integers: more than 8", why);
    }
    *l = layout_of(version, free_count, vectors, integers);
    if (n != l->length)
        return refuse(PF_ERR_FORMAT, "length: does not agree with the counts", why);
    return PF_OK;
}

pf_status pf_profile_decode(const uint8_t *bytes, size_t n, pf_profile *profile, const char **why)
{
    const char *ignored;
    layout l;
    why = why ? why : &ignored;
    if (!bytes || !profile)
        return refuse(PF_ERR_ARGUMENT, "profile: a null pointer", why);
    pf_status status = check_envelope(bytes, n, why);
    if (status == PF_OK)
        status = check_layout(bytes, n, &l, why);
    if (status == PF_OK)
        status = check_fields(bytes, &l, why);
    if (status == PF_OK)
        status = check_vectors(bytes, &l, why);
    if (status != PF_OK)
        return status;

    memset(profile, 0, sizeof *profile);
    read_camera(bytes, &profile->camera);
    for (size_t i = 0; i < TEXT_COUNT; i++)
        if (TEXTS[i].since <= l.version)
            memcpy((char *)profile + TEXTS[i].offset, bytes + TEXTS[i].at, TEXTS[i].size);
    profile->source = get_u32(bytes + AT_SOURCE);
    profile->created_unix_s = (int64_t)get_u64(bytes + AT_CREATED);
    profile->rms_px = get_f64(bytes + AT_RMS);
    profile->theta_covered = get_f64(bytes + AT_COVERED);
    if (l.version >= 2) {
        profile->held_out_rms_px = get_f64(bytes + AT_HELD_RMS);
        profile->held_out_views = get_u32(bytes + AT_HELD_VIEWS);
        profile->views = get_u32(bytes + AT_VIEWS);
        profile->points = get_u32(bytes + AT_POINTS);
    } else {
        static const uint64_t unknown = NAN_BITS;
        memcpy(&profile->held_out_rms_px, &unknown, sizeof unknown);
    }
    profile->free_count = get_u32(bytes + AT_FREE_COUNT);
    memcpy(profile->free_param, bytes + AT_FREE_PARAM, sizeof profile->free_param);
    for (size_t i = 0; i < covariance_bytes(profile->free_count) / sizeof(double); i++)
        profile->covariance[i] = get_f64(bytes + l.covariance + i * sizeof(double));
    read_integers(bytes + l.vectors_at + l.vectors * PF_VECTOR_BYTES, l.integers, profile);
    return refuse(PF_OK, "ok", why);
}
