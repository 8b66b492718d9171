#include "sim/surface.hpp"

#include "sim/parallel.hpp"
#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::sim
{

namespace
{

constexpr double PI = std::numbers::pi;
constexpr double JOINT_HALF_WIDTH = 0.004; // metres
constexpr double JOINT_DARKNESS = 0.75;    // share of the albedo lost in it

// Smooth value noise of one scale. Cells along the pipe have the size `cell`; around it a whole number of them fits.
struct Noise {
    double cell;      // metres
    double amplitude; // of the albedo, relative to the mean
};

// Stains, mottling, sand. The finest ones fall away where the texels cannot carry them.
constexpr Noise NOISES[] = {
    {0.410, 0.15}, {0.170, 0.13}, {0.063, 0.11}, {0.024, 0.10}, {0.0087, 0.11}, {0.0034, 0.12}, {0.0015, 0.10},
};

// Scattered soft-edged ellipses: at most one a cell, more of them where the erosion noise is high.
struct Grains {
    double cell, smallest, largest; // metres: cell size, semi-axes
    double share;                   // of cells that hold one
    double dark, bright;            // relative albedo is drawn between the two
};

constexpr Grains GRAINS[] = {
    {0.021, 0.0025, 0.0065, 0.40, -0.35, 0.38},  // coarse aggregate
    {0.0085, 0.0010, 0.0030, 0.55, -0.40, 0.42}, // fine aggregate
    {0.0060, 0.0004, 0.0011, 0.35, -0.55, -0.2}, // pores
    {0.047, 0.0012, 0.0045, 0.35, -0.65, -0.35}, // bug holes
};

struct Lattice {
    int around;   // cells around the pipe
    double cell;  // along it, metres
    double shift; // along it, metres, so that no two scales line up
    uint64_t seed, stream;

    float value(int64_t row, int column) const
    {
        const uint64_t bits = hash64(seed, stream, static_cast<uint64_t>(row), static_cast<uint64_t>(column));
        return static_cast<float>(2.0 * uniform_of(bits) - 1.0);
    }
};

Lattice make_lattice(double cell, double radius, uint64_t seed, uint64_t stream)
{
    const int around = std::max(3, static_cast<int>(std::lround(2.0 * PI * radius / cell)));
    return {around, cell, cell * uniform_of(hash64(seed, stream, 0x5eed)), seed, stream};
}

float ease(float x)
{
    return x * x * (3.0f - 2.0f * x);
}

// Adds amplitude * noise to rows x columns texels; row i has the arc length s0 + i texel, column j the clock angle of
// its centre.
void add_noise(const Lattice &lattice, float amplitude, double s0, double texel, int rows, int columns,
               std::vector<float> &out)
{
    std::vector<int> cell(static_cast<size_t>(columns));
    std::vector<float> weight(static_cast<size_t>(columns)), knots(static_cast<size_t>(lattice.around) + 1);
    for (int j = 0; j < columns; j++) {
        const double x = (j + 0.5) * lattice.around / columns;
        cell[static_cast<size_t>(j)] = static_cast<int>(x);
        weight[static_cast<size_t>(j)] = ease(static_cast<float>(x - std::floor(x)));
    }
    std::vector<float> low(knots.size()), high(knots.size());
    int64_t held = INT64_MIN;
    for (int i = 0; i < rows; i++) {
        const double y = (s0 + (i + 0.5) * texel + lattice.shift) / lattice.cell, floor_y = std::floor(y);
        const int64_t row = static_cast<int64_t>(floor_y);
        if (row != held) {
            for (int k = 0; k < lattice.around; k++) {
                low[static_cast<size_t>(k)] = lattice.value(row, k);
                high[static_cast<size_t>(k)] = lattice.value(row + 1, k);
            }
            held = row;
        }
        const float w = ease(static_cast<float>(y - floor_y));
        for (size_t k = 0; k + 1 < knots.size(); k++) {
            knots[k] = amplitude * (low[k] + w * (high[k] - low[k]));
        }
        knots.back() = knots.front();
        float *const line = out.data() + static_cast<size_t>(i) * static_cast<size_t>(columns);
        for (int j = 0; j < columns; j++) {
            const float *const knot = knots.data() + cell[static_cast<size_t>(j)];
            line[j] += knot[0] + weight[static_cast<size_t>(j)] * (knot[1] - knot[0]);
        }
    }
}

// The same noise at one place: modulates the density of grains.
float noise_at(const Lattice &lattice, double s, double turn)
{
    const double y = (s + lattice.shift) / lattice.cell, x = turn * lattice.around;
    const int64_t row = static_cast<int64_t>(std::floor(y));
    const int k = static_cast<int>(x) % lattice.around, k1 = (k + 1) % lattice.around;
    const float w = ease(static_cast<float>(x - std::floor(x))), v = ease(static_cast<float>(y - std::floor(y)));
    const float a = lattice.value(row, k) + w * (lattice.value(row, k1) - lattice.value(row, k));
    const float b = lattice.value(row + 1, k) + w * (lattice.value(row + 1, k1) - lattice.value(row + 1, k));
    return a + v * (b - a);
}

struct Ellipse {
    double s, across;          // centre, metres; across = radius * clock
    double a, b, cos_t, sin_t; // semi-axes and direction
};

// Blends `albedo` over the ellipse: coverage falls from 1 to 0 over one texel across its rim, so that its centroid is
// that of the true shape. Ellipses smaller than a texel fade instead of growing.
template <typename Blend>
void draw(const Ellipse &e, double s0, double texel, int rows, int columns, std::vector<float> &out, const Blend &blend)
{
    const double soft = std::max(texel, 0.15 * e.b), reach = std::max(e.a, e.b) + soft;
    const int i0 = std::max(0, static_cast<int>(std::floor((e.s - reach - s0) / texel - 0.5)));
    const int i1 = std::min(rows - 1, static_cast<int>(std::ceil((e.s + reach - s0) / texel - 0.5)));
    const int j0 = static_cast<int>(std::floor((e.across - reach) / texel - 0.5));
    const int j1 = static_cast<int>(std::ceil((e.across + reach) / texel - 0.5));
    const double fade = std::min(1.0, e.a * e.b / (0.25 * texel * texel));
    for (int i = i0; i <= i1; i++) {
        const double ds = s0 + (i + 0.5) * texel - e.s;
        float *const line = out.data() + static_cast<size_t>(i) * static_cast<size_t>(columns);
        for (int j = j0; j <= j1; j++) {
            const double dx = (j + 0.5) * texel - e.across;
            const double u = (e.cos_t * ds + e.sin_t * dx) / e.a, v = (e.cos_t * dx - e.sin_t * ds) / e.b;
            const double q = std::sqrt(u * u + v * v), slope = std::hypot(u / e.a, v / e.b) / std::max(q, 1e-9);
            const double outside = q > 1e-9 ? (q - 1.0) / slope : -e.b; // metres beyond the rim, to first order
            const double cover = fade * std::clamp(0.5 - outside / soft, 0.0, 1.0);
            if (cover > 0.0) {
                float &texel_value = line[((j % columns) + columns) % columns];
                texel_value = blend(texel_value, static_cast<float>(cover));
            }
        }
    }
}

void add_grains(const Grains &g, const Lattice &lattice, const Lattice &erosion, double radius, double s0, double texel,
                int rows, int columns, std::vector<float> &out)
{
    const double reach = g.largest + 2.0 * texel, arc = 2.0 * PI * radius / lattice.around;
    const int64_t first = static_cast<int64_t>(std::floor((s0 - reach + lattice.shift) / lattice.cell));
    const int64_t last = static_cast<int64_t>(std::floor((s0 + rows * texel + reach + lattice.shift) / lattice.cell));
    for (int64_t row = first; row <= last; row++) {
        for (int k = 0; k < lattice.around; k++) {
            uint64_t bits = hash64(lattice.seed, lattice.stream, static_cast<uint64_t>(row), static_cast<uint64_t>(k));
            const auto draw_uniform = [&] {
                bits = mix64(bits);
                return uniform_of(bits);
            };
            const double chance = draw_uniform();
            const double s = (static_cast<double>(row) + draw_uniform()) * lattice.cell - lattice.shift;
            const double across = (k + draw_uniform()) * arc;
            const double wear = 1.0 + 0.8 * noise_at(erosion, s, across / (2.0 * PI * radius));
            const double size = draw_uniform(), shape = draw_uniform(), turn = PI * draw_uniform();
            const double tone = draw_uniform();
            if (chance >= g.share * wear) {
                continue;
            }
            const double a = g.smallest + (g.largest - g.smallest) * size * size, b = a * (0.55 + 0.45 * shape);
            const float value = static_cast<float>(g.dark + (g.bright - g.dark) * tone);
            draw({s, across, a, b, std::cos(turn), std::sin(turn)}, s0, texel, rows, columns, out,
                 [=](float under, float cover) { return under + cover * (value - 0.5f * under); });
        }
    }
}

} // namespace

Surface::Surface(const TextureSpec &spec, const std::vector<Marker> &markers, double radius, int around, double reach)
    : spec_(spec), markers_(markers), radius_(radius), texel_(2.0 * PI * radius / around), around_(around), chunks_(1),
      levels_(static_cast<size_t>(AROUND_LEVELS) * ALONG_LEVELS)
{
    if (around < 64 || around > 16384 || (around & (around - 1)) != 0) {
        throw std::invalid_argument("texels around the pipe must be a power of two from 64 to 16384");
    }
    while (chunks_ * CHUNK * texel_ < reach + 2.0 * CHUNK * texel_) {
        chunks_ *= 2;
    }
    for (int a = 0; a < AROUND_LEVELS; a++) {
        for (int l = 0; l < ALONG_LEVELS; l++) {
            const size_t rows = static_cast<size_t>(chunks_ * CHUNK) >> l, columns = static_cast<size_t>(around_) >> a;
            levels_[static_cast<size_t>(a * ALONG_LEVELS + l)].resize(rows * columns);
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

void Surface::paint(int64_t row0, std::vector<float> &albedo) const
{
    const double s0 = static_cast<double>(row0) * texel_;
    if (spec_.contrast > 0.0) {
        const Lattice erosion = make_lattice(0.23, radius_, spec_.seed, STREAM_SURFACE);
        uint64_t stream = STREAM_SURFACE + 1;
        for (const Noise &n : NOISES) {
            const Lattice lattice = make_lattice(n.cell, radius_, spec_.seed, stream++);
            if (n.cell >= 2.0 * texel_) {
                add_noise(lattice, static_cast<float>(n.amplitude), s0, texel_, CHUNK, around_, albedo);
            }
        }
        for (const Grains &g : GRAINS) {
            const Lattice lattice = make_lattice(g.cell, radius_, spec_.seed, stream++);
            add_grains(g, lattice, erosion, radius_, s0, texel_, CHUNK, around_, albedo);
        }
    }
    const float contrast = static_cast<float>(spec_.contrast);
    for (float &x : albedo) {
        x = MEAN * (1.0f + contrast * x);
    }
    if (spec_.joint_spacing > 0.0) {
        std::vector<float> ragged(albedo.size(), 0.0f);
        add_noise(make_lattice(0.02, radius_, spec_.seed, STREAM_SURFACE + 100), 0.0015f, s0, texel_, CHUNK, around_,
                  ragged);
        for (int i = 0; i < CHUNK; i++) {
            const double s = s0 + (i + 0.5) * texel_;
            const double off =
                std::abs(s - spec_.joint_spacing * std::round(s / spec_.joint_spacing)) - JOINT_HALF_WIDTH;
            if (off > 0.01) {
                continue;
            }
            const size_t line = static_cast<size_t>(i) * static_cast<size_t>(around_);
            for (size_t j = line; j < line + static_cast<size_t>(around_); j++) {
                const double cover =
                    std::clamp(0.5 - (off - static_cast<double>(ragged[j])) / (1.5 * texel_), 0.0, 1.0);
                albedo[j] *= static_cast<float>(1.0 - JOINT_DARKNESS * cover);
            }
        }
    }
    for (const Marker &m : markers_) {
        draw({m.s, m.phi * radius_, m.radius, m.radius, 1.0, 0.0}, s0, texel_, CHUNK, around_, albedo,
             [](float under, float cover) { return under + cover * (1.0f - under); });
    }
}

void Surface::generate(int64_t chunk)
{
    std::vector<float> albedo(static_cast<size_t>(CHUNK) * static_cast<size_t>(around_), 0.0f);
    paint(chunk * CHUNK, albedo);
    uint8_t *const out =
        level(0, 0) + static_cast<size_t>((chunk & (chunks_ - 1)) * CHUNK) * static_cast<size_t>(around_);
    for (size_t i = 0; i < albedo.size(); i++) {
        out[i] = static_cast<uint8_t>(std::clamp(albedo[i] * 255.0f + 0.5f, 0.0f, 255.0f));
    }
    reduce(chunk);
}

// Box filter: each level along halves the rows of the one before, each level around the columns.
void Surface::reduce(int64_t chunk)
{
    const size_t slot = static_cast<size_t>(chunk & (chunks_ - 1));
    for (int a = 0; a < AROUND_LEVELS; a++) {
        for (int l = 0; l < ALONG_LEVELS; l++) {
            if (a == 0 && l == 0) {
                continue;
            }
            const size_t columns = static_cast<size_t>(around_) >> a, rows = static_cast<size_t>(CHUNK) >> l;
            uint8_t *const out = level(a, l) + slot * rows * columns;
            if (l > 0) {
                const uint8_t *const in = level(a, l - 1) + slot * 2 * rows * columns;
                for (size_t i = 0; i < rows; i++) {
                    for (size_t j = 0; j < columns; j++) {
                        const int sum = in[2 * i * columns + j] + in[(2 * i + 1) * columns + j];
                        out[i * columns + j] = static_cast<uint8_t>((sum + static_cast<int>((i + j) & 1)) >> 1);
                    }
                }
            } else {
                const uint8_t *const in = level(a - 1, 0) + slot * rows * columns * 2;
                for (size_t i = 0; i < rows * columns; i++) {
                    out[i] = static_cast<uint8_t>((in[2 * i] + in[2 * i + 1] + static_cast<int>(i & 1)) >> 1);
                }
            }
        }
    }
}

float Surface::sample(float row, float column, float width_row, float width_column) const
{
    const float rows = static_cast<float>((last_chunk_ - first_chunk_ + 1) * CHUNK);
    if (!(row >= 0.0f && row < rows)) {
        return MEAN;
    }
    const auto level_of = [](float width, int levels) {
        return std::clamp(std::log2(std::max(width, 1.0f)), 0.0f, static_cast<float>(levels - 1));
    };
    const float lod_s = level_of(width_row, ALONG_LEVELS), lod_c = level_of(width_column, AROUND_LEVELS);
    const int s_level = static_cast<int>(lod_s), c_level = static_cast<int>(lod_c);
    const float s_blend = lod_s - static_cast<float>(s_level), c_blend = lod_c - static_cast<float>(c_level);
    float sum = 0.0f;
    for (int l = s_level; l <= std::min(s_level + 1, ALONG_LEVELS - 1); l++) {
        const float weight_s = l == s_level ? 1.0f - s_blend : s_blend;
        const int ring = (chunks_ * CHUNK) >> l, row_base = static_cast<int>(first_chunk_ & (chunks_ - 1)) * CHUNK >> l;
        // Clamped at the ends of the prepared rows: beyond them the ring holds something else.
        const float y =
            std::clamp(row / static_cast<float>(1 << l) - 0.5f, 0.0f, rows / static_cast<float>(1 << l) - 1.0f);
        const int y0 = static_cast<int>(y), i0 = (row_base + y0) & (ring - 1);
        const int i1 = static_cast<float>(y0) < rows / static_cast<float>(1 << l) - 1.0f ? (i0 + 1) & (ring - 1) : i0;
        const float fy = y - static_cast<float>(y0);
        for (int a = c_level; a <= std::min(c_level + 1, AROUND_LEVELS - 1); a++) {
            const float weight = weight_s * (a == c_level ? 1.0f - c_blend : c_blend);
            const int columns = around_ >> a;
            const float x = column / static_cast<float>(1 << a) - 0.5f;
            const float x_floor = std::floor(x), fx = x - x_floor;
            const int j0 = static_cast<int>(x_floor) & (columns - 1), j1 = (j0 + 1) & (columns - 1);
            const uint8_t *const image = level(a, l);
            const uint8_t *const r0 = image + static_cast<size_t>(i0) * static_cast<size_t>(columns);
            const uint8_t *const r1 = image + static_cast<size_t>(i1) * static_cast<size_t>(columns);
            const float top = static_cast<float>(r0[j0]) + fx * static_cast<float>(r0[j1] - r0[j0]);
            const float bottom = static_cast<float>(r1[j0]) + fx * static_cast<float>(r1[j1] - r1[j0]);
            sum += weight * (top + fy * (bottom - top));
        }
    }
    return sum * (1.0f / 255.0f);
}

} // namespace pipefish::sim
