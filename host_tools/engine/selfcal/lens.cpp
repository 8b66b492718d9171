#include "selfcal/lens.hpp"

#include "selfcal/residual.hpp"

#include <Eigen/QR>

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::selfcal
{

namespace
{

constexpr Eigen::Index NODES = 32;
constexpr double TAN_LIMIT = 1.3; // sqrt(q) theta: beyond, a polynomial of degree 9 does not follow the tangent
constexpr double NEAREST = 1e-9;  // of the radius over f: the centre itself has no direction

} // namespace

double nominal_radius(double q, double theta)
{
    if (std::abs(q) < 1e-6) {
        return theta * (1.0 + q * theta * theta / 3.0);
    }
    const double s = std::sqrt(q > 0.0 ? q : -2.0 * q);
    return (q > 0.0 ? std::tan(s * theta) : std::sin(s * theta)) / s;
}

double mirror_radius(double q, double theta)
{
    // r = (l + 1) sin theta / (l + cos theta) with l = (2 - 2 q) / (1 + 2 q), without its pole at q = -1/2.
    const double a = 1.0 + 2.0 * q;
    return 3.0 * std::sin(theta) / (2.0 - 2.0 * q + a * std::cos(theta));
}

LensFamily::LensFamily(double theta_end, double bend) : theta_end_(theta_end)
{
    Eigen::MatrixXd powers(NODES, 4);
    node_.resize(NODES);
    for (Eigen::Index i = 0; i < NODES; i++) {
        // Dense at the rim, where a polynomial that was fitted goes astray first.
        node_[i] = std::sin(0.5 * std::numbers::pi * static_cast<double>(i + 1) / static_cast<double>(NODES));
        const double x = node_[i] * node_[i];
        powers.row(i) << x, x * x, x * x * x, x * x * x * x;
    }
    const double e2 = theta_end * theta_end;
    unit_ << 1.0 / e2, 1.0 / (e2 * e2), 1.0 / (e2 * e2 * e2), 1.0 / (e2 * e2 * e2 * e2);
    const Eigen::ColPivHouseholderQR<Eigen::MatrixXd> solver(powers);
    fit_ = solver.solve(Eigen::MatrixXd::Identity(NODES, NODES));
    // What is left of x^2, x^3, x^4 across x (which is q's) and each other, each half of the one before.
    Eigen::MatrixXd across = powers;
    for (Eigen::Index c = 0; c < 4; c++) {
        for (Eigen::Index b = 0; b < c; b++) {
            across.col(c) -= across.col(b).dot(across.col(c)) / across.col(b).squaredNorm() * across.col(b);
        }
        across.col(c) /= across.col(c).cwiseAbs().maxCoeff();
    }
    for (Eigen::Index c = 0; c < 3; c++) {
        bend_.col(c) = std::ldexp(bend, -static_cast<int>(c)) * (fit_ * across.col(c + 1));
    }
}

bool LensFamily::holds(double q) const
{
    const double most = q > 0.0 ? TAN_LIMIT : 0.5 * std::numbers::pi - 0.02;
    const double mirror = 2.0 - 2.0 * q + (1.0 + 2.0 * q) * std::cos(theta_end_);
    return q > -0.6 && q < 2.0 && std::sqrt(q > 0.0 ? q : -2.0 * q) * theta_end_ < most && mirror > 0.3;
}

Eigen::Vector4d LensFamily::nominal(double q, double mix) const
{
    Eigen::VectorXd ratio(NODES);
    for (Eigen::Index i = 0; i < NODES; i++) {
        const double theta = node_[i] * theta_end_;
        ratio[i] = ((1.0 - mix) * nominal_radius(q, theta) + mix * mirror_radius(q, theta)) / theta - 1.0;
    }
    return fit_ * ratio;
}

Eigen::Vector4d LensFamily::coefficients(const LensVector &lens) const
{
    return unit_.cwiseProduct(nominal(lens[kShape], lens[kMix]) + bend_ * lens.segment<3>(kBend));
}

Eigen::Matrix<double, 4, kLens> LensFamily::slope(const LensVector &lens) const
{
    constexpr double h = 1e-5;
    Eigen::Matrix<double, 4, kLens> out = Eigen::Matrix<double, 4, kLens>::Zero();
    const double q = lens[kShape], mix = lens[kMix];
    out.col(kShape) = unit_.cwiseProduct(nominal(q + h, mix) - nominal(q - h, mix)) / (2.0 * h);
    out.col(kMix) = unit_.cwiseProduct(nominal(q, 1.0) - nominal(q, 0.0)); // linear
    out.middleCols<3>(kBend) = unit_.asDiagonal() * bend_;
    return out;
}

pf_camera make_camera(const LensFamily &family, const LensVector &lens, uint32_t width, uint32_t height, double limit)
{
    const Eigen::Vector4d k = family.coefficients(lens);
    pf_camera camera{};
    camera.width = width;
    camera.height = height;
    camera.f_u = camera.f_v = std::exp(lens[kLogF]);
    camera.c_u = lens[kCentre];
    camera.c_v = lens[kCentre + 1];
    camera.k2 = k[0];
    camera.k3 = k[1];
    camera.k4 = k[2];
    camera.k5 = k[3];
    camera.theta_max = 1e-3;
    constexpr int steps = 200;
    for (int i = 1; i <= steps; i++) {
        double slope = 0.0;
        const double theta = limit * i / steps;
        (void)pf_camera_radius(&camera, theta, &slope);
        if (!(slope > 0.02)) {
            break;
        }
        camera.theta_max = theta;
    }
    return camera;
}

template <int N>
Slopes<N>::Slopes(const pf_camera &camera, const LensFamily &family, const LensVector &lens) : camera_(camera)
{
    k_slope_.setZero();
    k_slope_.template leftCols<kLens>() = family.slope(lens);
}

template <int N> bool Slopes<N>::polar(const Eigen::Vector2d &uv, Polar &out) const
{
    double ray[3];
    if (pf_camera_unproject(&camera_, uv.data(), ray, nullptr, nullptr) != PF_OK) {
        return false;
    }
    const double f = camera_.f_u, x = (uv[0] - camera_.c_u) / f, y = (uv[1] - camera_.c_v) / f;
    const double rho = std::max(std::hypot(x, y), NEAREST), cosine = x / rho, sine = y / rho;
    const double across = std::hypot(ray[0], ray[1]), angle = std::atan2(across, ray[2]);
    out.angle = angle;
    out.rho.v = rho;
    out.rho.d.setZero();
    out.rho.d[kLogF] = -rho;
    out.rho.d[kCentre] = -cosine / f;
    out.rho.d[kCentre + 1] = -sine / f;
    double slope = 0.0;
    (void)pf_camera_radius(&camera_, angle, &slope);
    const double t2 = angle * angle;
    const Eigen::Vector4d power(angle * t2, angle * t2 * t2, angle * t2 * t2 * t2, angle * t2 * t2 * t2 * t2);
    out.theta = {angle, (out.rho.d - k_slope_.transpose() * power) / slope};
    Eigen::Matrix<double, N, 1> turn = Eigen::Matrix<double, N, 1>::Zero();
    turn[kCentre] = sine / (rho * f);
    turn[kCentre + 1] = -cosine / (rho * f);
    out.cosine = {cosine, -sine * turn};
    out.sine = {sine, cosine * turn};
    return true;
}

template <int N> bool Slopes<N>::theta(const Eigen::Vector2d &uv, Dual<N> &theta) const
{
    Polar p;
    if (!polar(uv, p)) {
        return false;
    }
    theta = p.theta;
    return true;
}

template <int N> bool Slopes<N>::operator()(const Eigen::Vector2d &uv, Beam<Dual<N>> &beam) const
{
    using D = Dual<N>;
    Polar p;
    if (!polar(uv, p)) {
        return false;
    }
    double slope = 0.0;
    (void)pf_camera_radius(&camera_, p.angle, &slope);
    const double a = p.angle, a2 = a * a;
    const double bend =
        a * (6.0 * camera_.k2 + a2 * (20.0 * camera_.k3 + a2 * (42.0 * camera_.k4 + a2 * 72.0 * camera_.k5)));
    const Eigen::Vector4d power(3.0 * a2, 5.0 * a2 * a2, 7.0 * a2 * a2 * a2, 9.0 * a2 * a2 * a2 * a2);
    const D rise{slope, bend * p.theta.d + k_slope_.transpose() * power};
    D f{camera_.f_u};
    f.d[kLogF] = camera_.f_u;
    const double s = std::sin(a), c = std::cos(a);
    fill_beam(D{s, c * p.theta.d}, D{c, -s * p.theta.d}, p.cosine, p.sine, p.rho, rise, f, beam);
    return true;
}

bool make_beam(const pf_camera &camera, const Eigen::Vector2d &uv, Beam<double> &beam)
{
    double ray[3], slope = 0.0;
    if (pf_camera_unproject(&camera, uv.data(), ray, nullptr, nullptr) != PF_OK) {
        return false;
    }
    const double f = camera.f_u, x = (uv[0] - camera.c_u) / f, y = (uv[1] - camera.c_v) / f;
    const double rho = std::max(std::hypot(x, y), NEAREST), s = std::hypot(ray[0], ray[1]);
    (void)pf_camera_radius(&camera, std::atan2(s, ray[2]), &slope);
    fill_beam(s, ray[2], x / rho, y / rho, rho, slope, f, beam);
    return true;
}

template class Slopes<kLens>;
template class Slopes<kLens + 5>; // and a pose
template class Slopes<kLens + 9>; // and a homography

} // namespace pipefish::selfcal
