#include "tube/cylinder.hpp"

#include "counter_random.hpp"
#include "linalg/linalg.hpp"
#include "optim/least_squares.hpp"
#include "tube/section.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace pipefish::tube
{

using Eigen::Vector2d;
using Eigen::Vector3d;

Eigen::Matrix<double, 3, 2> basis_across(const Vector3d &axis, const Vector3d &near)
{
    Vector3d first = near - near.dot(axis) * axis;
    if (first.norm() < 1e-6 * near.norm() || !(first.norm() > 0.0)) {
        first = axis.unitOrthogonal();
    }
    Eigen::Matrix<double, 3, 2> basis;
    basis.col(0) = first.normalized();
    basis.col(1) = axis.cross(basis.col(0));
    return basis;
}

size_t azimuth_bin(double angle)
{
    const double turn = angle / (2.0 * std::numbers::pi) + 0.5;
    return static_cast<size_t>(std::clamp(static_cast<int>(turn * AZIMUTH_BINS), 0, AZIMUTH_BINS - 1));
}

double widest_gap(std::span<const int> count)
{
    const int bins = static_cast<int>(count.size());
    int total = 0;
    for (const int c : count) {
        total += c;
    }
    const int least = std::max(1, total / (10 * bins));
    int widest = 0, run = 0;
    for (int i = 0; i < 2 * bins; i++) {
        run = count[static_cast<size_t>(i % bins)] < least ? run + 1 : 0;
        widest = std::max(widest, std::min(run, bins));
    }
    return 2.0 * std::numbers::pi * widest / bins;
}

namespace
{

// The optimiser's view of the fit: weights are fixed, so that it is plain least squares; the loop around reweights.
class Problem
{
public:
    Problem(const Cloud &cloud, std::span<const int> index, const Cylinder &start, int parameters)
        : cloud_(cloud), index_(index), parameters_(parameters), now_(start), saved_(start), weight_(index.size(), 1.0),
          noise_(index.size(), 0.0)
    {
    }

    int eliminated() const { return 0; }
    int banded() const { return 0; }
    int border() const { return parameters_; }
    int reach() const { return 0; }
    std::span<const int> couplings(int) const { return {}; }
    void save() { saved_ = now_; }

    void apply(const optim::Step<1, 1> &step)
    {
        now_ = saved_;
        const Eigen::VectorXd &g = step.g;
        now_.centre += now_.basis * g.head<2>();
        const Vector3d turned = (saved_.axis + saved_.basis * g.segment<2>(2)).normalized();
        now_.basis = linalg::turn_between(saved_.axis, turned).toRotationMatrix() * saved_.basis;
        now_.axis = turned;
        now_.rho += g[4];
        if (parameters_ == 7) {
            now_.ec += g[5];
            now_.es += g[6];
        }
    }

    double cost(int e) const
    {
        if (e >= 0 || !(now_.rho > std::hypot(now_.ec, now_.es))) {
            return e >= 0 ? 0.0 : std::numeric_limits<double>::infinity();
        }
        double sum = 0.0;
        for (size_t k = 0; k < index_.size(); k++) {
            if (weight_[k] > 0.0) {
                const double r = offset(k, nullptr).distance;
                sum += weight_[k] * r * r;
            }
        }
        return 0.5 * sum;
    }

    template <class Sink> void linearize(int e, Sink &sink) const
    {
        if (e >= 0) {
            return;
        }
        double shape[3], j[7];
        for (size_t k = 0; k < index_.size(); k++) {
            if (!(weight_[k] > 0.0)) {
                continue;
            }
            double z;
            const Offset f = offset(k, shape, &z);
            const double w = std::sqrt(weight_[k]), r = w * f.distance;
            j[0] = -w * f.n[0];
            j[1] = -w * f.n[1];
            j[2] = -w * f.n[0] * z;
            j[3] = -w * f.n[1] * z;
            for (int i = 4; i < parameters_; i++) {
                j[i] = w * shape[i - 4];
            }
            sink.add(1, &r, optim::RobustLoss{}, nullptr, {}, {}, j);
        }
    }

    Offset offset(size_t k, double *by_shape, double *z = nullptr) const
    {
        const Vector3d x = cloud_.points.col(index_[k]) - now_.centre;
        if (z) {
            *z = x.dot(now_.axis);
        }
        const double shape[3] = {now_.rho, now_.ec, now_.es};
        return section_distance(2, shape, now_.basis.transpose() * x, by_shape);
    }

    // Residuals, then scale and weights from them. Residuals beyond `gate` are gross whatever the scale.
    void reweight(double gate)
    {
        std::vector<double> r, noise;
        residual_.resize(index_.size());
        for (size_t k = 0; k < index_.size(); k++) {
            const Offset f = offset(k, nullptr);
            residual_[k] = f.distance;
            noise_[k] = cloud_.variance(index_[k], now_.basis * f.n);
            if (std::abs(f.distance) < gate) {
                r.push_back(f.distance);
                noise.push_back(noise_[k]);
            }
        }
        tau_ = roughness(r, noise, parameters_);
        const double floor = 1e-10 * now_.rho; // exact data have no scale
        inliers_ = 0;
        for (size_t k = 0; k < index_.size(); k++) {
            const double variance = noise_[k] + tau_ * tau_ + floor * floor;
            const double z2 = residual_[k] * residual_[k] / variance;
            weight_[k] = std::abs(residual_[k]) < gate ? tukey_weight(z2) / variance : 0.0;
            inliers_ += weight_[k] > 0.0 && z2 < 9.0;
        }
    }

    double gap() const
    {
        std::array<int, AZIMUTH_BINS> count{};
        for (size_t k = 0; k < index_.size(); k++) {
            if (weight_[k] > 0.0) {
                const Vector2d y = now_.basis.transpose() * (cloud_.points.col(index_[k]) - now_.centre);
                count[azimuth_bin(std::atan2(y[1], y[0]))]++;
            }
        }
        return widest_gap(count);
    }

    const Cylinder &now() const { return now_; }
    double tau() const { return tau_; }
    int inliers() const { return inliers_; }

    // Moves the centre along the axis to the inliers' mean abscissa, where it is known best.
    void settle()
    {
        double sum = 0.0, count = 0.0;
        for (size_t k = 0; k < index_.size(); k++) {
            sum += weight_[k] * (cloud_.points.col(index_[k]) - now_.centre).dot(now_.axis);
            count += weight_[k];
        }
        if (count > 0.0) {
            now_.centre += sum / count * now_.axis;
        }
        saved_ = now_;
    }

private:
    const Cloud &cloud_;
    std::span<const int> index_;
    int parameters_;
    Cylinder now_, saved_;
    std::vector<double> weight_, noise_, residual_;
    double tau_ = 0.0;
    int inliers_ = 0;
};

// Reweighted least squares until nothing moves.
Cylinder reweighted(const Cloud &cloud, std::span<const int> index, const Cylinder &start, int parameters,
                    const CylinderOptions &options, int rounds)
{
    Problem problem(cloud, index, start, parameters);
    optim::LeastSquares<1, 1> solver;
    Cylinder out = start;
    problem.settle();
    for (int i = 0; i < rounds; i++) {
        const Cylinder before = problem.now();
        problem.reweight(0.5 * before.rho);
        if (problem.inliers() < parameters + 3) {
            out.status = FitStatus::too_few_points;
            return out;
        }
        solver.minimize(problem, {.max_iterations = 3, .gradient_tolerance = 1e-12});
        problem.settle();
        const Cylinder &now = problem.now();
        const double moved = std::abs(now.rho - before.rho) + std::abs(now.ec - before.ec) +
                             std::abs(now.es - before.es) + now.rho * (now.axis - before.axis).norm() +
                             (now.basis.transpose() * (now.centre - before.centre)).norm();
        if (!(moved > 1e-4 * problem.tau() + 1e-13 * now.rho)) {
            break;
        }
    }
    problem.reweight(0.5 * problem.now().rho);
    out = problem.now();
    out.roughness = problem.tau();
    out.inliers = problem.inliers();
    out.gap = problem.gap();
    out.covariance.setZero();
    try {
        out.covariance.topLeftCorner(parameters, parameters) = TUKEY_VARIANCE * solver.covariance(problem).g;
        out.status = FitStatus::ok;
    } catch (const std::domain_error &) {
        out.status = FitStatus::not_determined;
    }
    if (out.inliers < options.min_inliers) {
        out.status = FitStatus::too_few_points;
    } else if (!(out.rho > 0.0) || problem.tau() > 0.15 * out.rho) {
        out.status = FitStatus::no_cylinder;
    }
    return out;
}

struct Circle {
    Vector2d centre;
    double radius;
};

bool circle_through(const Vector2d &a, const Vector2d &b, const Vector2d &c, Circle &out)
{
    const Vector2d u = b - a, v = c - a;
    const double cross = 2.0 * (u[0] * v[1] - u[1] * v[0]), uu = u.squaredNorm(), vv = v.squaredNorm();
    if (!(std::abs(cross) > 1e-3 * std::max(uu, vv))) {
        return false;
    }
    const Vector2d m((v[1] * uu - u[1] * vv) / cross, (u[0] * vv - v[0] * uu) / cross);
    out = {a + m, m.norm()};
    return true;
}

struct Candidate {
    double cost;
    Cylinder cylinder;
};

// The best circle in the projection along `axis`, by three-point samples and truncated squares.
Candidate best_circle(const Eigen::Matrix3Xd &points, const Vector3d &axis, const Cylinder &start, double tolerance,
                      uint64_t stream)
{
    constexpr int SAMPLES = 80;
    Candidate best{std::numeric_limits<double>::infinity(), start};
    Cylinder &cylinder = best.cylinder;
    cylinder.axis = axis;
    cylinder.basis = basis_across(axis, start.basis.col(0));
    const Eigen::Matrix2Xd flat = cylinder.basis.transpose() * (points.colwise() - start.centre);
    const uint64_t n = static_cast<uint64_t>(flat.cols());
    for (int i = 0; i < SAMPLES; i++) {
        const uint64_t bits = hash64(1, stream, static_cast<uint64_t>(i));
        const auto pick = [&](uint64_t k) { return static_cast<Eigen::Index>(mix64(bits + k) % n); };
        Circle circle;
        if (!circle_through(flat.col(pick(0)), flat.col(pick(1)), flat.col(pick(2)), circle) ||
            circle.radius < 0.4 * start.rho || circle.radius > 2.5 * start.rho) {
            continue;
        }
        // The same tolerance for every circle: a larger one must not gain by a wider band.
        const double limit = tolerance * start.rho;
        const double cost = (((flat.colwise() - circle.centre).colwise().norm().array() - circle.radius) / limit)
                                .square()
                                .min(1.0)
                                .sum();
        if (cost < best.cost) {
            best.cost = cost;
            cylinder.centre = start.centre + cylinder.basis * circle.centre;
            cylinder.rho = circle.radius;
        }
    }
    cylinder.ec = cylinder.es = 0.0;
    return best;
}

// Directions around `axis` to `cone`, about 4 degrees apart.
std::vector<Vector3d> directions(const Cylinder &start, double cone)
{
    constexpr double STEP = 4.0 * std::numbers::pi / 180.0;
    std::vector<Vector3d> out{start.axis};
    for (double tilt = STEP; tilt < cone + 0.5 * STEP; tilt += STEP) {
        const int around = static_cast<int>(std::ceil(2.0 * std::numbers::pi * std::sin(tilt) / STEP));
        for (int i = 0; i < around; i++) {
            const double turn = 2.0 * std::numbers::pi * i / around;
            out.push_back(std::cos(tilt) * start.axis +
                          std::sin(tilt) * (start.basis * Vector2d(std::cos(turn), std::sin(turn))));
        }
    }
    return out;
}

double truncated_cost(const Cloud &cloud, std::span<const int> index, const Cylinder &c, double limit)
{
    double sum = 0.0;
    const double shape[3] = {c.rho, c.ec, c.es};
    for (const int i : index) {
        const double d =
            section_distance(2, shape, c.basis.transpose() * (cloud.points.col(i) - c.centre), nullptr).distance /
            limit;
        sum += std::min(1.0, d * d);
    }
    return sum;
}

// The start by search: the best three axes of the cone, each refined as a circle.
Cylinder searched(const Cloud &cloud, std::span<const int> index, const Cylinder &start, const CylinderOptions &options)
{
    constexpr size_t LOOK_AT = 250;
    const size_t step = std::max<size_t>(1, index.size() / LOOK_AT);
    Eigen::Matrix3Xd some(3, static_cast<Eigen::Index>((index.size() + step - 1) / step));
    for (size_t k = 0; k < index.size(); k += step) {
        some.col(static_cast<Eigen::Index>(k / step)) = cloud.points.col(index[k]);
    }
    std::vector<Candidate> found;
    uint64_t stream = 0;
    for (const Vector3d &axis : directions(start, options.cone)) {
        found.push_back(best_circle(some, axis, start, options.tolerance, stream++));
    }
    std::stable_sort(found.begin(), found.end(),
                     [](const Candidate &a, const Candidate &b) { return a.cost < b.cost; });
    found.resize(std::min<size_t>(3, found.size()));
    Candidate best{std::numeric_limits<double>::infinity(), start};
    for (const Candidate &c : found) {
        if (!std::isfinite(c.cost)) {
            continue;
        }
        const Cylinder fitted = reweighted(cloud, index, c.cylinder, 5, options, 12);
        const double cost = fitted.rho > 0.0 ? truncated_cost(cloud, index, fitted, options.tolerance * start.rho)
                                             : std::numeric_limits<double>::infinity();
        if (cost < best.cost) {
            best = {cost, fitted};
        }
    }
    return best.cylinder;
}

} // namespace

Cylinder fit_cylinder(const Cloud &cloud, std::span<const int> index, const Cylinder &given,
                      const CylinderOptions &options)
{
    Cylinder start = given;
    start.axis.normalize();
    start.basis = basis_across(start.axis, given.basis.col(0));
    start.status = FitStatus::too_few_points;
    if (static_cast<int>(index.size()) < std::max(8, options.min_inliers)) {
        return start;
    }
    if (!(start.rho > 0.0)) {
        std::vector<double> away;
        for (const int i : index) {
            away.push_back((start.basis.transpose() * (cloud.points.col(i) - start.centre)).norm());
        }
        std::nth_element(away.begin(), away.begin() + static_cast<std::ptrdiff_t>(away.size() / 2), away.end());
        start.rho = away[away.size() / 2];
    }
    if (!(start.rho > 0.0)) {
        start.status = FitStatus::no_cylinder;
        return start;
    }
    if (options.cone > 0.0) {
        start = searched(cloud, index, start, options);
        if (!(start.rho > 0.0)) {
            return start;
        }
    }
    constexpr int ROUNDS = 60;
    Cylinder circle = reweighted(cloud, index, start, 5, options, options.ellipse ? 8 : ROUNDS);
    if (circle.status == FitStatus::no_cylinder || circle.status == FitStatus::too_few_points) {
        return circle;
    }
    if (circle.gap > options.max_gap_circle) {
        circle.status = FitStatus::one_sided;
        return circle;
    }
    if (!options.ellipse) {
        return circle;
    }
    if (circle.gap <= options.max_gap_ellipse) {
        const Cylinder ellipse = reweighted(cloud, index, circle, 7, options, ROUNDS);
        if (ellipse.gap <= options.max_gap_ellipse) {
            return ellipse;
        }
    }
    circle = reweighted(cloud, index, circle, 5, options, ROUNDS);
    if (circle.status == FitStatus::ok) {
        circle.status = FitStatus::circle_only;
    }
    return circle;
}

} // namespace pipefish::tube
