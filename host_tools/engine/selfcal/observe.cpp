#include "selfcal/observe.hpp"

#include "geometry/triangulate.hpp"
#include "linalg/linalg.hpp"
#include "selfcal/residual.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::selfcal
{

namespace
{

constexpr int RINGS = 8, SPOKES = 16;
constexpr double DEGREE = std::numbers::pi / 180.0;

std::vector<Eigen::Vector2d> inlier_pixels(const Adjustment &at)
{
    std::vector<Eigen::Vector2d> out;
    for (const int used : at.used) {
        const Pair &pair = (*at.pairs)[static_cast<size_t>(used)];
        for (const int i : at.match[static_cast<size_t>(used)]) {
            out.push_back(pair.one(static_cast<size_t>(i)));
            out.push_back(pair.two(static_cast<size_t>(i)));
        }
    }
    return out;
}

double quantile(std::vector<double> values, double share)
{
    if (values.empty()) {
        return 0.0;
    }
    const size_t place = std::min(values.size() - 1, static_cast<size_t>(share * static_cast<double>(values.size())));
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(place), values.end());
    return values[place];
}

} // namespace

double hull_area(std::vector<Eigen::Vector2d> points)
{
    std::vector<double> x, y, far;
    for (const Eigen::Vector2d &p : points) {
        x.push_back(p[0]);
        y.push_back(p[1]);
    }
    const Eigen::Vector2d middle(quantile(x, 0.5), quantile(y, 0.5));
    for (const Eigen::Vector2d &p : points) {
        far.push_back((p - middle).norm());
    }
    const double limit = quantile(far, 0.95);
    std::erase_if(points, [&](const Eigen::Vector2d &p) { return (p - middle).norm() > limit; });
    std::sort(points.begin(), points.end(), [](const Eigen::Vector2d &a, const Eigen::Vector2d &b) {
        return a[0] < b[0] || (a[0] == b[0] && a[1] < b[1]);
    });
    const auto chain = [](const auto &from, const auto &to) {
        std::vector<Eigen::Vector2d> side;
        for (auto it = from; it != to; ++it) {
            while (side.size() > 1) {
                const Eigen::Vector2d a = side.back() - side[side.size() - 2], b = *it - side.back();
                if (a[0] * b[1] - a[1] * b[0] > 0.0) {
                    break;
                }
                side.pop_back();
            }
            side.push_back(*it);
        }
        return side;
    };
    std::vector<Eigen::Vector2d> hull = chain(points.begin(), points.end());
    const std::vector<Eigen::Vector2d> back = chain(points.rbegin(), points.rend());
    hull.insert(hull.end(), back.begin(), back.end());
    double twice = 0.0;
    for (size_t i = 0; i < hull.size(); i++) {
        const Eigen::Vector2d &a = hull[i], &b = hull[(i + 1) % hull.size()];
        twice += a[0] * b[1] - a[1] * b[0];
    }
    return 0.5 * std::abs(twice);
}

namespace
{

std::vector<Eigen::Vector2d> disc(const Eigen::Vector2d &centre, double radius)
{
    std::vector<Eigen::Vector2d> out;
    for (int ring = 1; ring <= RINGS; ring++) {
        for (int spoke = 0; spoke < SPOKES; spoke++) {
            const double angle = 2.0 * std::numbers::pi * spoke / SPOKES, r = radius * ring / RINGS;
            out.push_back(centre + r * Eigen::Vector2d(std::cos(angle), std::sin(angle)));
        }
    }
    return out;
}

double alone(const Adjustment &at, const LensMatrix &covariance)
{
    const LensVector along = alpha_direction(at);
    const LensVector priors = at.prior_sigma().cwiseProduct(at.prior_sigma()).cwiseInverse();
    const LensMatrix known = covariance.inverse() - LensMatrix(priors.asDiagonal());
    return 1.0 / std::sqrt(std::max((along.transpose() * known * along).value(), 1e-6));
}

// The pairs as they would be seen if the second camera were turned by `angle` about an axis across its optical axis:
// whether that would do.
bool enough_if_turned(const Adjustment &at, double angle, const Eigen::Vector3d &axis, double limit, double alone_limit)
{
    const pf_camera model = at.camera();
    const Eigen::Matrix3d turn = geometry::rotation_exp(angle * axis);
    std::vector<Pair> seen(at.pairs->size());
    Adjustment next = at;
    for (const int used : at.used) {
        const size_t p = static_cast<size_t>(used);
        const Pair &pair = (*at.pairs)[p];
        next.match[p].clear();
        next.poses[p].r = turn * at.poses[p].r;
        next.poses[p].t = turn * at.poses[p].t;
        for (const int i : at.match[p]) {
            const Eigen::Vector2d a = pair.one(static_cast<size_t>(i)), b = pair.two(static_cast<size_t>(i));
            Eigen::Vector3d one, two;
            if (pf_camera_unproject(&model, a.data(), one.data(), nullptr, nullptr) != PF_OK ||
                pf_camera_unproject(&model, b.data(), two.data(), nullptr, nullptr) != PF_OK) {
                continue;
            }
            const Eigen::Vector3d ahead = turn * two;
            Eigen::Vector2d uv;
            if (pf_camera_project(&model, ahead.data(), uv.data(), nullptr, nullptr) != PF_OK ||
                !pf_camera_in_image(&model, uv.data())) {
                continue;
            }
            next.match[p].push_back(static_cast<int>(seen[p].size()));
            seen[p].uv1.insert(seen[p].uv1.end(), {a[0], a[1]});
            seen[p].uv2.insert(seen[p].uv2.end(), {uv[0], uv[1]});
        }
    }
    next.pairs = &seen;
    try {
        const Eigen::Matrix<double, 1, kLens> row = alpha_row(next);
        const LensMatrix covariance = next.covariance();
        return (row * covariance * row.transpose()).value() < limit * limit && alone(next, covariance) < alone_limit;
    } catch (const std::domain_error &) {
        return false;
    }
}

} // namespace

Eigen::Matrix<double, 1, kLens> alpha_row(const Adjustment &at)
{
    const pf_camera model = at.camera();
    const Slopes<kLens> slopes(model, at.family, at.lens);
    Eigen::Matrix<double, 1, kLens> sum = Eigen::Matrix<double, 1, kLens>::Zero();
    double weight = 0.0;
    for (const Eigen::Vector2d &uv : inlier_pixels(at)) {
        Dual<kLens> theta;
        if (slopes.theta(uv, theta)) {
            const double along = std::sin(theta.v) * std::cos(theta.v);
            sum -= along * theta.d.transpose();
            weight += along * along;
        }
    }
    sum.tail<2>().setZero();
    return weight > 0.0 ? Eigen::Matrix<double, 1, kLens>(sum / weight) : sum;
}

LensVector alpha_direction(const Adjustment &at)
{
    const pf_camera model = at.camera();
    const Slopes<kLens> slopes(model, at.family, at.lens);
    LensMatrix normal = LensMatrix::Zero();
    LensVector right = LensVector::Zero();
    for (const Eigen::Vector2d &uv : inlier_pixels(at)) {
        Dual<kLens> theta;
        if (slopes.theta(uv, theta)) {
            theta.d.tail<2>().setZero();
            normal += theta.d * theta.d.transpose();
            right -= std::sin(theta.v) * std::cos(theta.v) * theta.d;
        }
    }
    // Of the many ways to write it the one that priors like best.
    const LensVector spread = at.prior_sigma();
    normal.diagonal() += 1e-9 * normal.trace() * spread.cwiseProduct(spread).cwiseInverse();
    return normal.ldlt().solve(right);
}

double bearing_sigma(const Adjustment &at, const LensMatrix &covariance, double radius)
{
    using Rows = Eigen::Matrix<double, 3, kLens>;
    const pf_camera model = at.camera();
    const Slopes<kLens> slopes(model, at.family, at.lens);
    std::vector<Rows> rows;
    std::vector<Eigen::Vector3d> rays;
    Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
    Rows right = Rows::Zero();
    for (const Eigen::Vector2d &uv : disc({model.c_u, model.c_v}, radius)) {
        Beam<Dual<kLens>> beam;
        if (!slopes(uv, beam)) {
            continue;
        }
        Rows j;
        for (int i = 0; i < 3; i++) {
            j.row(i) = beam.ray[static_cast<size_t>(i)].d.transpose();
        }
        const Eigen::Vector3d f(beam.ray[0].v, beam.ray[1].v, beam.ray[2].v);
        const Eigen::Matrix3d k = geometry::cross_matrix(f);
        normal += k.transpose() * k;
        right += k.transpose() * j;
        rows.push_back(j);
        rays.push_back(f);
    }
    if (rows.empty()) {
        return 1e3;
    }
    const Rows turn = normal.ldlt().solve(right); // f x w = -w x f
    double worst = 0.0;
    for (size_t i = 0; i < rows.size(); i++) {
        const Rows j = rows[i] - geometry::cross_matrix(rays[i]) * turn;
        const Eigen::Matrix3d spread = j * covariance * j.transpose();
        worst = std::max(worst, linalg::symmetric_eigen<3>(spread).values[2]);
    }
    return std::sqrt(worst);
}

double bearing_difference(const pf_camera &a, const pf_camera &b, const Eigen::Vector2d &centre, double radius)
{
    std::vector<Eigen::Vector3d> one, two;
    Eigen::Matrix3d sum = Eigen::Matrix3d::Zero();
    for (const Eigen::Vector2d &uv : disc(centre, radius)) {
        Eigen::Vector3d f, g;
        const bool seen_a = pf_camera_unproject(&a, uv.data(), f.data(), nullptr, nullptr) == PF_OK;
        const bool seen_b = pf_camera_unproject(&b, uv.data(), g.data(), nullptr, nullptr) == PF_OK;
        if (seen_a && seen_b) {
            one.push_back(f);
            two.push_back(g);
            sum += f * g.transpose();
        } else if (seen_a != seen_b) {
            return std::numbers::pi; // a pixel that one of them does not see
        }
    }
    const Eigen::Matrix3d turn = geometry::nearest_rotation(sum);
    double worst = 0.0;
    for (size_t i = 0; i < one.size(); i++) {
        worst = std::max(worst, one[i].cross(turn * two[i]).norm());
    }
    return std::asin(std::min(worst, 1.0));
}

Observability observe(const Adjustment &at, const LensMatrix &covariance, double limit, double alone_limit)
{
    Observability out;
    const std::vector<Eigen::Vector2d> pixels = inlier_pixels(at);
    if (pixels.empty()) {
        return out;
    }
    const pf_camera model = at.camera();
    std::vector<double> radius;
    for (const Eigen::Vector2d &uv : pixels) {
        radius.push_back((uv - Eigen::Vector2d(model.c_u, model.c_v)).norm());
    }
    out.radius = quantile(radius, 0.95);
    const Eigen::Vector2d rim(model.c_u + out.radius, model.c_v);
    double ray[3];
    if (pf_camera_unproject(&model, rim.data(), ray, nullptr, nullptr) == PF_OK) {
        out.theta = std::atan2(std::hypot(ray[0], ray[1]), ray[2]);
    }
    out.area = hull_area(pixels) / (static_cast<double>(model.width) * model.height);
    const Eigen::Matrix<double, 1, kLens> row = alpha_row(at);
    out.alpha_sigma = std::sqrt((row * covariance * row.transpose()).value());
    out.alpha_alone = alone(at, covariance);
    out.bearing_sigma = bearing_sigma(at, covariance, out.radius);
    out.axial = std::numbers::pi;
    for (const int used : at.used) {
        const Pose &pose = at.poses[static_cast<size_t>(used)];
        out.tilt = std::max(out.tilt, std::acos(std::clamp(pose.r(2, 2), -1.0, 1.0)));
        const double first = std::abs((pose.r.transpose() * pose.t)[2]), second = std::abs(pose.t[2]);
        out.axial = std::min(out.axial, std::acos(std::clamp(std::max(first, second), 0.0, 1.0)));
    }
    if (out.alpha_sigma > limit || out.alpha_alone > alone_limit) {
        for (const double angle : {5.0, 10.0, 15.0, 20.0, 30.0, 45.0}) {
            if (enough_if_turned(at, angle * DEGREE, Eigen::Vector3d::UnitX(), limit, alone_limit) ||
                enough_if_turned(at, angle * DEGREE, Eigen::Vector3d::UnitY(), limit, alone_limit)) {
                out.needed = angle * DEGREE;
                break;
            }
        }
    }
    return out;
}

} // namespace pipefish::selfcal
