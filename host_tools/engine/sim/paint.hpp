// Brushes for the wall's surface: smooth noise, scattered ellipses and wandering strokes, all of them functions of seed
// and place alone. A canvas is a stretch of wall: rows along the pipe, columns around it, closed around.
#pragma once

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <numbers>
#include <vector>

namespace pipefish::sim
{

using Layer = std::vector<float>; // rows x columns of a canvas

struct Canvas {
    double s0, texel;  // arc length of row 0's near edge; size of the square texels; metres
    double radius;     // of the pipe, metres
    int rows, columns; // columns x texel = the circumference

    size_t size() const { return static_cast<size_t>(rows) * static_cast<size_t>(columns); }
    double s(int row) const { return s0 + (row + 0.5) * texel; } // of the texels' centres
    double turn(int column) const { return (column + 0.5) / columns; }
    double around() const { return columns * texel; } // circumference, metres
};

// Smooth value noise within -1..1 on a lattice that closes around the pipe.
struct Lattice {
    int around;   // cells around the pipe
    double cell;  // along it, metres
    double shift; // along it, metres, so that no two scales line up
    uint64_t seed, stream;

    // Cells of cell_along x cell_around metres; around the pipe a whole number of them, at least 3.
    Lattice(double cell_along, double cell_around, double radius, uint64_t seed, uint64_t stream);
    float value(int64_t row, int column) const
    {
        const uint64_t bits = hash64(seed, stream, static_cast<uint64_t>(row), static_cast<uint64_t>(column));
        return static_cast<float>(2.0 * uniform_of(bits) - 1.0);
    }
    float at(double s, double turn) const; // turn: clock angle / 2 pi, 0..1
};

// out += amplitude * noise; nothing where a cell is smaller than two texels.
void add_noise(const Lattice &lattice, float amplitude, const Canvas &canvas, Layer &out);

struct Dab {                   // a soft-edged ellipse
    double s, across;          // centre, metres; across = radius * clock
    double a, b, cos_t, sin_t; // semi-axes, metres; direction of a
};

// Calls blend(index, cover, q) for the texels of an ellipse: cover falls from 1 to 0 across its rim, over one texel or
// 15 % of the smaller axis, so that its centroid is that of the true shape; q is 0 in the centre and 1 on the rim.
// Ellipses smaller than a texel fade instead of growing.
template <typename Blend> void draw(const Dab &e, const Canvas &canvas, const Blend &blend)
{
    const double texel = canvas.texel, soft = std::max(texel, 0.15 * e.b), reach = std::max(e.a, e.b) + soft;
    const int i0 = std::max(0, static_cast<int>(std::floor((e.s - reach - canvas.s0) / texel - 0.5)));
    const int i1 = std::min(canvas.rows - 1, static_cast<int>(std::ceil((e.s + reach - canvas.s0) / texel - 0.5)));
    const int j0 = static_cast<int>(std::floor((e.across - reach) / texel - 0.5));
    const int j1 = std::min(static_cast<int>(std::ceil((e.across + reach) / texel - 0.5)), j0 + canvas.columns - 1);
    const double fade = std::min(1.0, e.a * e.b / (0.25 * texel * texel));
    for (int i = i0; i <= i1; i++) {
        const double ds = canvas.s(i) - e.s;
        const size_t line = static_cast<size_t>(i) * static_cast<size_t>(canvas.columns);
        for (int j = j0; j <= j1; j++) {
            const double dx = (j + 0.5) * texel - e.across;
            const double u = (e.cos_t * ds + e.sin_t * dx) / e.a, v = (e.cos_t * dx - e.sin_t * ds) / e.b;
            const double q = std::sqrt(u * u + v * v), steep = std::sqrt(u * u / (e.a * e.a) + v * v / (e.b * e.b));
            const double outside = q > 1e-9 ? (q - 1.0) * q / steep : -e.b; // metres beyond the rim, to first order
            const double cover = fade * std::clamp(0.5 - outside / soft, 0.0, 1.0);
            if (cover > 0.0) {
                const int column = ((j % canvas.columns) + canvas.columns) % canvas.columns;
                blend(line + static_cast<size_t>(column), static_cast<float>(cover), static_cast<float>(q));
            }
        }
    }
}

// Random numbers of one scattered thing.
class Draws
{
public:
    explicit Draws(uint64_t bits) : bits_(bits) {}
    double operator()() // 0..1
    {
        bits_ = mix64(bits_);
        return uniform_of(bits_);
    }
    double within(double low, double high) { return low + (high - low) * (*this)(); }

private:
    uint64_t bits_;
};

// Calls each(s, across, draws) for the cells of a lattice within `reach` metres of the canvas: a random place in the
// cell, and the numbers to draw the rest from.
template <typename Each> void scatter(const Lattice &lattice, const Canvas &canvas, double reach, const Each &each)
{
    const double arc = canvas.around() / lattice.around, end = canvas.s0 + canvas.rows * canvas.texel;
    const int64_t first = static_cast<int64_t>(std::floor((canvas.s0 - reach + lattice.shift) / lattice.cell));
    const int64_t last = static_cast<int64_t>(std::floor((end + reach + lattice.shift) / lattice.cell));
    for (int64_t row = first; row <= last; row++) {
        for (int k = 0; k < lattice.around; k++) {
            Draws draws(hash64(lattice.seed, lattice.stream, static_cast<uint64_t>(row), static_cast<uint64_t>(k)));
            const double s = (static_cast<double>(row) + draws()) * lattice.cell - lattice.shift;
            const double across = (k + draws()) * arc;
            each(s, across, draws);
        }
    }
}

// Wandering lines: cracks, scratches, wrinkles.
struct Strokes {
    double cell_along, cell_around; // metres: at most one starts in a cell
    double share;                   // of the cells that start one
    int steps;
    double step;           // metres
    double heading, aside; // radians from the pipe's axis, and how far off it a stroke may start
    double wander;         // radians a step, at most
    double narrow, wide;   // half width, metres
};

// mask = max(mask, strength (1 - d^2 / w^2)^2) at the distance d from each line, faded at its ends; lines thinner than
// a texel are drawn one texel wide and fainter. Strength is drawn from 0.4 to 1.
void add_strokes(const Strokes &strokes, uint64_t seed, uint64_t stream, const Canvas &canvas, Layer &mask);

inline float ease(float x)
{
    return x * x * (3.0f - 2.0f * x);
}

// 0 below `low`, 1 above `high`, smooth between.
inline float smooth(float low, float high, float x)
{
    return ease(std::clamp((x - low) / (high - low), 0.0f, 1.0f));
}

} // namespace pipefish::sim
