#include "sim/paint.hpp"

namespace pipefish::sim
{

Lattice::Lattice(double cell_along, double cell_around, double radius, uint64_t seed_, uint64_t stream_)
    : around(std::max(3, static_cast<int>(std::lround(2.0 * std::numbers::pi * radius / cell_around)))),
      cell(cell_along), shift(cell_along * uniform_of(hash64(seed_, stream_, 0x5eed))), seed(seed_), stream(stream_)
{
}

float Lattice::at(double s, double turn) const
{
    const double y = (s + shift) / cell, x = turn * around;
    const int64_t row = static_cast<int64_t>(std::floor(y));
    const int k = static_cast<int>(x) % around, k1 = (k + 1) % around;
    const float w = ease(static_cast<float>(x - std::floor(x))), v = ease(static_cast<float>(y - std::floor(y)));
    const float a = value(row, k) + w * (value(row, k1) - value(row, k));
    const float b = value(row + 1, k) + w * (value(row + 1, k1) - value(row + 1, k));
    return a + v * (b - a);
}

void add_noise(const Lattice &lattice, float amplitude, const Canvas &canvas, Layer &out)
{
    if (amplitude == 0.0f || lattice.cell < 2.0 * canvas.texel || 2 * lattice.around > canvas.columns) {
        return;
    }
    const size_t columns = static_cast<size_t>(canvas.columns);
    std::vector<int> cell(columns);
    std::vector<float> weight(columns), knots(static_cast<size_t>(lattice.around) + 1);
    for (size_t j = 0; j < columns; j++) {
        const double x = canvas.turn(static_cast<int>(j)) * lattice.around;
        cell[j] = static_cast<int>(x);
        weight[j] = ease(static_cast<float>(x - std::floor(x)));
    }
    std::vector<float> low(knots.size()), high(knots.size());
    int64_t held = INT64_MIN;
    for (int i = 0; i < canvas.rows; i++) {
        const double y = (canvas.s(i) + lattice.shift) / lattice.cell, floor_y = std::floor(y);
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
        float *const line = out.data() + static_cast<size_t>(i) * columns;
        for (size_t j = 0; j < columns; j++) {
            const float *const knot = knots.data() + cell[j];
            line[j] += knot[0] + weight[j] * (knot[1] - knot[0]);
        }
    }
}

namespace
{

// One straight piece of a stroke, from (s, x) to (s + ds, x + dx); its strength goes from `from` to `to`.
void add_piece(double s, double x, double ds, double dx, double half, float from, float to, const Canvas &canvas,
               Layer &mask)
{
    const double texel = canvas.texel, length2 = std::max(ds * ds + dx * dx, 1e-12);
    const int i0 = std::max(0, static_cast<int>(std::ceil((std::min(s, s + ds) - half - canvas.s0) / texel - 0.5)));
    const int i1 =
        std::min(canvas.rows - 1, static_cast<int>(std::floor((std::max(s, s + ds) + half - canvas.s0) / texel - 0.5)));
    const int j0 = static_cast<int>(std::ceil((std::min(x, x + dx) - half) / texel - 0.5));
    const int j1 = static_cast<int>(std::floor((std::max(x, x + dx) + half) / texel - 0.5));
    const float inverse = static_cast<float>(1.0 / (half * half));
    for (int i = i0; i <= i1; i++) {
        float *const line = mask.data() + static_cast<size_t>(i) * static_cast<size_t>(canvas.columns);
        const double qs = canvas.s(i) - s;
        for (int j = j0; j <= j1; j++) {
            const double qx = (j + 0.5) * texel - x, t = std::clamp((qs * ds + qx * dx) / length2, 0.0, 1.0);
            const double es = qs - t * ds, ex = qx - t * dx;
            const float away = static_cast<float>(es * es + ex * ex) * inverse;
            if (away < 1.0f) {
                const float profile = (1.0f - away) * (1.0f - away);
                float &value = line[((j % canvas.columns) + canvas.columns) % canvas.columns];
                value = std::max(value, profile * (from + static_cast<float>(t) * (to - from)));
            }
        }
    }
}

} // namespace

void add_strokes(const Strokes &strokes, uint64_t seed, uint64_t stream, const Canvas &canvas, Layer &mask)
{
    const Lattice lattice(strokes.cell_along, strokes.cell_around, canvas.radius, seed, stream);
    const double reach = strokes.steps * strokes.step + std::max(strokes.wide, canvas.texel);
    scatter(lattice, canvas, reach, [&](double s, double across, Draws &draws) {
        if (draws() >= strokes.share) {
            return;
        }
        const int steps = std::max(1, static_cast<int>(std::lround(strokes.steps * draws.within(0.3, 1.0))));
        const double width = strokes.narrow + (strokes.wide - strokes.narrow) * std::pow(draws(), 2.0);
        const double half = std::max(width, 1.1 * canvas.texel);
        const float strength = static_cast<float>(draws.within(0.4, 1.0) * width / half);
        double heading = strokes.heading + strokes.aside * draws.within(-1.0, 1.0);
        for (int k = 0; k < steps; k++) {
            heading += strokes.wander * draws.within(-1.0, 1.0);
            const double ds = strokes.step * std::cos(heading), dx = strokes.step * std::sin(heading);
            const auto fade = [&](int at) {
                return strength *
                       std::min(1.0f, 4.0f * static_cast<float>(std::min(at, steps - at)) / static_cast<float>(steps));
            };
            add_piece(s, across, ds, dx, half, steps == 1 ? strength : fade(k), steps == 1 ? strength : fade(k + 1),
                      canvas, mask);
            s += ds;
            across += dx;
        }
    });
}

} // namespace pipefish::sim
