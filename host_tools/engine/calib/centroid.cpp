#include "calib/centroid.hpp"

#include <cmath>
#include <numbers>

namespace pipefish::calib
{

namespace
{

constexpr double kStep = 2.0 * std::numbers::pi / kRim;

// Derivative of the trigonometric interpolant through the rim's points, at the points.
Eigen::Matrix<double, kRim, kRim> spectral_derivative()
{
    Eigen::Matrix<double, kRim, kRim> d = Eigen::Matrix<double, kRim, kRim>::Zero();
    for (int i = 0; i < kRim; i++) {
        for (int j = 0; j < kRim; j++) {
            if (i != j) {
                const double sign = (i - j) % 2 == 0 ? 1.0 : -1.0;
                d(i, j) = 0.5 * sign / std::tan(0.5 * kStep * (i - j));
            }
        }
    }
    return d;
}

} // namespace

const std::array<Eigen::Vector2d, kRim> &rim_directions()
{
    static const std::array<Eigen::Vector2d, kRim> directions = [] {
        std::array<Eigen::Vector2d, kRim> made;
        for (size_t i = 0; i < kRim; i++) {
            const double a = kStep * static_cast<double>(i);
            made[i] = {std::cos(a), std::sin(a)};
        }
        return made;
    }();
    return directions;
}

Eigen::Vector2d centroid(const Eigen::Matrix<double, kRim, 2> &rim, std::array<Eigen::Matrix2d, kRim> *d)
{
    using Vector = Eigen::Matrix<double, kRim, 1>;
    static const Eigen::Matrix<double, kRim, kRim> derivative = spectral_derivative();
    const Eigen::RowVector2d origin = rim.colwise().mean(); // near the region: nothing cancels
    const Vector u = rim.col(0).array() - origin.x(), v = rim.col(1).array() - origin.y();
    const Vector du = derivative * u, dv = derivative * v;
    // The step of the rule cancels between the area and its moments.
    const double area = u.dot(dv);
    const Vector uu = u.cwiseProduct(u), vv = v.cwiseProduct(v);
    const double moment_u = 0.5 * uu.dot(dv), moment_v = -0.5 * vv.dot(du);
    const Eigen::Vector2d at(moment_u / area, moment_v / area);
    if (d) {
        const Vector duu = derivative * uu, dvv = derivative * vv; // the derivative's matrix is antisymmetric
        for (int i = 0; i < kRim; i++) {
            Eigen::Matrix2d &m = (*d)[static_cast<size_t>(i)];
            m(0, 0) = (u[i] * dv[i] - at.x() * dv[i]) / area;
            m(0, 1) = (-0.5 * duu[i] + at.x() * du[i]) / area;
            m(1, 0) = (0.5 * dvv[i] - at.y() * dv[i]) / area;
            m(1, 1) = (-v[i] * du[i] + at.y() * du[i]) / area;
        }
    }
    return at + origin.transpose();
}

} // namespace pipefish::calib
