#include "geometry/two_view.hpp"

#include "counter_random.hpp"
#include "geometry/degenerate.hpp"
#include "geometry/minimal.hpp"
#include "geometry/triangulate.hpp"
#include "median.hpp"

#include <Eigen/Cholesky>

#include <algorithm>
#include <cmath>

namespace pipefish::geometry
{

namespace
{

using Vector5 = Eigen::Matrix<double, 5, 1>;
using Matrix5 = Eigen::Matrix<double, 5, 5>;

constexpr uint64_t STREAM_SAMPLE = 1;

// Pairs in single precision, component by component: scoring is what takes the time. e is a product of numbers below 1,
// with an error of 1e-7 against its noise of 1e-4 and more.
class Scorer
{
public:
    Scorer(std::span<const Sight> a, std::span<const Sight> b, std::span<const int> used) : n_(used.size())
    {
        padded_ = (n_ + 3) / 4 * 4;
        values_.assign(18 * padded_, 0.0f);
        for (size_t i = 0; i < n_; i++) {
            const Sight &s1 = a[static_cast<size_t>(used[i])], &s2 = b[static_cast<size_t>(used[i])];
            for (size_t k = 0; k < 3; k++) {
                const Eigen::Index row = static_cast<Eigen::Index>(k);
                at(k)[i] = static_cast<float>(s1.ray[row]);
                at(3 + k)[i] = static_cast<float>(s2.ray[row]);
                at(6 + k)[i] = static_cast<float>(s1.b(row, 0));
                at(9 + k)[i] = static_cast<float>(s1.b(row, 1));
                at(12 + k)[i] = static_cast<float>(s2.b(row, 0));
                at(15 + k)[i] = static_cast<float>(s2.b(row, 1));
            }
        }
        squared_.resize(padded_);
        gain_.resize(padded_);
    }

    // Sum of w (limit - d^2) over pairs with d^2 < limit; w is small near the direction of motion, where every pair
    // fits. `count` gets the number of these pairs.
    double operator()(const Matrix3d &essential, const Vector3d &direction, double limit, int &count)
    {
        const Eigen::Matrix3f e = essential.cast<float>();
        const Eigen::Vector3f t = direction.cast<float>();
        const float top = static_cast<float>(limit);
        constexpr float NEAR = 0.030153690f; // sin^2 of 10 degrees
        const float *x1 = at(0), *y1 = at(1), *z1 = at(2), *x2 = at(3), *y2 = at(4), *z2 = at(5);
        const float *p0 = at(6), *p1 = at(7), *p2 = at(8), *q0 = at(9), *q1 = at(10), *q2 = at(11);
        const float *r0 = at(12), *r1 = at(13), *r2 = at(14), *s0 = at(15), *s1 = at(16), *s2 = at(17);
        float *gain = gain_.data(), *squared = squared_.data();
        for (size_t i = 0; i < padded_; i++) {
            const float a0 = e(0, 0) * x1[i] + e(0, 1) * y1[i] + e(0, 2) * z1[i];
            const float a1 = e(1, 0) * x1[i] + e(1, 1) * y1[i] + e(1, 2) * z1[i];
            const float a2 = e(2, 0) * x1[i] + e(2, 1) * y1[i] + e(2, 2) * z1[i];
            const float b0 = e(0, 0) * x2[i] + e(1, 0) * y2[i] + e(2, 0) * z2[i];
            const float b1 = e(0, 1) * x2[i] + e(1, 1) * y2[i] + e(2, 1) * z2[i];
            const float b2 = e(0, 2) * x2[i] + e(1, 2) * y2[i] + e(2, 2) * z2[i];
            const float error = a0 * x2[i] + a1 * y2[i] + a2 * z2[i];
            const float u = b0 * p0[i] + b1 * p1[i] + b2 * p2[i], v = b0 * q0[i] + b1 * q1[i] + b2 * q2[i];
            const float w = a0 * r0[i] + a1 * r1[i] + a2 * r2[i], x = a0 * s0[i] + a1 * s1[i] + a2 * s2[i];
            const float along = t[0] * x2[i] + t[1] * y2[i] + t[2] * z2[i], across = 1.0f - along * along;
            const float d = error * error / (u * u + v * v + w * w + x * x + 1e-30f);
            squared[i] = d;
            gain[i] = d < top ? (top - d) * across / (across + NEAR) : 0.0f;
        }
        double sum = 0.0;
        count = 0;
        for (size_t i = 0; i < n_; i++) {
            sum += static_cast<double>(gain[i]);
            count += squared[i] < top;
        }
        return sum;
    }

    // The pairs that the last call counted.
    void list(double limit, std::span<const int> used, std::vector<int> &pairs) const
    {
        pairs.clear();
        for (size_t i = 0; i < n_; i++) {
            if (squared_[i] < static_cast<float>(limit)) {
                pairs.push_back(used[i]);
            }
        }
    }

private:
    float *at(size_t k) { return values_.data() + k * padded_; }

    size_t n_, padded_;
    std::vector<float> values_, squared_, gain_;
};

// Residual d = e / sqrt(s) of a pair and its derivative by rotation and by t.
double sampson(const Pose &pose, const Sight &a, const Sight &b, Vector3d *by_rotation, Vector3d *by_t)
{
    const Vector3d g = pose.r * a.ray, p = b.ray.cross(pose.t), q = pose.t.cross(g);
    const Matrix32 b1 = pose.r * a.b;
    const Vector2d n1 = b1.transpose() * p, n2 = b.b.transpose() * q;
    const double e = p.dot(g), s = n1.squaredNorm() + n2.squaredNorm() + 1e-300, root = std::sqrt(s);
    if (by_rotation) {
        const Vector3d m1 = b1 * n1, m2 = b.b * n2;
        const double inverse = 1.0 / root, bend = -e * inverse / s; // of s / 2
        *by_rotation = inverse * g.cross(p) + bend * (m1.cross(p) + g.cross(m2.cross(pose.t)));
        *by_t = inverse * g.cross(b.ray) + bend * (m1.cross(b.ray) + g.cross(m2));
    }
    return e / root;
}

struct Normal {
    Matrix5 h = Matrix5::Zero();
    Vector5 g = Vector5::Zero();
    double cost = 0.0;
};

// kind of loss: Cauchy of `scale`, or (hard) least squares below it.
double robust_cost(double squared, double scale, bool hard)
{
    const double c2 = scale * scale;
    return hard ? std::min(squared, c2) : c2 * std::log1p(squared / c2);
}

class Refiner
{
public:
    Refiner(std::span<const Sight> a, std::span<const Sight> b, std::span<const int> used) : a_(a), b_(b), used_(used)
    {
    }

    Normal linearize(const Pose &pose, double scale, bool hard) const
    {
        Normal normal;
        const Matrix32 basis = tangent_basis(pose.t);
        for (const int i : used_) {
            Vector3d by_rotation, by_t;
            const size_t k = static_cast<size_t>(i);
            const double d = sampson(pose, a_[k], b_[k], &by_rotation, &by_t), squared = d * d;
            normal.cost += robust_cost(squared, scale, hard);
            const double weight =
                hard ? (squared < scale * scale ? 1.0 : 0.0) : 1.0 / (1.0 + squared / (scale * scale));
            if (weight < 1e-4) { // an outlier by 100 scales says nothing
                continue;
            }
            Vector5 row;
            row << by_rotation, basis.transpose() * by_t;
            normal.h.noalias() += weight * row * row.transpose();
            normal.g += weight * d * row;
        }
        return normal;
    }

    double cost(const Pose &pose, double scale, bool hard) const
    {
        double sum = 0.0;
        for (const int i : used_) {
            const double d = sampson(pose, a_[static_cast<size_t>(i)], b_[static_cast<size_t>(i)], nullptr, nullptr);
            sum += robust_cost(d * d, scale, hard);
        }
        return sum;
    }

    // Gauss-Newton, damped where a step makes it worse. Returns the normal matrix where it ends.
    Matrix5 refine(Pose &pose, double scale, bool hard, int steps) const
    {
        Normal normal = linearize(pose, scale, hard);
        double damping = 1e-9;
        for (int step = 0; step < steps; step++) {
            Matrix5 h = normal.h;
            h.diagonal() *= 1.0 + damping;
            const Vector5 delta = -h.ldlt().solve(normal.g);
            if (!delta.allFinite()) {
                break;
            }
            Pose trial;
            trial.r = rotation_exp(delta.head<3>()) * pose.r;
            trial.t = (pose.t + tangent_basis(pose.t) * delta.tail<2>()).normalized();
            const Normal next = linearize(trial, scale, hard);
            if (!(next.cost <= normal.cost)) {
                damping = std::max(damping, 1e-5) * 30.0;
                if (damping > 1e3) {
                    break;
                }
                continue;
            }
            const bool done = normal.cost - next.cost < 1e-7 * normal.cost;
            pose = trial;
            normal = next;
            damping *= 0.1;
            if (done) {
                break;
            }
        }
        return normal.h;
    }

private:
    std::span<const Sight> a_, b_;
    std::span<const int> used_;
};

// The pose of E with the most points along their rays; `positive` gets their share among those with parallax.
Pose choose_pose(const Matrix3d &essential, std::span<const Sight> a, std::span<const Sight> b,
                 std::span<const int> inliers, double *positive)
{
    const Decomposition parts = decompose_essential(essential);
    Pose best;
    double best_score = -1.0;
    for (const Matrix3d &r : parts.r) {
        int forward = 0, backward = 0, counted = 0;
        for (const int i : inliers) {
            const Vector3d g = r * a[static_cast<size_t>(i)].ray;
            const Vector3d &f2 = b[static_cast<size_t>(i)].ray;
            if (g.dot(f2) > 0.99985) { // parallax below 1 degree
                continue;
            }
            const Vector2d depth = midpoint_depths(g, f2, parts.t);
            counted++;
            forward += depth.minCoeff() > 0.0;
            backward += depth.maxCoeff() < 0.0;
        }
        for (const int sign : {1, -1}) {
            const double score = counted ? static_cast<double>(sign > 0 ? forward : backward) / counted : 0.0;
            // All parallax below a degree: the smaller turn is the likelier.
            const double total = score + 1e-6 * r.trace();
            if (total > best_score) {
                best_score = total;
                best = {r, sign * parts.t};
                *positive = counted ? score : 1.0;
            }
        }
    }
    return best;
}

Matrix3d essential_of(const Pose &pose)
{
    return cross_matrix(pose.t) * pose.r;
}

// The unit vector t with E^T t = 0.
Vector3d left_null(const Matrix3d &e)
{
    Vector3d best = e.col(0).cross(e.col(1));
    for (const Vector3d &other : {Vector3d(e.col(1).cross(e.col(2))), Vector3d(e.col(2).cross(e.col(0)))}) {
        if (other.squaredNorm() > best.squaredNorm()) {
            best = other;
        }
    }
    return best.normalized();
}

// Five different numbers below n, from the counter.
std::array<size_t, 5> draw(uint64_t seed, int iteration, size_t n)
{
    std::array<size_t, 5> sample{};
    uint64_t counter = 0;
    for (size_t k = 0; k < 5; k++) {
        do {
            const uint64_t bits = hash64(seed, STREAM_SAMPLE, static_cast<uint64_t>(iteration), counter++);
            sample[k] = static_cast<size_t>(uniform_of(bits) * static_cast<double>(n));
        } while (std::find(sample.begin(), sample.begin() + k, sample[k]) != sample.begin() + k);
    }
    return sample;
}

struct Best {
    Pose pose;
    double score = 0.0, positive = 0.0;
    int count = 0;
};

// LO-RANSAC: samples, and a local optimisation of every new best.
Best search(std::span<const Sight> a, std::span<const Sight> b, std::span<const int> used,
            const TwoViewOptions &options, int *iterations)
{
    Scorer score(a, b, used);
    const Refiner refiner(a, b, used);
    Best best;
    double best_sample = 0.0;
    double needed = options.max_iterations;
    int iteration = 0;
    std::vector<int> inliers;
    for (; iteration < options.max_iterations && (iteration < needed || iteration < options.min_iterations);
         iteration++) {
        const std::array<size_t, 5> sample = draw(options.seed, iteration, used.size());
        std::array<Vector3d, 5> f1, f2;
        for (size_t k = 0; k < 5; k++) {
            f1[k] = a[static_cast<size_t>(used[sample[k]])].ray;
            f2[k] = b[static_cast<size_t>(used[sample[k]])].ray;
        }
        Matrix3d winner;
        // A plane has a second solution, as good but for the points behind: then others get their chance.
        const double least = best.positive < 0.9 ? 0.9 * best_sample : best_sample;
        double won = least;
        for (const Matrix3d &e : five_point(f1, f2)) {
            int count = 0;
            const double value = score(e, left_null(e), options.chi2, count);
            if (value > won) {
                won = value;
                winner = e;
            }
        }
        if (!(won > least)) {
            continue;
        }
        best_sample = std::max(best_sample, won);
        int count = 0;
        score(winner, left_null(winner), options.chi2, count);
        score.list(options.chi2, used, inliers);
        double positive = 0.0;
        Pose pose = choose_pose(winner, a, b, inliers, &positive);
        refiner.refine(pose, 2.0, false, 4);
        const double value = (0.1 + positive) * score(essential_of(pose), pose.t, options.chi2, count);
        if (value > best.score) {
            best = {pose, value, positive, count};
            const double share = static_cast<double>(count) / static_cast<double>(used.size());
            const double miss = 1.0 - std::pow(share, 5);
            needed = miss <= 0.0 ? 0.0 : std::log(1.0 - options.confidence) / std::log(miss);
        }
    }
    *iterations = iteration;
    return best;
}

// A wrong pair that happens to lie on its epipolar curve mostly has a parallax far beyond the others', and pulls with
// it: it turns the direction more than a hundred right pairs hold it. Where there are wrong pairs at all, inliers whose
// lever is 2.5 standard deviations out of the ordinary are dropped. Sideways in a tube, 30 % wrong: the error of the
// direction falls from 1.34 to 1.05 times the bound.
void drop_levers(const Pose &pose, std::span<const Sight> a, std::span<const Sight> b, std::vector<int> &inliers,
                 size_t pairs)
{
    if (inliers.size() < 20 || inliers.size() * 20 > pairs * 19) {
        return;
    }
    std::vector<double> lever, spread;
    for (const int i : inliers) {
        const size_t k = static_cast<size_t>(i);
        Vector3d by_rotation, by_t;
        sampson(pose, a[k], b[k], &by_rotation, &by_t);
        lever.push_back(std::log(std::max(by_t.norm(), 1e-12)));
    }
    std::vector<double> sorted = lever;
    const double middle = median_of(sorted);
    for (const double value : lever) {
        if (value > middle) {
            spread.push_back(value - middle);
        }
    }
    const double limit = middle + 2.5 * 1.4826 * median_of(spread);
    size_t kept = 0;
    for (size_t i = 0; i < inliers.size(); i++) {
        if (lever[i] <= limit) {
            inliers[kept++] = inliers[i];
        }
    }
    inliers.resize(kept);
}

// Spread and noise of the inliers.
void describe(TwoView &result, std::span<const Sight> a, std::span<const Sight> b, std::span<const int> inliers)
{
    std::vector<double> distance, angle;
    for (const int i : inliers) {
        const size_t k = static_cast<size_t>(i);
        distance.push_back(std::sqrt(sampson_squared(result.pose, a[k], b[k])));
        angle.push_back(std::acos(std::clamp((result.pose.r * a[k].ray).dot(b[k].ray), -1.0, 1.0)));
    }
    result.sigma = 1.4826 * median_of(distance);
    result.median_parallax = median_of(angle);
}

void take_inliers(TwoView &result, std::span<const int> inliers)
{
    for (const int i : inliers) {
        result.inlier[static_cast<size_t>(i)] = 1;
    }
    result.inliers = static_cast<int>(inliers.size());
}

} // namespace

double sampson_squared(const Pose &pose, const Sight &a, const Sight &b)
{
    const double d = sampson(pose, a, b, nullptr, nullptr);
    return d * d;
}

double ray_angles_squared(const Matrix3d &essential, const Vector3d &f1, const Vector3d &f2)
{
    const double half = 0.5 * ((essential * f1).squaredNorm() + (essential.transpose() * f2).squaredNorm());
    const double e = f2.dot(essential * f1), root = std::sqrt(std::max(half * half - e * e, 0.0));
    return half + root > 0.0 ? e * e / (half + root) : 0.0;
}

TwoView two_view(std::span<const Sight> a, std::span<const Sight> b, const TwoViewOptions &options)
{
    TwoView result;
    result.inlier.assign(a.size(), 0);
    std::vector<int> used;
    for (size_t i = 0; i < a.size(); i++) {
        if (a[i].valid && b[i].valid) {
            used.push_back(static_cast<int>(i));
        }
    }
    if (used.size() < 8) {
        return result;
    }
    const Best best = search(a, b, used, options, &result.iterations);
    if (best.count < 8) {
        return result;
    }
    // Soft first, then least squares on what lies within three standard deviations: 1.5 % from the bound.
    result.pose = best.pose;
    const Refiner refiner(a, b, used);
    refiner.refine(result.pose, 2.0, false, 10);
    refiner.refine(result.pose, 3.0, true, 10);
    std::vector<int> inliers;
    for (const int i : used) {
        if (sampson_squared(result.pose, a[static_cast<size_t>(i)], b[static_cast<size_t>(i)]) < options.chi2) {
            inliers.push_back(i);
        }
    }
    if (const auto rotation = explaining_rotation(result.pose, a, b, inliers, options.seed)) {
        result.status = TwoViewStatus::no_baseline;
        result.pose = {*rotation, Vector3d::Zero()};
        take_inliers(result, inliers);
        return result;
    }
    double positive = 0.0;
    const Vector3d before = result.pose.t;
    const Pose chosen = choose_pose(essential_of(result.pose), a, b, inliers, &positive);
    if (chosen.t.dot(before) < 0.0 || (chosen.r - result.pose.r).norm() > 1e-3) {
        result.pose = chosen; // of the four poses of one E
    }
    // A pair whose rays meet behind an eye is no inlier.
    std::erase_if(inliers, [&](int i) {
        const Vector3d g = result.pose.r * a[static_cast<size_t>(i)].ray;
        const Vector3d &f2 = b[static_cast<size_t>(i)].ray;
        return g.dot(f2) < 0.99985 && midpoint_depths(g, f2, result.pose.t).minCoeff() <= 0.0;
    });
    drop_levers(result.pose, a, b, inliers, used.size());
    const Matrix5 normal = Refiner(a, b, inliers).refine(result.pose, 3.0, true, 5);
    result.covariance = normal.ldlt().solve(Matrix5::Identity());
    result.direction_basis = tangent_basis(result.pose.t);
    take_inliers(result, inliers);
    if (result.inliers < 8) {
        return result;
    }
    describe(result, a, b, inliers);
    result.status = positive < 0.9 ? TwoViewStatus::behind : TwoViewStatus::ok;
    if (result.status == TwoViewStatus::ok && explained_by_plane(result.pose, a, b, inliers)) {
        result.status = TwoViewStatus::plane;
    }
    return result;
}

} // namespace pipefish::geometry
