#include "sim/surface.hpp"
#include "parallel.hpp"

#include "sim/wide.hpp"

#include <array>
#include <bit>
#include <cstring>
#include <stdexcept>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace pipefish::sim
{

namespace
{

// Codes of a byte: albedo 0..1; the root of the spread (alpha^2 + slopes^2) 0..SPREAD; slopes around 128.
constexpr float SPREAD = 1.8f, ZERO_SLOPE = 128.0f, SLOPE_STEPS = 127.0f;

uint8_t to_byte(float x)
{
    return static_cast<uint8_t>(std::clamp(x + 0.5f, 0.0f, 255.0f));
}

// Pixels read all over hundreds of megabytes: with pages of 4 KB a tenth of a frame's time is spent on finding them.
void want_large_pages([[maybe_unused]] void *from, [[maybe_unused]] size_t size)
{
#ifdef __linux__
    constexpr uintptr_t PAGE = uintptr_t{2} << 20;
    const uintptr_t begin = (reinterpret_cast<uintptr_t>(from) + PAGE - 1) & ~(PAGE - 1);
    const uintptr_t end = (reinterpret_cast<uintptr_t>(from) + size) & ~(PAGE - 1);
    if (begin < end) {
        madvise(reinterpret_cast<void *>(begin), end - begin, MADV_HUGEPAGE); // advice: a refusal costs time only
    }
#endif
}

// Roots of the mean of two squared bytes.
const std::array<uint8_t, 65026> &roots()
{
    static const std::array<uint8_t, 65026> table = [] {
        std::array<uint8_t, 65026> t{};
        for (size_t i = 0; i < t.size(); i++) {
            t[i] = static_cast<uint8_t>(std::lround(std::sqrt(static_cast<double>(i))));
        }
        return t;
    }();
    return table;
}

} // namespace

Surface::Surface(const TextureSpec &spec, const std::vector<Marker> &markers, double radius, int around, double reach)
    : spec_(spec), look_(wall_look(spec)), markers_(markers), radius_(radius),
      texel_(2.0 * std::numbers::pi * radius / around), around_(around),
      chunks_(static_cast<int>(std::ceil(reach / (CHUNK * texel_))) + 2),
      levels_(static_cast<size_t>(AROUND_LEVELS) * ALONG_LEVELS)
{
    if (around < 64 || around > 16384 || (around & (around - 1)) != 0) {
        throw std::invalid_argument("texels around the pipe must be a power of two from 64 to 16384");
    }
    for (int a = 0; a < AROUND_LEVELS; a++) {
        for (int l = 0; l < ALONG_LEVELS; l++) {
            const size_t rows = static_cast<size_t>(chunks_ * CHUNK) >> l, columns = static_cast<size_t>(around_) >> a;
            std::vector<Packed> &image = levels_[static_cast<size_t>(a * ALONG_LEVELS + l)];
            image.reserve(rows * columns);
            want_large_pages(image.data(), rows * columns * sizeof(Packed));
            image.resize(rows * columns);
        }
    }
}

void Surface::prepare(double s_from, double s_to, int threads)
{
    const int64_t first = static_cast<int64_t>(std::floor(s_from / (CHUNK * texel_)));
    const int64_t last = std::min(static_cast<int64_t>(std::floor(s_to / (CHUNK * texel_))), first + chunks_ - 1);
    std::vector<int64_t> missing;
    for (int64_t chunk = first; chunk <= last; chunk++) {
        if (chunk < first_chunk_ || chunk > last_chunk_) {
            missing.push_back(chunk);
        }
    }
    parallel_for(static_cast<int>(missing.size()), threads, [&](int i) { generate(missing[static_cast<size_t>(i)]); });
    first_chunk_ = first;
    last_chunk_ = last;
}

void Surface::generate(int64_t chunk)
{
    // One more row at either end, for the slopes.
    const Canvas canvas{(static_cast<double>(chunk) * CHUNK - 1.0) * texel_, texel_, radius_, CHUNK + 2, around_};
    WallPaint paint = paint_wall(spec_, canvas);
    for (const Marker &m : markers_) {
        draw({m.s, m.phi * radius_, m.radius, m.radius, 1.0, 0.0}, canvas,
             [&](size_t i, float cover, float) { paint.albedo[i] += cover * (1.0f - paint.albedo[i]); });
    }
    pack(chunk, paint, level(0, 0) + slot(chunk) * CHUNK * static_cast<size_t>(around_));
    reduce(chunk);
}

void Surface::pack(int64_t chunk, const WallPaint &paint, Packed *out) const
{
    const size_t columns = static_cast<size_t>(around_);
    const float rise = static_cast<float>(0.5 / texel_), range = look_.slope_range, code = SLOPE_STEPS / range;
    for (size_t i = 1; i <= CHUNK; i++) {
        const float *const height = paint.height.data() + i * columns;
        for (size_t j = 0; j < columns; j++) {
            const size_t next = j + 1 < columns ? j + 1 : 0, before = j > 0 ? j - 1 : columns - 1;
            const float slope_s = std::clamp(rise * (height[j + columns] - *(height + j - columns)), -range, range);
            const float slope_c = std::clamp(rise * (height[next] - height[before]), -range, range);
            const float alpha = std::clamp(paint.alpha[i * columns + j], 0.02f, 1.0f);
            const float spread = std::sqrt(alpha * alpha + slope_s * slope_s + slope_c * slope_c);
            // Slopes are rounded at random: steps would show as rings in a highlight.
            const uint64_t dice = hash64(spec_.seed, STREAM_ROUNDING, static_cast<uint64_t>(chunk), i * columns + j);
            const float up_s = static_cast<float>(dice & 0xffffu) * 0x1p-16f - 0.5f;
            const float up_c = static_cast<float>((dice >> 16) & 0xffffu) * 0x1p-16f - 0.5f;
            *out++ = {to_byte(paint.albedo[i * columns + j] * 255.0f), to_byte(spread * (255.0f / SPREAD)),
                      to_byte(slope_s * code + ZERO_SLOPE + (slope_s == 0.0f ? 0.0f : up_s)),
                      to_byte(slope_c * code + ZERO_SLOPE + (slope_c == 0.0f ? 0.0f : up_c))};
        }
    }
}

// Box filter: each level along halves the rows of the one before, each level around the columns.
void Surface::reduce(int64_t chunk)
{
    const size_t at = slot(chunk);
    const auto &root = roots();
    // A half is rounded up and down in turn, or every level would gain a quarter of a step.
    const auto mean = [&](const Packed &a, const Packed &b, int odd) {
        const auto half = [odd](uint8_t x, uint8_t y) { return static_cast<uint8_t>((x + y + odd) >> 1); };
        return Packed{half(a.albedo, b.albedo),
                      root[static_cast<size_t>((a.spread * a.spread + b.spread * b.spread + odd) >> 1)],
                      half(a.slope_s, b.slope_s), half(a.slope_clock, b.slope_clock)};
    };
    for (int a = 0; a < AROUND_LEVELS; a++) {
        for (int l = 0; l < ALONG_LEVELS; l++) {
            if (a == 0 && l == 0) {
                continue;
            }
            const size_t columns = static_cast<size_t>(around_) >> a, rows = static_cast<size_t>(CHUNK) >> l;
            Packed *const out = level(a, l) + at * rows * columns;
            if (l > 0) {
                const Packed *const in = level(a, l - 1) + at * 2 * rows * columns;
                for (size_t i = 0; i < rows; i++) {
                    for (size_t j = 0; j < columns; j++) {
                        out[i * columns + j] =
                            mean(in[2 * i * columns + j], in[(2 * i + 1) * columns + j], static_cast<int>((i + j) & 1));
                    }
                }
            } else {
                const Packed *const in = level(a - 1, 0) + at * rows * columns * 2;
                for (size_t i = 0; i < rows * columns; i++) {
                    out[i] = mean(in[2 * i], in[2 * i + 1], static_cast<int>(i & 1));
                }
            }
        }
    }
}

PIPEFISH_WIDE Texel Surface::sample(float row, float column, float width_row, float width_column) const
{
    const float rows = static_cast<float>((last_chunk_ - first_chunk_ + 1) * CHUNK);
    if (!(row >= 0.0f && row < rows)) {
        return {look_.albedo, look_.alpha * look_.alpha, 0.0f, 0.0f};
    }
    // Level and the way to the next: log2 with straight lines between its whole values (at most 0.09 from it).
    const auto level_of = [](float width, int levels, float &blend) {
        const float within = std::clamp(width, 1.0f, static_cast<float>(1 << (levels - 1)));
        const uint32_t bits = std::bit_cast<uint32_t>(within);
        blend = static_cast<float>(bits & 0x7fffffu) * 0x1p-23f;
        return static_cast<int>(bits >> 23) - 127;
    };
    float s_blend = 0.0f, c_blend = 0.0f;
    const int s_level = level_of(width_row, ALONG_LEVELS, s_blend);
    const int c_level = level_of(width_column, AROUND_LEVELS, c_blend);
    using Quad __attribute__((vector_size(16))) = float;
    // Between neighbours and levels the root of the spread is interpolated, not the spread: a few per cent less.
    const auto read = [](const Packed &texel) { // whole vectors: the compilers widen four bytes one by one
        using Bytes __attribute__((vector_size(16))) = uint8_t;
        using Words __attribute__((vector_size(16))) = int32_t;
        static_assert(std::endian::native == std::endian::little);
        Words four = {0, 0, 0, 0};
        std::memcpy(&four, &texel, sizeof texel);
        const Bytes none = {0};
        const Bytes wide = __builtin_shufflevector(reinterpret_cast<Bytes>(four), none, 0, 16, 16, 16, 1, 16, 16, 16, 2,
                                                   16, 16, 16, 3, 16, 16, 16);
        return __builtin_convertvector(reinterpret_cast<Words>(wide), Quad);
    };
    const int first_row = static_cast<int>(slot(first_chunk_)) * CHUNK;
    Quad sum = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int l = s_level; l <= s_level + (s_blend > 0.0f ? 1 : 0); l++) {
        const float shrink = 1.0f / static_cast<float>(1 << l);
        const float weight_s = l == s_level ? 1.0f - s_blend : s_blend;
        const int ring = (chunks_ * CHUNK) >> l, row_base = first_row >> l;
        // Clamped at the ends of the prepared rows: beyond them the ring holds something else.
        const float y = std::clamp(row * shrink - 0.5f, 0.0f, rows * shrink - 1.0f);
        const int y0 = static_cast<int>(y), i0 = row_base + y0 < ring ? row_base + y0 : row_base + y0 - ring;
        const int i1 = static_cast<float>(y0) < rows * shrink - 1.0f ? (i0 + 1 < ring ? i0 + 1 : 0) : i0;
        const float fy = y - static_cast<float>(y0);
        for (int a = c_level; a <= c_level + (c_blend > 0.0f ? 1 : 0); a++) {
            const float weight = weight_s * (a == c_level ? 1.0f - c_blend : c_blend);
            const int columns = around_ >> a;
            const float x = column * (1.0f / static_cast<float>(1 << a)) - 0.5f;
            const float x_floor = std::floor(x), fx = x - x_floor;
            const int j0 = static_cast<int>(x_floor) & (columns - 1), j1 = (j0 + 1) & (columns - 1);
            const Packed *const image = level(a, l);
            const Packed *const r0 = image + static_cast<size_t>(i0) * static_cast<size_t>(columns);
            const Packed *const r1 = image + static_cast<size_t>(i1) * static_cast<size_t>(columns);
            const Quad a0 = read(r0[j0]), a1 = read(r0[j1]), b0 = read(r1[j0]), b1 = read(r1[j1]);
            const Quad top = a0 + fx * (a1 - a0), bottom = b0 + fx * (b1 - b0);
            sum += weight * (top + fy * (bottom - top));
        }
    }
    const float slope = look_.slope_range / SLOPE_STEPS, spread = (SPREAD / 255.0f) * (SPREAD / 255.0f);
    const float slope_s = slope * (sum[2] - ZERO_SLOPE), slope_c = slope * (sum[3] - ZERO_SLOPE);
    const float alpha2 = spread * sum[1] * sum[1] - slope_s * slope_s - slope_c * slope_c;
    return {sum[0] * (1.0f / 255.0f), std::clamp(alpha2, 4e-4f, 1.0f), slope_s, slope_c};
}

} // namespace pipefish::sim
