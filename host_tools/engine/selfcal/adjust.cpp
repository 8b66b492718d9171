#include "selfcal/adjust.hpp"

#include "selfcal/residual.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

namespace pipefish::selfcal
{

namespace
{

using Both = Dual<kLens + Adjustment::kPose>;

Beam<double> turned(const Eigen::Matrix3d &r, const Beam<double> &beam)
{
    const auto turn = [&r](const Vec<double> &v) {
        const Eigen::Vector3d out = r * Eigen::Vector3d(v[0], v[1], v[2]);
        return Vec<double>{out[0], out[1], out[2]};
    };
    return {turn(beam.ray), turn(beam.away), turn(beam.around)};
}

// With the derivative by a small rotation w on the left: w x v.
Vec<Both> turned(const Eigen::Matrix3d &r, const Vec<Both> &v)
{
    Vec<Both> out;
    for (Eigen::Index i = 0; i < 3; i++) {
        out[static_cast<size_t>(i)] = Both(r(i, 0)) * v[0] + Both(r(i, 1)) * v[1] + Both(r(i, 2)) * v[2];
    }
    const Eigen::Vector3d g(out[0].v, out[1].v, out[2].v);
    const Eigen::Matrix3d by_turn = -geometry::cross_matrix(g);
    for (Eigen::Index i = 0; i < 3; i++) {
        out[static_cast<size_t>(i)].d.segment<3>(kLens) += by_turn.row(i).transpose();
    }
    return out;
}

double error_of(const pf_camera &camera, const Pose &pose, const Eigen::Vector2d &a, const Eigen::Vector2d &b)
{
    Beam<double> one, two;
    if (!make_beam(camera, a, one) || !make_beam(camera, b, two)) {
        return std::numeric_limits<double>::quiet_NaN();
    }
    double error = 0.0;
    return angular_error(turned(pose.r, one), two, {pose.t[0], pose.t[1], pose.t[2]}, error) ? error : 0.0;
}

} // namespace

pf_camera Adjustment::camera_at(const LensVector &at) const
{
    return make_camera(family, at, width, height, std::min(1.2 * family.theta_end(), 0.97 * std::numbers::pi));
}

LensVector Adjustment::prior_mean() const
{
    LensVector mean = LensVector::Zero();
    mean[kShape] = kShapeMean;
    mean[kMix] = kMixMean;
    mean.segment<2>(kCentre) = prior.centre;
    return mean;
}

LensVector Adjustment::prior_sigma() const
{
    LensVector out = LensVector::Ones();
    out[kLogF] = 1e3; // nothing is known
    out[kShape] = kShapeSigma;
    out[kMix] = kMixSigma;
    out.segment<2>(kCentre).setConstant(prior.centre_sigma);
    return out;
}

void Adjustment::set_stage(Stage stage)
{
    free_.clear();
    if (stage >= Stage::radius) {
        free_ = {kLogF, kShape};
    }
    if (stage >= Stage::centre) {
        free_.insert(free_.end(), {kCentre, kCentre + 1});
    }
    if (stage >= Stage::all) {
        free_.insert(free_.end(), {kMix, kBend, kBend + 1, kBend + 2});
    }
    std::sort(free_.begin(), free_.end());
    now_ = camera();
    valid_ = family.holds(lens[kShape]);
}

optim::Summary Adjustment::adjust(Stage stage, int iterations)
{
    set_stage(stage);
    if (!std::isfinite(cost(-1))) {
        return {};
    }
    for (int e = 0; e < eliminated(); e++) {
        if (!std::isfinite(cost(e))) {
            return {};
        }
    }
    optim::LeastSquares<kPose, 1> solver;
    optim::Options options;
    options.max_iterations = iterations;
    options.cost_tolerance = 1e-7;
    const optim::Summary summary = solver.minimize(*this, options);
    lens = saved_lens_;
    poses = saved_poses_;
    now_ = camera();
    for (const int p : used) {
        poses[static_cast<size_t>(p)].r = geometry::nearest_rotation(poses[static_cast<size_t>(p)].r);
    }
    return summary;
}

double Adjustment::error(size_t pair, size_t i) const
{
    const Pair &matches = (*pairs)[pair];
    return error_of(camera(), poses[pair], matches.one(i), matches.two(i));
}

double Adjustment::truncated(double at_sigma) const
{
    const pf_camera model = camera();
    double sum = 0.0;
    for (const int p : used) {
        const Pair &matches = (*pairs)[static_cast<size_t>(p)];
        for (size_t i = 0; i < matches.size(); i++) {
            const double e = error_of(model, poses[static_cast<size_t>(p)], matches.one(i), matches.two(i)) / at_sigma;
            sum += e * e < 9.0 ? e * e : 9.0; // NaN too
        }
    }
    return sum;
}

template <class Sink> void Adjustment::linearize(int e, Sink &sink) const
{
    const Eigen::Index columns = static_cast<Eigen::Index>(free_.size());
    Eigen::RowVectorXd j_lens(columns);
    if (e < 0) {
        const LensVector mean = prior_mean(), spread = prior_sigma();
        for (Eigen::Index c = 0; c < columns; c++) {
            const int unknown = free_[static_cast<size_t>(c)];
            const double r = (lens[unknown] - mean[unknown]) / spread[unknown];
            j_lens.setZero();
            j_lens[c] = 1.0 / spread[unknown];
            sink.add(1, &r, optim::RobustLoss{}, nullptr, {}, {}, j_lens.data());
        }
        return;
    }
    const size_t p = static_cast<size_t>(used[static_cast<size_t>(e)]);
    const Pair &matches = (*pairs)[p];
    const Pose &pose = poses[p];
    const Slopes<kLens + kPose> beams(now_, family, lens);
    const geometry::Matrix32 basis = geometry::tangent_basis(pose.t);
    Vec<Both> t;
    for (Eigen::Index i = 0; i < 3; i++) {
        Both &component = t[static_cast<size_t>(i)];
        component.v = pose.t[i];
        component.d.segment<2>(kLens + 3) = basis.row(i).transpose();
    }
    for (const int i : match[p]) {
        Beam<Both> one, two;
        if (!beams(matches.one(static_cast<size_t>(i)), one) || !beams(matches.two(static_cast<size_t>(i)), two)) {
            continue;
        }
        const Beam<Both> g{turned(pose.r, one.ray), turned(pose.r, one.away), turned(pose.r, one.around)};
        Both error;
        if (!angular_error(g, two, t, error)) {
            continue;
        }
        const double r = error.v / sigma;
        const Eigen::Matrix<double, 1, kPose> j_pose = error.d.segment<kPose>(kLens).transpose() / sigma;
        for (Eigen::Index c = 0; c < columns; c++) {
            j_lens[c] = error.d[free_[static_cast<size_t>(c)]] / sigma;
        }
        sink.add(1, &r, loss, j_pose.data(), {}, {}, columns > 0 ? j_lens.data() : nullptr);
    }
}

Adjustment::Errors Adjustment::errors_after(int place, const Eigen::Matrix<double, kLens + kPose, 1> &step)
{
    struct Rows {
        std::vector<double> values;
        void add(int, const double *r, const optim::RobustLoss &, const double *by_pose, std::span<const int>,
                 std::span<const double *const>, const double *by_lens)
        {
            values.push_back(*r);
            for (int i = 0; i < kLens + kPose; i++) {
                values.push_back(i < kLens ? by_lens[i] : by_pose[i - kLens]);
            }
        }
    } rows;
    set_stage(Stage::all);
    save();
    optim::Step<kPose, 1> moved;
    moved.g = step.head<kLens>();
    moved.e.resize(used.size(), Eigen::Matrix<double, kPose, 1>::Zero());
    moved.e[static_cast<size_t>(place)] = step.tail<kPose>();
    apply(moved);
    linearize(place, rows);
    constexpr Eigen::Index WIDE = 1 + kLens + kPose;
    const Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, WIDE, Eigen::RowMajor>> all(
        rows.values.data(), static_cast<Eigen::Index>(rows.values.size()) / WIDE, WIDE);
    return {all.col(0), all.rightCols<kLens + kPose>()};
}

double Adjustment::cost(int e) const
{
    if (!valid_) {
        return std::numeric_limits<double>::infinity();
    }
    double sum = 0.0;
    if (e < 0) {
        const LensVector mean = prior_mean(), spread = prior_sigma();
        for (const int unknown : free_) {
            sum += std::pow((lens[unknown] - mean[unknown]) / spread[unknown], 2);
        }
        return 0.5 * sum;
    }
    const size_t p = static_cast<size_t>(used[static_cast<size_t>(e)]);
    const Pair &matches = (*pairs)[p];
    for (const int i : match[p]) {
        const double r =
            error_of(now_, poses[p], matches.one(static_cast<size_t>(i)), matches.two(static_cast<size_t>(i))) / sigma;
        sum += loss(r * r).rho;
    }
    return std::isfinite(sum) ? 0.5 * sum : std::numeric_limits<double>::infinity();
}

void Adjustment::apply(const optim::Step<kPose, 1> &step)
{
    lens = saved_lens_;
    for (size_t c = 0; c < free_.size(); c++) {
        lens[free_[c]] += step.g[static_cast<Eigen::Index>(c)];
    }
    for (size_t e = 0; e < used.size(); e++) {
        const size_t p = static_cast<size_t>(used[e]);
        const Pose &from = saved_poses_[p];
        poses[p].r = geometry::rotation_exp(step.e[e].head<3>()) * from.r;
        poses[p].t = (from.t + geometry::tangent_basis(from.t) * step.e[e].tail<2>()).normalized();
    }
    valid_ = family.holds(lens[kShape]) && std::abs(lens[kLogF]) < 12.0;
    if (valid_) {
        now_ = camera();
    }
}

LensMatrix Adjustment::covariance() const
{
    // Each ray is turned onto the plane that halves, in sigmas, its error, and back to its pixel.
    std::vector<Pair> clean(pairs->size());
    const pf_camera model = camera();
    Adjustment at = *this;
    for (const int used_pair : used) {
        const size_t p = static_cast<size_t>(used_pair);
        const Pair &from = (*pairs)[p];
        at.match[p].clear();
        for (const int i : match[p]) {
            Beam<double> one, two;
            const Eigen::Vector2d a = from.one(static_cast<size_t>(i)), b = from.two(static_cast<size_t>(i));
            if (!make_beam(model, a, one) || !make_beam(model, b, two)) {
                continue;
            }
            const Beam<double> g = turned(poses[p].r, one);
            const Vec<double> t{poses[p].t[0], poses[p].t[1], poses[p].t[2]};
            const Vec<double> normal1 = cross(two.ray, t), normal2 = cross(t, g.ray);
            const double e = dot(normal1, g.ray);
            const Eigen::Vector2d n1(dot(g.away, normal1), dot(g.around, normal1));
            const Eigen::Vector2d n2(dot(two.away, normal2), dot(two.around, normal2));
            const double spread = n1.squaredNorm() + n2.squaredNorm();
            if (spread < 1e-300) {
                continue;
            }
            // Beam's vectors are the ray's steps for a pixel away from the centre and around it.
            const auto moved = [&](const Eigen::Vector2d &uv, const Eigen::Vector2d &n) {
                const Eigen::Vector2d out = (uv - Eigen::Vector2d(model.c_u, model.c_v)).normalized();
                const Eigen::Vector2d step = -e / spread * n;
                return Eigen::Vector2d(uv + step[0] * out + step[1] * Eigen::Vector2d(-out[1], out[0]));
            };
            const Eigen::Vector2d a2 = moved(a, n1), b2 = moved(b, n2);
            at.match[p].push_back(static_cast<int>(clean[p].size()));
            clean[p].uv1.insert(clean[p].uv1.end(), {a2[0], a2[1]});
            clean[p].uv2.insert(clean[p].uv2.end(), {b2[0], b2[1]});
        }
    }
    at.pairs = &clean;
    at.loss = {};
    at.set_stage(Stage::all);
    optim::LeastSquares<kPose, 1> solver;
    return solver.covariance(at).g;
}

} // namespace pipefish::selfcal
