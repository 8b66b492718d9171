#include "tube/scan.hpp"

#include "tube/nearest.hpp"

#include <Eigen/Cholesky>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

namespace pipefish::tube
{

namespace
{

constexpr int TERMS = 12, SHARED = 7; // of one side; the first SHARED are compared

using Normal = Eigen::Matrix<double, TERMS, TERMS>;
using Right = Eigen::Matrix<double, TERMS, 1>;

// In order: axis x, y, radius, ec, es, slopes of x, y; then curvatures of x, y and slopes of radius, ec, es.
Right terms(double t, double angle)
{
    const double c = std::cos(angle), s = std::sin(angle), c2 = std::cos(2.0 * angle), s2 = std::sin(2.0 * angle);
    Right row;
    row << c, s, 1.0, c2, s2, t * c, t * s, t * t * c, t * t * s, t, t * c2, t * s2;
    return row;
}

struct Side {
    Normal normal = Normal::Zero();
    Right right = Right::Zero();
    int points = 0;
};

} // namespace

std::vector<Step> scan_steps(std::span<const OnSurface> points, double length, double window, double every,
                             double radius)
{
    constexpr int LEAST = 4 * TERMS;
    std::vector<OnSurface> sorted;
    for (const OnSurface &p : points) {
        if (p.piece >= 0 && p.weight > 0.0 && p.sigma > 0.0) {
            sorted.push_back(p);
        }
    }
    std::sort(sorted.begin(), sorted.end(), [](const OnSurface &a, const OnSurface &b) { return a.s < b.s; });
    std::vector<Step> out;
    const auto below = [](const OnSurface &p, double s) { return p.s < s; };
    for (double s = 0.5 * window; s < length - 0.5 * window; s += every) {
        Side side[2];
        const auto from = std::lower_bound(sorted.begin(), sorted.end(), s - window, below);
        const auto to = std::lower_bound(sorted.begin(), sorted.end(), s + window, below);
        for (auto p = from; p != to; ++p) {
            Side &at = side[p->s >= s];
            const Right row = terms((p->s - s) / window, p->angle);
            const double w = p->weight / (p->sigma * p->sigma);
            at.normal.noalias() += w * row * row.transpose();
            at.right.noalias() += w * p->distance * row;
            at.points++;
        }
        if (side[0].points < LEAST || side[1].points < LEAST) {
            continue;
        }
        Right value[2];
        Normal covariance[2];
        bool determined = true;
        for (int k = 0; k < 2; k++) {
            // A weak prior of a radius and a half: one-sided data then widen the covariance instead of failing.
            Normal normal = side[k].normal;
            normal.diagonal().array() += 1.0 / (2.25 * radius * radius);
            const Eigen::LLT<Normal> llt(normal);
            determined = determined && llt.info() == Eigen::Success;
            if (determined) {
                value[k] = llt.solve(side[k].right);
                covariance[k] = llt.solve(Normal::Identity());
            }
        }
        if (!determined) {
            continue;
        }
        Step step;
        step.s = s;
        step.difference = (value[1] - value[0]).head<SHARED>();
        step.covariance = (covariance[0] + covariance[1]).topLeftCorner<SHARED, SHARED>();
        step.chi2 = step.difference.dot(step.covariance.llt().solve(step.difference));
        step.difference.tail<2>() /= window;
        step.covariance.rightCols<2>() /= window;
        step.covariance.bottomRows<2>() /= window;
        step.before = side[0].points;
        step.after = side[1].points;
        out.push_back(step);
    }
    return out;
}

std::vector<double> local_medians(std::span<const OnSurface> points, double radius, int k, int every, double reach,
                                  double most)
{
    std::vector<double> out(points.size(), std::numeric_limits<double>::quiet_NaN());
    std::vector<size_t> of;
    for (size_t i = 0, seen = 0; i < points.size(); i++) {
        if (points[i].piece >= 0 && std::abs(points[i].distance) < most && seen++ % static_cast<size_t>(every) == 0) {
            of.push_back(i);
        }
    }
    // The wall unrolled, with a second copy of either rim where the angle wraps round.
    std::vector<size_t> copy;
    std::vector<Eigen::Vector2d> flat;
    for (const size_t i : of) {
        const double a = points[i].angle, turn = 2.0 * std::numbers::pi;
        for (const double shift : {0.0, turn, -turn}) {
            if (std::abs(a + shift) * radius < std::numbers::pi * radius + reach) {
                copy.push_back(i);
                flat.emplace_back(points[i].s, (a + shift) * radius);
            }
        }
    }
    if (static_cast<int>(of.size()) < k) {
        return out;
    }
    Eigen::Matrix2Xd plane(2, static_cast<Eigen::Index>(flat.size()));
    for (size_t i = 0; i < flat.size(); i++) {
        plane.col(static_cast<Eigen::Index>(i)) = flat[i];
    }
    const Nearest<2> nearest(plane);
    std::vector<double> value(static_cast<size_t>(k));
    for (const size_t i : of) {
        const Eigen::Vector2d at(points[i].s, points[i].angle * radius);
        const std::vector<int> near = nearest.nearest(at, k);
        if (!((plane.col(near.back()) - at).norm() < reach)) {
            continue;
        }
        std::transform(near.begin(), near.end(), value.begin(),
                       [&](int c) { return points[copy[static_cast<size_t>(c)]].distance; });
        std::nth_element(value.begin(), value.begin() + k / 2, value.end());
        out[i] = value[static_cast<size_t>(k / 2)];
    }
    return out;
}

} // namespace pipefish::tube
