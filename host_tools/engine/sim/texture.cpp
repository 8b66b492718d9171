#include "sim/texture.hpp"

#include "sim/parallel.hpp"
#include "sim/random.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

uint64_t cell(int64_t i, int64_t j)
{
    return static_cast<uint64_t>(i) * 0x100000001B3u + static_cast<uint64_t>(j);
}

// i of -1..count into 0..count - 1; a division here would be half of the baking time.
int64_t wrap(int64_t i, int64_t count)
{
    return i < 0 ? i + count : i >= count ? i - count : i;
}

// Value noise in -1..1 with lattice spacing of about `wave` metres; the lattice closes around the pipe.
double value_noise(uint64_t seed, double s, double turn, double circumference, double wave)
{
    const auto around = std::max<int64_t>(3, std::llround(circumference / wave));
    const double x = turn * static_cast<double>(around), y = s / wave;
    const auto i = static_cast<int64_t>(std::floor(x)), j = static_cast<int64_t>(std::floor(y));
    const double fx = x - static_cast<double>(i), fy = y - static_cast<double>(j);
    const double wx = fx * fx * (3 - 2 * fx), wy = fy * fy * (3 - 2 * fy);
    const int64_t i0 = wrap(i, around), i1 = wrap(i + 1, around);
    const double a = uniform(seed, cell(i0, j)), b = uniform(seed, cell(i1, j));
    const double c = uniform(seed, cell(i0, j + 1)), d = uniform(seed, cell(i1, j + 1));
    return 2 * (a + wx * (b - a) + wy * (c - a + wx * (a - b - c + d))) - 1;
}

// Stones or pores: in each cell of `size` metres one disc with probability `share`, its grey level drawn from -1..1.
// Returns the level of the disc that covers the place, 0 between discs; edges are soft over a tenth of the disc.
double discs(uint64_t seed, double s, double turn, double circumference, double size, double share)
{
    const auto around = std::max<int64_t>(3, std::llround(circumference / size));
    const double x = turn * static_cast<double>(around), y = s / size;
    const auto i = static_cast<int64_t>(std::floor(x)), j = static_cast<int64_t>(std::floor(y));
    double level = 0;
    for (int64_t dj = -1; dj <= 1; dj++) {
        for (int64_t di = -1; di <= 1; di++) {
            const uint64_t h = hash64(seed, cell(wrap(i + di, around), j + dj));
            const auto part = [h](int shift) { return static_cast<double>(h >> shift & 0xFFF) / 4096; };
            if (part(0) >= share)
                continue;
            const double cx = static_cast<double>(i + di) + part(12), cy = static_cast<double>(j + dj) + part(24);
            const double radius = 0.2 + 0.3 * part(36);
            const double stretch = 0.7 + 0.6 * part(48); // stones are not round
            const double dx = (x - cx) * stretch, dy = (y - cy) / stretch, d2 = dx * dx + dy * dy;
            if (d2 < radius * radius)
                level = (2 * static_cast<double>(h >> 52 & 0xFFF) / 4096 - 1) *
                        std::min(1.0, 10 * (1 - std::sqrt(d2) / radius));
        }
    }
    return level;
}

double reflectance(const TextureSpec &spec, double s, double turn, double circumference)
{
    const auto seed = [&spec](uint64_t k) { return hash64(spec.seed, k); };
    double v = 0;
    // Stains and erosion: metres to centimetres, falling with the wavelength; then the grain of sand and cement.
    const double waves[] = {0.6, 0.25, 0.1, 0.04, 0.016, 0.006, 0.0025, 0.0011};
    const double heights[] = {0.10, 0.08, 0.07, 0.06, 0.06, 0.07, 0.07, 0.06};
    for (size_t k = 0; k < 8; k++)
        v += heights[k] * value_noise(seed(k), s, turn, circumference, waves[k]);
    v += 0.16 * discs(seed(20), s, turn, circumference, 0.016, 0.5);            // coarse aggregate
    v += 0.14 * discs(seed(21), s, turn, circumference, 0.007, 0.6);            // fine aggregate
    v -= 0.22 * std::abs(discs(seed(22), s, turn, circumference, 0.005, 0.12)); // pores
    v = 0.48 + spec.contrast * v;
    if (spec.joint_spacing > 0) {
        const double from_joint = std::abs(s - spec.joint_spacing * std::round(s / spec.joint_spacing));
        const double ragged = 0.004 + 0.0015 * value_noise(seed(30), s, turn, circumference, 0.02);
        v *= 1 - 0.75 * std::clamp((ragged - from_joint) / 0.001, 0.0, 1.0);
    }
    return std::clamp(v, 0.02, 0.98);
}

} // namespace

Texture::Texture(const TextureSpec &spec, double radius, double s0, double s1, unsigned threads)
    : s0_(s0), texel_(spec.texel)
{
    // Sides are multiples of the coarsest level's step, so every level halves exactly.
    constexpr int kLevels = 9, kStep = 1 << (kLevels - 1);
    const auto round_up = [](double n) { return static_cast<int>(std::ceil(n / kStep)) * kStep; };
    Level base;
    base.width = round_up(2 * M_PI * radius / texel_);
    base.height = round_up((s1 - s0) / texel_);
    base.data.resize(static_cast<size_t>(base.width) * static_cast<size_t>(base.height));
    levels_.push_back(std::move(base));
    bake(spec, radius, threads);
    for (int k = 1; k < kLevels; k++) {
        const Level &from = levels_.back();
        Level to;
        to.width = from.width / 2;
        to.height = from.height / 2;
        to.data.resize(static_cast<size_t>(to.width) * static_cast<size_t>(to.height));
        for (int y = 0; y < to.height; y++) {
            const uint8_t *a = from.data.data() + static_cast<size_t>(2 * y) * static_cast<size_t>(from.width);
            const uint8_t *b = a + from.width;
            uint8_t *o = to.data.data() + static_cast<size_t>(y) * static_cast<size_t>(to.width);
            for (int x = 0; x < to.width; x++)
                o[x] = static_cast<uint8_t>((a[2 * x] + a[2 * x + 1] + b[2 * x] + b[2 * x + 1] + 2) / 4);
        }
        levels_.push_back(std::move(to));
    }
}

void Texture::bake(const TextureSpec &spec, double radius, unsigned threads)
{
    Level &base = levels_.front();
    const double circumference = 2 * M_PI * radius;
    parallel_rows(base.height, threads, [&](int y) {
        uint8_t *row = base.data.data() + static_cast<size_t>(y) * static_cast<size_t>(base.width);
        for (int x = 0; x < base.width; x++) {
            const double v = reflectance(spec, s0_ + (y + 0.5) * texel_, (x + 0.5) / base.width, circumference);
            row[x] = static_cast<uint8_t>(std::lround(255 * v));
        }
    });
}

double Texture::bilinear(size_t level, double s, double phi) const
{
    const Level &l = levels_[level];
    const double turn = phi / (2 * M_PI);
    const double x = (turn - std::floor(turn)) * l.width - 0.5;
    const double y = std::clamp((s - s0_) / (texel_ * static_cast<double>(1u << level)) - 0.5, 0.0, l.height - 1.001);
    const auto i = static_cast<int>(std::floor(x)), j = static_cast<int>(y);
    const double fx = x - i, fy = y - j;
    const int i0 = i < 0 ? i + l.width : i, i1 = i + 1 >= l.width ? i + 1 - l.width : i + 1;
    const uint8_t *a = l.data.data() + static_cast<size_t>(j) * static_cast<size_t>(l.width), *b = a + l.width;
    const double upper = a[i0] + fx * (a[i1] - a[i0]), lower = b[i0] + fx * (b[i1] - b[i0]);
    return (upper + fy * (lower - upper)) / 255;
}

double Texture::sample(double s, double phi, double minor, double major) const
{
    constexpr int kTaps = 16; // beyond, the far wall blurs more than it should, as aerial blur would
    const double width = std::max({minor, major / kTaps, texel_});
    const double level = std::min(std::log2(width / texel_), static_cast<double>(levels_.size()) - 1.001);
    const auto fine = static_cast<size_t>(level);
    const double w = level - static_cast<double>(fine);
    const int taps = std::clamp(static_cast<int>(std::ceil(major / width)), 1, kTaps);
    double sum = 0;
    for (int k = 0; k < taps; k++) {
        const double at = s + major * ((k + 0.5) / taps - 0.5);
        sum += (1 - w) * bilinear(fine, at, phi) + w * bilinear(fine + 1, at, phi);
    }
    return sum / taps;
}

} // namespace pipefish::sim
