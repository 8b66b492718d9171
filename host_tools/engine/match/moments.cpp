#include "match/moments.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <vector>

namespace pipefish::match
{

namespace
{

constexpr int kRadius = 7; // of the window, a Gaussian of half of it
constexpr int kBins = 72;

using Histogram = std::array<double, kBins>;

double window(int i, int j)
{
    constexpr double s = kRadius / 2.0;
    return std::exp(-0.5 * (i * i + j * j) / (s * s));
}

// Sobel's gradient of the sample (i, j) from the centre, per sample.
Eigen::Vector2d gradient(const Patch &p, int i, int j)
{
    const auto at = [&](int di, int dj) {
        return static_cast<double>(p.v[j + dj + kRadius + 1][i + di + kRadius + 1]);
    };
    return {(at(1, -1) + 2 * at(1, 0) + at(1, 1) - at(-1, -1) - 2 * at(-1, 0) - at(-1, 1)) / 8,
            (at(-1, 1) + 2 * at(0, 1) + at(1, 1) - at(-1, -1) - 2 * at(0, -1) - at(1, -1)) / 8};
}

Eigen::Matrix2d gradient_moments(const Patch &p, Level level)
{
    Eigen::Matrix2d m = Eigen::Matrix2d::Zero();
    for (int j = -kRadius; j <= kRadius; j++)
        for (int i = -kRadius; i <= kRadius; i++) {
            const Eigen::Vector2d g = gradient(p, i, j);
            m += window(i, j) * g * g.transpose();
        }
    return m / static_cast<double>(level.sigma * level.sigma); // free of gain
}

// Of the intensity above its 2nd percentile, which makes it free of offset, as a density: free of gain.
Eigen::Matrix2d intensity_moments(const Patch &p)
{
    std::vector<float> values;
    for (int j = 1; j <= 2 * kRadius + 1; j++)
        values.insert(values.end(), &p.v[j][1], &p.v[j][2 * kRadius + 2]);
    const auto low = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 50);
    std::nth_element(values.begin(), low, values.end());
    const auto floor = static_cast<double>(*low);
    Eigen::Matrix2d m = Eigen::Matrix2d::Zero();
    double sum = 0;
    for (int j = -kRadius; j <= kRadius; j++)
        for (int i = -kRadius; i <= kRadius; i++) {
            const double f = static_cast<double>(p.v[j + kRadius + 1][i + kRadius + 1]) - floor;
            const double w = window(i, j) * std::max(f, 0.0);
            const Eigen::Vector2d v(i, j);
            m += w * v * v.transpose();
            sum += w;
        }
    return m / sum;
}

// Directions of the gradient in coordinates y = t v: gradients there are t^-1 g (t symmetric).
Histogram directions(const Patch &p, const Eigen::Matrix2d &t)
{
    const Eigen::Matrix2d back = t.inverse();
    Histogram raw = {}, smooth = {};
    for (int j = -kRadius; j <= kRadius; j++)
        for (int i = -kRadius; i <= kRadius; i++) {
            const Eigen::Vector2d g = back * gradient(p, i, j);
            const double at = std::atan2(g.y(), g.x()) / (2 * std::numbers::pi) * kBins + kBins;
            const int low = static_cast<int>(at);
            const double w = window(i, j) * g.norm(), part = at - low;
            raw[static_cast<size_t>(low % kBins)] += w * (1 - part);
            raw[static_cast<size_t>((low + 1) % kBins)] += w * part;
        }
    for (int k = 0; k < kBins; k++)
        for (int d = -4; d <= 4; d++)
            smooth[static_cast<size_t>(k)] +=
                std::exp(-0.5 * d * d / (1.5 * 1.5)) * raw[static_cast<size_t>((k + d + kBins) % kBins)];
    return smooth;
}

// The shift of h that resembles h_2 most, among those within 30 degrees of none.
double turn_by_correlation(const Histogram &h, const Histogram &h_2)
{
    constexpr int most = kBins / 12;
    std::array<double, 2 *most + 3> score = {};
    for (int s = -most - 1; s <= most + 1; s++)
        for (int k = 0; k < kBins; k++)
            score[static_cast<size_t>(s + most + 1)] +=
                h[static_cast<size_t>(k)] * h_2[static_cast<size_t>((k + s + kBins) % kBins)];
    const auto best = std::max_element(score.begin() + 1, score.end() - 1);
    const double shift = static_cast<double>(best - score.begin()) - most - 1 + vertex(best[-1], *best, best[1]);
    return shift * 2 * std::numbers::pi / kBins;
}

// All peaks of at least 0.8 of the highest.
std::vector<double> peaks(const Histogram &h)
{
    const double most = *std::max_element(h.begin(), h.end());
    std::vector<double> out;
    for (int k = 0; k < kBins; k++) {
        const double left = h[static_cast<size_t>((k + kBins - 1) % kBins)], v = h[static_cast<size_t>(k)];
        const double right = h[static_cast<size_t>((k + 1) % kBins)];
        if (v >= 0.8 * most && v > left && v >= right)
            out.push_back((k + vertex(left, v, right)) * 2 * std::numbers::pi / kBins);
    }
    return out;
}

// The difference of two peaks that is nearest to no turn.
double turn_by_peaks(const Histogram &h, const Histogram &h_2)
{
    double best = std::numbers::pi;
    for (const double p : peaks(h))
        for (const double q : peaks(h_2)) {
            const double d = std::remainder(q - p, 2 * std::numbers::pi);
            best = std::abs(d) < std::abs(best) ? d : best;
        }
    return best;
}

double angle_between(const Eigen::Vector2d &p, const Eigen::Vector2d &q)
{
    return std::atan2(p.x() * q.y() - p.y() * q.x(), p.dot(q));
}

} // namespace

Eigen::Matrix2d root(const Eigen::Matrix2d &m)
{
    const double s = std::sqrt(m.determinant());
    return (m + s * Eigen::Matrix2d::Identity()) / std::sqrt(m.trace() + 2 * s);
}

Eigen::Matrix2d map_of_moments(const Eigen::Matrix2d &m, const Eigen::Matrix2d &m_2, const Eigen::Matrix2d &r,
                               bool gradient)
{
    if (gradient)
        return root(m_2).inverse() * r * root(m);
    return root(m_2) * r * root(m).inverse();
}

void adapt_by_moments(const ScaleStack &first, const ScaleStack &second, int x, int y, const Options &options,
                      const EpipolarLine *line, Local &local)
{
    const bool by_gradient = options.adaptation == Adaptation::kGradient;
    const Sampling s = sampling_for(first, second, local.a);
    if (!fits(s, x, y, kRadius, local) || !measure(first, second, x, y, options.radius + 1, options.sigma_min, local))
        return;
    Patch p, q; // of image 2 in the frame of image 1: what is found is a correction
    sample_first(s, x, y, kRadius, p);
    sample_second(s, local, kRadius, q);
    const Eigen::Matrix2d m = by_gradient ? gradient_moments(p, level_of(p, kRadius)) : intensity_moments(p);
    const Eigen::Matrix2d m_2 = by_gradient ? gradient_moments(q, level_of(q, kRadius)) : intensity_moments(q);
    if (!(m.determinant() > 1e-4 * m.trace() * m.trace()) || !(m_2.determinant() > 1e-4 * m_2.trace() * m_2.trace()))
        return; // an edge, or flat
    const Eigen::Matrix2d t = by_gradient ? root(m) : Eigen::Matrix2d(root(m).inverse());
    const Eigen::Matrix2d t_2 = by_gradient ? root(m_2) : Eigen::Matrix2d(root(m_2).inverse());
    double turn = 0;
    if (options.turn == Turn::kEpipolar && line) {
        const Eigen::Vector2d d(-line->n.y(), line->n.x()), d_2(-line->n_2.y(), line->n_2.x());
        const Eigen::Vector2d along = t * d, along_2 = t_2 * (local.a.cast<double>().inverse() * d_2);
        turn = angle_between(along, along.dot(along_2) < 0 ? Eigen::Vector2d(-along_2) : along_2);
    } else {
        const Histogram h = directions(p, t), h_2 = directions(q, t_2);
        turn = options.turn == Turn::kPeak ? turn_by_peaks(h, h_2) : turn_by_correlation(h, h_2);
    }
    Eigen::Matrix2d r;
    r << std::cos(turn), -std::sin(turn), std::sin(turn), std::cos(turn);
    const Eigen::Matrix2d change = map_of_moments(m, m_2, r, by_gradient) - Eigen::Matrix2d::Identity();
    if (!(change.norm() <= 0.4))
        return;
    Local moved = local;
    moved.a = local.a * (Eigen::Matrix2d::Identity() + 0.5 * change).cast<float>();
    if (sane(moved.a) && measure(first, second, x, y, options.radius + 1, options.sigma_min, moved) &&
        moved.zncc >= local.zncc)
        local = moved;
}

} // namespace pipefish::match
