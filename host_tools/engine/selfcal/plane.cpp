#include "selfcal/plane.hpp"

#include "linalg/linalg.hpp"
#include "selfcal/residual.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>

namespace pipefish::selfcal
{

namespace
{

using Matrix3 = Eigen::Matrix3d;
using Vector9 = Eigen::Matrix<double, 9, 1>;
constexpr double NEAR_PX = 12.0; // median transfer error: beyond, no lens makes a plane of it

double norm_of(const Vec<double> &v)
{
    return std::sqrt(dot(v, v));
}

// Where the homography takes a ray of the first view, as an offset in pixels of the second: along and around its axis.
template <class T> bool transfer(const std::array<T, 9> &h, const Beam<T> &one, const Beam<T> &two, T *offset)
{
    Vec<T> g;
    for (size_t i = 0; i < 3; i++) {
        g[i] = h[3 * i] * one.ray[0] + h[3 * i + 1] * one.ray[1] + h[3 * i + 2] * one.ray[2];
    }
    const T ahead = dot(g, two.ray);
    if (!(value_of(ahead) > 0.1 * std::sqrt(value_of(dot(g, g))))) {
        return false;
    }
    offset[0] = dot(g, two.away) / (ahead * dot(two.away, two.away));
    offset[1] = dot(g, two.around) / (ahead * dot(two.around, two.around));
    return true;
}

class Problem
{
public:
    static constexpr int kUnknowns = kLens + 9;
    using Number = Dual<kUnknowns>;

    Problem(const Adjustment &at, size_t pair) : family_(at.family), at_(at), pair_(pair), lens_(at.lens)
    {
        limit_ = std::min(1.2 * family_.theta_end(), 0.97 * std::numbers::pi);
        camera_ = at.camera();
        valid_ = true;
        linear();
        save();
        set_weights();
    }

    // Root of the median of the squared weighted offsets, in sigmas.
    double typical() const
    {
        std::vector<double> squares;
        for (const int i : matches()) {
            squares.push_back(squared(i));
        }
        const auto middle = squares.begin() + static_cast<std::ptrdiff_t>(squares.size() / 2);
        std::nth_element(squares.begin(), middle, squares.end());
        return std::sqrt(*middle);
    }

    double truncated(double limit) const
    {
        double sum = 0.0;
        for (const int i : matches()) {
            sum += std::min(squared(i), limit);
        }
        return sum;
    }

    void fit(double scale, bool with_lens)
    {
        with_lens_ = with_lens;
        for (int round = 0; round < 2; round++) {
            set_weights();
            loss_ = {optim::RobustLoss::Kind::cauchy, scale, 0.0};
            if (!std::isfinite(cost(-1))) {
                return;
            }
            optim::LeastSquares<1, 1> solver;
            optim::Options options;
            options.max_iterations = 15;
            options.cost_tolerance = 1e-6;
            solver.minimize(*this, options);
            lens_ = saved_lens_;
            h_ = saved_h_;
            camera_ = make_camera(family_, lens_, at_.width, at_.height, limit_);
        }
        set_weights();
    }

    Matrix3 homography() const { return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(h_.data()); }

    // ---- the problem as the optimiser sees it
    int eliminated() const { return 0; }
    int banded() const { return 0; }
    int border() const { return with_lens_ ? kUnknowns : 9; }
    int reach() const { return 0; }
    std::span<const int> couplings(int) const { return {}; }
    void save()
    {
        saved_lens_ = lens_;
        saved_h_ = h_;
    }
    void apply(const optim::Step<1, 1> &step)
    {
        lens_ = saved_lens_;
        if (with_lens_) {
            lens_ += step.g.head<kLens>();
        }
        h_ = saved_h_ + step.g.tail<9>();
        valid_ = family_.holds(lens_[kShape]) && std::abs(lens_[kLogF]) < 12.0;
        if (valid_) {
            camera_ = make_camera(family_, lens_, at_.width, at_.height, limit_);
        }
    }
    double cost(int) const
    {
        if (!valid_) {
            return std::numeric_limits<double>::infinity();
        }
        double sum = std::pow((h_.squaredNorm() - 1.0), 2);
        const LensVector away = prior();
        sum += with_lens_ ? away.squaredNorm() : 0.0;
        for (const int i : matches()) {
            sum += loss_(squared(i)).rho;
        }
        return 0.5 * sum;
    }
    template <class Sink> void linearize(int, Sink &sink) const
    {
        const Eigen::Index columns = border(), first = with_lens_ ? kLens : 0;
        Eigen::Matrix<double, 2, Eigen::Dynamic, Eigen::RowMajor> j(2, columns);
        const Slopes<kUnknowns> beams(camera_, family_, lens_);
        std::array<Number, 9> h;
        for (size_t k = 0; k < 9; k++) {
            h[k].v = h_[static_cast<Eigen::Index>(k)];
            h[k].d[kLens + static_cast<Eigen::Index>(k)] = 1.0;
        }
        const Pair &pair = (*at_.pairs)[pair_];
        for (size_t m = 0; m < matches().size(); m++) {
            const size_t i = static_cast<size_t>(matches()[m]);
            Beam<Number> one, two;
            Number offset[2];
            if (!beams(pair.one(i), one) || !beams(pair.two(i), two) || !transfer(h, one, two, offset)) {
                continue;
            }
            const Eigen::Matrix2d &w = weight_[i];
            const Eigen::Vector2d r = w * Eigen::Vector2d(offset[0].v, offset[1].v);
            for (Eigen::Index c = 0; c < columns; c++) {
                const Eigen::Index from = c - first + kLens;
                j.col(c) = w * Eigen::Vector2d(offset[0].d[from], offset[1].d[from]);
            }
            sink.add(2, r.data(), loss_, nullptr, {}, {}, j.data());
        }
        Eigen::RowVectorXd row = Eigen::RowVectorXd::Zero(columns);
        row.tail<9>() = 2.0 * h_.transpose();
        double r = (h_.squaredNorm() - 1.0);
        sink.add(1, &r, optim::RobustLoss{}, nullptr, {}, {}, row.data());
        if (with_lens_) {
            const LensVector away = prior(), spread = at_.prior_sigma();
            for (Eigen::Index c = 0; c < kLens; c++) {
                row.setZero();
                row[c] = 1.0 / spread[c];
                sink.add(1, &away[c], optim::RobustLoss{}, nullptr, {}, {}, row.data());
            }
        }
    }

private:
    const std::vector<int> &matches() const { return at_.match[pair_]; }
    LensVector prior() const { return (lens_ - at_.prior_mean()).cwiseQuotient(at_.prior_sigma()); }

    double squared(int i) const
    {
        const Pair &pair = (*at_.pairs)[pair_];
        const size_t k = static_cast<size_t>(i);
        Beam<double> one, two;
        std::array<double, 9> h;
        std::copy(h_.data(), h_.data() + 9, h.begin());
        double offset[2];
        if (!make_beam(camera_, pair.one(k), one) || !make_beam(camera_, pair.two(k), two) ||
            !transfer(h, one, two, offset)) {
            return 1e6;
        }
        return (weight_[k] * Eigen::Vector2d(offset[0], offset[1])).squaredNorm();
    }

    // Null vector of the rows f2 x (H f1) = 0, twice: the second time without what was far off.
    void linear()
    {
        const Pair &pair = (*at_.pairs)[pair_];
        weight_.assign(pair.size(), Eigen::Matrix2d::Identity() / at_.sigma);
        double limit = std::numeric_limits<double>::infinity();
        for (int round = 0; round < 3; round++) {
            Eigen::Matrix<double, 9, 9> normal = Eigen::Matrix<double, 9, 9>::Zero();
            double sign = 0.0;
            std::vector<std::array<Eigen::Vector3d, 2>> rays;
            for (const int i : matches()) {
                Beam<double> one, two;
                if ((round > 0 && squared(i) > limit) || !make_beam(camera_, pair.one(static_cast<size_t>(i)), one) ||
                    !make_beam(camera_, pair.two(static_cast<size_t>(i)), two)) {
                    continue;
                }
                const Eigen::Vector3d f(one.ray[0], one.ray[1], one.ray[2]), g(two.ray[0], two.ray[1], two.ray[2]);
                const Matrix3 across = Matrix3::Identity() - g * g.transpose(), along = f * f.transpose();
                for (Eigen::Index r = 0; r < 3; r++) {
                    for (Eigen::Index c = 0; c < 3; c++) {
                        normal.block<3, 3>(3 * r, 3 * c) += across(r, c) * along;
                    }
                }
                rays.push_back({f, g});
            }
            h_ = linalg::symmetric_eigen<9>(normal).vectors.col(0);
            const Matrix3 m = homography();
            for (const auto &[f, g] : rays) {
                sign += g.dot(m * f) > 0.0 ? 1.0 : -1.0;
            }
            h_ *= sign < 0.0 ? -1.0 : 1.0;
            limit = 6.0 * std::pow(typical(), 2);
        }
    }

    // The noise of an offset: that of the second pixel, and that of the first as the homography magnifies it.
    void set_weights()
    {
        const Pair &pair = (*at_.pairs)[pair_];
        const Matrix3 m = homography();
        for (const int i : matches()) {
            const size_t k = static_cast<size_t>(i);
            Beam<double> one, two;
            if (!make_beam(camera_, pair.one(k), one) || !make_beam(camera_, pair.two(k), two)) {
                continue;
            }
            const auto vector = [](const Vec<double> &v) { return Eigen::Vector3d(v[0], v[1], v[2]); };
            const double ahead = std::max(vector(two.ray).dot(m * vector(one.ray)), 1e-3);
            Eigen::Matrix2d moved;
            moved.col(0) << vector(two.away).dot(m * vector(one.away)), vector(two.around).dot(m * vector(one.away));
            moved.col(1) << vector(two.away).dot(m * vector(one.around)),
                vector(two.around).dot(m * vector(one.around));
            moved.row(0) /= ahead * std::pow(norm_of(two.away), 2);
            moved.row(1) /= ahead * std::pow(norm_of(two.around), 2);
            const Eigen::Matrix2d variance =
                at_.sigma * at_.sigma * (Eigen::Matrix2d::Identity() + moved * moved.transpose());
            weight_[k] = variance.llt().matrixL().solve(Eigen::Matrix2d::Identity());
        }
    }

    LensFamily family_;
    const Adjustment &at_;
    size_t pair_;
    LensVector lens_, saved_lens_;
    Vector9 h_ = Vector9::Zero(), saved_h_ = Vector9::Zero();
    std::vector<Eigen::Matrix2d> weight_;
    optim::RobustLoss loss_;
    pf_camera camera_{};
    double limit_ = 1.0;
    bool with_lens_ = false, valid_ = false;
};

} // namespace

namespace
{

constexpr double MOST_NOISE = 1.3; // of the noise stated

// GRIC in the four coordinates of a pair: an epipolar geometry has manifolds of dimension 3, a plane of 2. The noise is
// that of the plane's fit where it is up to MOST_NOISE of that of the epipolar one: of a plane's matches an epipolar
// geometry with a strange lens keeps those that suit it.
std::optional<Matrix3> cheaper_plane(const Adjustment &lens, size_t pair, const std::vector<double> &epipolar)
{
    Problem problem(lens, pair);
    problem.fit(std::max(1.0, problem.typical()), false);
    if (problem.typical() * lens.sigma > NEAR_PX) {
        return std::nullopt;
    }
    for (const double scale : {8.0, 2.0, 2.0}) {
        problem.fit(scale, true);
    }
    constexpr double MEDIAN = 1.1774; // of the length of two normal numbers
    const double noise = std::pow(std::clamp(problem.typical() / MEDIAN, 1.0, MOST_NOISE), 2);
    const double n = static_cast<double>(epipolar.size());
    double sum = 3.0 * n * std::log(4.0) + 5.0 * std::log(4.0 * n);
    for (const double squared : epipolar) {
        sum += std::min(squared / noise, 2.0);
    }
    if (problem.truncated(4.0 * noise) / noise + 2.0 * n * std::log(4.0) + 8.0 * std::log(4.0 * n) < sum) {
        return problem.homography();
    }
    return std::nullopt;
}

// Whether some lens makes a rotation of it. A homography leaves the lens open along cot theta -> alpha cot theta, which
// makes diag(1, 1, alpha) H diag(1, 1, 1 / alpha) of it: of a rotation one alpha makes all singular values alike.
// Those of a plane differ by the baseline over its distance, of an axial drive for every alpha.
bool is_turn(const Matrix3 &h)
{
    constexpr double ALIKE = 0.02, LEAST_ANGLE = 0.05; // radians
    double least = std::numeric_limits<double>::infinity(), angle = 0.0;
    for (double log_alpha = -1.5; log_alpha < 1.5; log_alpha += 0.005) {
        const Eigen::Vector3d scale(1.0, 1.0, std::exp(log_alpha));
        const Matrix3 m = scale.asDiagonal() * h * scale.cwiseInverse().asDiagonal();
        const Eigen::Vector3d squares = linalg::symmetric_eigen<3>(m.transpose() * m).values;
        const double spread = std::sqrt(squares[2] / std::max(squares[0], 1e-12)) - 1.0;
        if (spread < least) {
            least = spread;
            angle = std::acos(std::clamp((m.trace() / std::cbrt(m.determinant()) - 1.0) / 2.0, -1.0, 1.0));
        }
    }
    return least < ALIKE && angle > LEAST_ANGLE;
}

} // namespace

Flat flatness(const Adjustment &at, size_t pair)
{
    const std::vector<int> &match = at.match[pair];
    if (match.size() < 12) {
        return Flat::no;
    }
    std::vector<double> epipolar;
    double reach = 0.0;
    for (const int i : match) {
        const size_t k = static_cast<size_t>(i);
        epipolar.push_back(std::pow(at.error(pair, k) / at.sigma, 2));
        reach = std::max({reach, ((*at.pairs)[pair].one(k) - at.prior.centre).norm(),
                          ((*at.pairs)[pair].two(k) - at.prior.centre).norm()});
    }
    std::optional<Matrix3> h = cheaper_plane(at, pair, epipolar);
    // From ordinary lenses too: on a plane the lens found may be one from which no way leads to the plane's.
    for (const auto &[rim, q] : {std::pair(0.6, 1.0), std::pair(1.0, 0.25), std::pair(1.6, 0.0), std::pair(1.8, 0.3)}) {
        if (h) {
            break;
        }
        Adjustment other = at;
        other.family = LensFamily(1.1 * rim, at.prior.bend);
        other.lens = at.prior_mean();
        other.lens[kShape] = q;
        other.lens[kLogF] = std::log(reach / nominal_radius(q, rim));
        h = cheaper_plane(other, pair, epipolar);
    }
    return !h ? Flat::no : is_turn(*h) ? Flat::turned : Flat::plane;
}

} // namespace pipefish::selfcal
