#include "sim/print.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

bool covers(const Figure &f, double a, double b)
{
    const double u = (a - f.a) / f.half_a, v = (b - f.b) / f.half_b;
    return f.round ? u * u + v * v <= 1.0 : std::abs(u) <= 1.0 && std::abs(v) <= 1.0;
}

} // namespace

Print::Print(std::vector<Figure> figures, double ground) : figures_(std::move(figures)), ground_(ground)
{
    double a1 = -INFINITY, b1 = -INFINITY;
    a0_ = b0_ = INFINITY;
    for (const Figure &f : figures_) {
        a0_ = std::min(a0_, f.a - f.half_a);
        a1 = std::max(a1, f.a + f.half_a);
        b0_ = std::min(b0_, f.b - f.half_b);
        b1 = std::max(b1, f.b + f.half_b);
    }
    if (figures_.empty()) {
        a0_ = b0_ = a1 = b1 = 0.0;
    }
    columns_ = rows_ = std::clamp(static_cast<int>(2.0 * std::sqrt(static_cast<double>(figures_.size()))), 1, 128);
    step_a_ = std::max((a1 - a0_) / columns_, 1e-9);
    step_b_ = std::max((b1 - b0_) / rows_, 1e-9);
    grid_.resize(static_cast<size_t>(rows_) * static_cast<size_t>(columns_));
    for (size_t k = 0; k < figures_.size(); k++) {
        const Figure &f = figures_[k];
        int r[4];
        cells(f.a - f.half_a, f.a + f.half_a, f.b - f.half_b, f.b + f.half_b, r);
        for (int i = r[2]; i <= r[3]; i++) {
            for (int j = r[0]; j <= r[1]; j++) {
                grid_[static_cast<size_t>(i * columns_ + j)].push_back(static_cast<int>(k));
            }
        }
    }
}

// First and last column, first and last row of the cells that a rectangle touches; beyond the grid its margin.
void Print::cells(double a0, double a1, double b0, double b1, int range[4]) const
{
    const auto cell = [](double at, int n) { return static_cast<int>(std::clamp(std::floor(at), 0.0, n - 1.0)); };
    range[0] = cell((a0 - a0_) / step_a_ - 1e-9, columns_);
    range[1] = cell((a1 - a0_) / step_a_ + 1e-9, columns_);
    range[2] = cell((b0 - b0_) / step_b_ - 1e-9, rows_);
    range[3] = cell((b1 - b0_) / step_b_ + 1e-9, rows_);
}

double Print::albedo(double a, double b) const
{
    int r[4];
    cells(a, a, b, b, r);
    const std::vector<int> &list = grid_[static_cast<size_t>(r[2] * columns_ + r[0])];
    for (size_t k = list.size(); k-- > 0;) {
        const Figure &f = figures_[static_cast<size_t>(list[k])];
        if (covers(f, a, b)) {
            return f.albedo;
        }
    }
    return ground_;
}

bool Print::plain(double a0, double a1, double b0, double b1) const
{
    int r[4];
    cells(a0, a1, b0, b1, r);
    for (int i = r[2]; i <= r[3]; i++) {
        for (int j = r[0]; j <= r[1]; j++) {
            for (const int k : grid_[static_cast<size_t>(i * columns_ + j)]) {
                const Figure &f = figures_[static_cast<size_t>(k)];
                const bool clear = a0 > f.a + f.half_a || a1 < f.a - f.half_a || b0 > f.b + f.half_b ||
                                   b1 < f.b - f.half_b; // of the box around it
                const bool within = covers(f, a0, b0) && covers(f, a0, b1) && covers(f, a1, b0) && covers(f, a1, b1);
                if (!clear && !within) {
                    return false;
                }
            }
        }
    }
    return true;
}

Raster::Raster(std::vector<float> texels, int rows, int columns)
{
    levels_.push_back({rows, columns, std::move(texels)});
    while (levels_.back().rows > 2 && levels_.back().columns > 2) {
        const Level &fine = levels_.back();
        Level next{(fine.rows + 1) / 2, (fine.columns + 1) / 2, {}};
        next.texels.reserve(static_cast<size_t>(next.rows) * static_cast<size_t>(next.columns));
        // Texel centres of a level are evenly spread over the sheet, so an odd size is stretched a little.
        for (int i = 0; i < next.rows; i++) {
            for (int j = 0; j < next.columns; j++) {
                float sum = 0.0f;
                for (int k = 0; k < 4; k++) {
                    const double u = (2.0 * j + 0.5 + (k & 1)) / next.columns - 1.0;
                    const double v = (2.0 * i + 0.5 + (k >> 1)) / next.rows - 1.0;
                    sum += static_cast<float>(read(fine, u, v));
                }
                next.texels.push_back(0.25f * sum);
            }
        }
        levels_.push_back(std::move(next));
    }
}

double Raster::read(const Level &level, double u, double v)
{
    const double x = std::clamp(0.5 * (u + 1.0) * level.columns - 0.5, 0.0, level.columns - 1.0);
    const double y = std::clamp(0.5 * (v + 1.0) * level.rows - 0.5, 0.0, level.rows - 1.0);
    const int j = std::min(static_cast<int>(x), level.columns - 2), i = std::min(static_cast<int>(y), level.rows - 2);
    const double fx = x - j, fy = y - i;
    const float *const at =
        level.texels.data() + static_cast<size_t>(i) * static_cast<size_t>(level.columns) + static_cast<size_t>(j);
    const float *const below = at + level.columns;
    return (1.0 - fy) * ((1.0 - fx) * at[0] + fx * at[1]) + fy * ((1.0 - fx) * below[0] + fx * below[1]);
}

double Raster::albedo(double u, double v, double step) const
{
    size_t level = 0;
    while (step >= 2.0 && level + 1 < levels_.size()) {
        step *= 0.5;
        level++;
    }
    return read(levels_[level], u, v);
}

namespace
{

// Weights of a uniform cubic B-spline's four knots at the share x of a cell.
void spline_weights(double x, float w[4])
{
    const double y = 1.0 - x;
    w[0] = static_cast<float>(y * y * y / 6.0);
    w[1] = static_cast<float>((4.0 - 6.0 * x * x + 3.0 * x * x * x) / 6.0);
    w[2] = static_cast<float>((4.0 - 6.0 * y * y + 3.0 * y * y * y) / 6.0);
    w[3] = static_cast<float>(x * x * x / 6.0);
}

// Adds a spline through normal random numbers `cell` texels apart.
void add_octave(const PatternSpec &spec, int octave, double cell, float amplitude, std::vector<float> &out)
{
    const int across = static_cast<int>(spec.columns / cell) + 5;
    const size_t columns = static_cast<size_t>(spec.columns);
    std::vector<std::vector<float>> lines;
    const auto line = [&](int knot) -> const std::vector<float> & { // a row of knots, drawn out along the row
        while (static_cast<int>(lines.size()) <= knot) {
            std::vector<float> knots(static_cast<size_t>(across)), drawn(columns);
            for (int k = 0; k < across; k++) {
                const uint64_t place = (lines.size() << 24) + static_cast<uint64_t>(k);
                knots[static_cast<size_t>(k)] =
                    static_cast<float>(normal(spec.seed, STREAM_PRINT + static_cast<uint64_t>(octave), place));
            }
            for (size_t j = 0; j < columns; j++) {
                const double x = (static_cast<double>(j) + 0.5) / cell;
                const size_t k = static_cast<size_t>(x);
                float w[4];
                spline_weights(x - static_cast<double>(k), w);
                drawn[j] = w[0] * knots[k] + w[1] * knots[k + 1] + w[2] * knots[k + 2] + w[3] * knots[k + 3];
            }
            lines.push_back(std::move(drawn));
        }
        return lines[static_cast<size_t>(knot)];
    };
    for (int i = 0; i < spec.rows; i++) {
        const double y = (i + 0.5) / cell;
        const int k = static_cast<int>(y);
        float w[4];
        spline_weights(y - k, w);
        line(k + 3);
        float *const row = out.data() + static_cast<size_t>(i) * columns;
        for (int n = 0; n < 4; n++) {
            const float *const from = line(k + n).data();
            for (size_t j = 0; j < columns; j++) {
                row[j] += amplitude * w[n] * from[j];
            }
        }
    }
}

// A convex blot: the inner side of `sides` lines, its edge soft over `soft` texels.
void add_blot(const PatternSpec &spec, uint64_t number, double soft, std::vector<float> &out)
{
    const auto random = [&](uint64_t k) { return uniform_of(hash64(spec.seed, STREAM_PRINT + 63, number, k)); };
    const double x = random(0) * spec.columns, y = random(1) * spec.rows;
    const double size = spec.fine * (1.0 + (0.4 * spec.coarse / spec.fine - 1.0) * random(2) * random(2));
    const float level = static_cast<float>(4.0 * spec.contrast * (random(3) - 0.5));
    const int sides = 3 + static_cast<int>(4.0 * random(4));
    double side_x[6], side_y[6];
    for (int k = 0; k < sides; k++) {
        const double angle = 2.0 * std::numbers::pi * (k + 0.8 * random(5 + static_cast<uint64_t>(k))) / sides;
        side_x[k] = std::cos(angle);
        side_y[k] = std::sin(angle);
    }
    const double reach = 3.0 * size;
    const int i0 = std::max(0, static_cast<int>(y - reach)), i1 = std::min(spec.rows - 1, static_cast<int>(y + reach));
    const int j0 = std::max(0, static_cast<int>(x - reach)),
              j1 = std::min(spec.columns - 1, static_cast<int>(x + reach));
    for (int i = i0; i <= i1; i++) {
        for (int j = j0; j <= j1; j++) {
            double outside = -size;
            for (int k = 0; k < sides; k++) {
                outside = std::max(outside, (j + 0.5 - x) * side_x[k] + (i + 0.5 - y) * side_y[k] - size);
            }
            outside = std::max(outside, std::hypot(j + 0.5 - x, i + 0.5 - y) - 0.9 * reach); // of open ones
            const double cover = std::clamp(0.5 - outside / soft, 0.0, 1.0);
            if (cover > 0.0) {
                const float weight = static_cast<float>(cover * cover * (3.0 - 2.0 * cover));
                float &texel = out[static_cast<size_t>(i) * static_cast<size_t>(spec.columns) + static_cast<size_t>(j)];
                texel += weight * (level - 0.7f * texel);
            }
        }
    }
}

} // namespace

std::vector<float> draw_pattern(const PatternSpec &spec)
{
    const size_t n = static_cast<size_t>(spec.rows) * static_cast<size_t>(spec.columns);
    std::vector<float> out(n, 0.0f);
    const double middle = spec.fine * (1.0 + 0.25 * (0.4 * spec.coarse / spec.fine - 1.0));
    const uint64_t blots = static_cast<uint64_t>(spec.blots * static_cast<double>(n) / (4.0 * middle * middle));
    for (uint64_t k = 0; k < blots; k++) {
        add_blot(spec, k, 0.5 * spec.fine, out);
    }
    double squares = 0.0, amplitude = 1.0;
    std::vector<std::pair<double, double>> octaves;
    for (double wave = spec.coarse; wave >= spec.fine; wave *= 0.5, amplitude *= spec.fall) {
        octaves.emplace_back(0.5 * wave, amplitude); // a wave needs two knots
        squares += 0.23 * amplitude * amplitude;     // a spline's variance, mean over the cell: 0.479^2
    }
    for (size_t k = 0; k < octaves.size(); k++) {
        add_octave(spec, static_cast<int>(k), octaves[k].first,
                   static_cast<float>(octaves[k].second * spec.contrast / std::sqrt(squares)), out);
    }
    for (float &texel : out) {
        texel = 0.5f + 0.45f * std::tanh(texel / 0.45f);
    }
    return out;
}

} // namespace pipefish::sim
