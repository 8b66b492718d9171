#include "tube/surface.hpp"

#include "tube/cylinder.hpp"
#include "tube/nearest.hpp"
#include "tube/surface_problem.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::tube
{

using Eigen::Vector2d;
using Eigen::Vector3d;

namespace
{

constexpr int ARC = 16;                 // steps of the table of chainages, a knot interval
constexpr int BINS = 60;                // of azimuth
constexpr double FAR = 3.0;             // radii: points beyond say nothing of this pipe
constexpr double GATE = 0.5;            // radii: distances beyond are gross whatever the scale
constexpr int ENOUGH_A_DIAMETER = 1500; // points: 2.6 % of their noise is left in a radius; more only cost time
constexpr double ELLIPSE_GAP = 150.0 * std::numbers::pi / 180.0;

double median(std::vector<double> v)
{
    const auto middle = v.begin() + static_cast<std::ptrdiff_t>(v.size() / 2);
    std::nth_element(v.begin(), middle, v.end());
    return *middle;
}

// A polyline by arc length, its ends going on straight.
class Polyline
{
public:
    explicit Polyline(const Eigen::Matrix3Xd &nodes) : nodes_(nodes), s_{0.0}
    {
        for (Eigen::Index i = 1; i < nodes.cols(); i++) {
            s_.push_back(s_.back() + (nodes.col(i) - nodes.col(i - 1)).norm());
        }
    }
    double length() const { return s_.back(); }
    size_t segment(double s) const
    {
        const auto after = std::upper_bound(s_.begin() + 1, s_.end() - 1, s);
        return static_cast<size_t>(after - s_.begin()) - 1;
    }
    double fraction(size_t i, double s) const { return (s - s_[i]) / (s_[i + 1] - s_[i]); }
    Vector3d at(double s) const
    {
        const size_t i = segment(s);
        const Vector3d a = nodes_.col(static_cast<Eigen::Index>(i)), b = nodes_.col(static_cast<Eigen::Index>(i + 1));
        return a + fraction(i, s) * (b - a);
    }

private:
    Eigen::Matrix3Xd nodes_;
    std::vector<double> s_;
};

} // namespace

Surface::Surface(const Cloud &cloud, const Reference &reference, const SurfaceOptions &options) : cloud_(cloud)
{
    if (reference.centre.cols() < 2 || !(Polyline(reference.centre).length() > 0.0)) {
        throw std::invalid_argument("tube: the reference has no length");
    }
    diameter_ = 2.0 * median(reference.rho);
    lay_out(reference, options.knot);
    assign(reference);
    const double rho = 0.5 * diameter_;
    const auto stiff = [&](double share) { return 1.0 / (share * share * rho * rho); };
    stiffness_ = options.smooth_only ? std::array{stiff(0.05), stiff(0.01), stiff(0.005), stiff(0.005)}
                                     : std::array{stiff(0.03), stiff(0.01), stiff(0.01), stiff(0.005)};
    converged_ = solve(4, false);
    find_gaps();
    measure_correlation();
    converged_ = solve(options.smooth_only ? 3 : options.rounds, !options.smooth_only);
    if (!options.smooth_only) {
        // Twice: what the first harmonics leave may want more.
        for (int pass = 0; pass < 2; pass++) {
            const int order = options.order == 0 ? choose_order() : options.order;
            find_gaps();
            if (order > order_) {
                widen(order);
            } else if (pass > 0) {
                break;
            }
            measure_correlation();
            converged_ = solve(options.rounds / 2, true);
        }
    }
    tabulate();
    reweigh(true);
    describe();
}

void Surface::lay_out(const Reference &reference, double knot)
{
    const Polyline line(reference.centre);
    std::vector<double> ends{0.0};
    ends.insert(ends.end(), reference.breaks.begin(), reference.breaks.end());
    ends.push_back(line.length());
    for (size_t k = 0; k + 1 < ends.size(); k++) {
        Piece piece;
        const double length = ends[k + 1] - ends[k];
        piece.first = static_cast<int>(control_.size());
        piece.intervals = std::max(1, static_cast<int>(std::lround(length / (knot * diameter_))));
        piece.step = length / piece.intervals;
        piece.start_s = ends[k];
        piece.end_s = ends[k + 1];
        for (int c = 0; c < piece.intervals + 3; c++) {
            const double s = ends[k] + (c - 1) * piece.step;
            control_.push_back(line.at(s));
            const size_t i = line.segment(std::clamp(s, 0.0, line.length()));
            const double f = std::clamp(line.fraction(i, s), 0.0, 1.0);
            shape_.insert(shape_.end(), {(1.0 - f) * reference.rho[i] + f * reference.rho[i + 1], 0.0, 0.0});
        }
        piece_.push_back(piece);
    }
    pinned_.assign(control_.size(), 0);
    tau_.assign(control_.size(), 0.0);
    give_.assign(control_.size(), {1.0, 1.0, 1.0, 1.0});
    // A frame that turns as little as it can.
    Vector3d tangent, first;
    for (const Piece &piece : piece_) {
        for (int c = piece.first; c < piece.first + piece.intervals + 3; c++) {
            const int a = std::max(piece.first, c - 1), b = std::min(piece.first + piece.intervals + 2, c + 1);
            const Vector3d t = (control_[static_cast<size_t>(b)] - control_[static_cast<size_t>(a)]).normalized();
            first = c == 0 ? t.unitOrthogonal() : Vector3d(Eigen::Quaterniond::FromTwoVectors(tangent, t) * first);
            first = (first - first.dot(t) * t).normalized();
            tangent = t;
            first_.push_back(first);
            second_.push_back(t.cross(first));
        }
    }
}

void Surface::assign(const Reference &reference)
{
    const Polyline line(reference.centre);
    const double reach = 0.5 * diameter_, spacing = 0.1 * diameter_;
    const int samples = std::max(2, static_cast<int>(line.length() / spacing) + 1);
    Eigen::Matrix3Xd path(3, samples);
    for (int i = 0; i < samples; i++) {
        path.col(i) = line.at(line.length() * i / (samples - 1));
    }
    const Nearest<3> nearest(path);
    const size_t n = static_cast<size_t>(cloud_.size());
    of_piece_.assign(n, -1);
    u_.assign(n, 0.0);
    distance_.assign(n, 0.0);
    noise_.assign(n, 0.0);
    weight_.assign(n, 0.0);
    robust_.assign(n, 0.0);
    used_.assign(n, 0);
    std::vector<size_t> stretch(n, 0), count(static_cast<size_t>(line.length() / diameter_) + 2, 0);
    for (size_t i = 0; i < n; i++) {
        const Vector3d x = cloud_.points.col(static_cast<Eigen::Index>(i));
        const int sample = nearest.nearest(x, 1)[0];
        if (!((x - path.col(sample)).norm() < 1.2 * FAR * reach)) {
            continue;
        }
        const double s = line.length() * sample / (samples - 1);
        size_t k = 0;
        while (k + 1 < piece_.size() && s > piece_[k].end_s) {
            k++;
        }
        // At a joint the nearest sample may be the neighbour's: one try each way.
        for (int attempt = 0; attempt < 2; attempt++) {
            const Piece &piece = piece_[k];
            const double u = foot(piece, x, std::clamp((s - piece.start_s) / piece.step, 0.0, 1.0 * piece.intervals));
            const bool before = u < 0.0 && k > 0, after = u > piece.intervals && k + 1 < piece_.size();
            if (attempt == 0 && (before || after)) {
                k = before ? k - 1 : k + 1;
                continue;
            }
            if (u > -0.05 && u < piece.intervals + 0.05 && (x - frame(piece, u).centre).norm() < FAR * reach) {
                of_piece_[i] = static_cast<int>(k);
                u_[i] = u;
                stretch[i] = static_cast<size_t>(s / diameter_);
                count[stretch[i]]++;
            }
            break;
        }
    }
    // A fixed choice where there are more than enough.
    std::vector<size_t> seen(count.size(), 0);
    for (size_t i = 0; i < n; i++) {
        if (of_piece_[i] >= 0) {
            const size_t every = 1 + count[stretch[i]] / ENOUGH_A_DIAMETER;
            used_[i] = seen[stretch[i]]++ % every == 0;
        }
    }
}

Surface::Frame Surface::frame(const Piece &piece, double u) const
{
    const Basis b = basis_at(u, piece.intervals);
    Frame out;
    Vector3d d1 = Vector3d::Zero(), first = Vector3d::Zero();
    out.centre.setZero();
    out.second_derivative.setZero();
    for (size_t k = 0; k < 4; k++) {
        const size_t c = static_cast<size_t>(piece.first + b.first) + k;
        out.centre += b.value[k] * control_[c];
        d1 += b.d1[k] * control_[c];
        out.second_derivative += b.d2[k] * control_[c];
        first += b.value[k] * first_[c];
    }
    out.speed = d1.norm();
    out.tangent = d1 / out.speed;
    out.first = (first - first.dot(out.tangent) * out.tangent).normalized();
    out.second = out.tangent.cross(out.first);
    return out;
}

void Surface::shape_at(const Piece &piece, double u, double *shape) const
{
    const Basis b = basis_at(u, piece.intervals);
    const size_t floats = static_cast<size_t>(floats_);
    std::fill(shape, shape + floats_, 0.0);
    for (size_t k = 0; k < 4; k++) {
        const double *from = shape_.data() + (static_cast<size_t>(piece.first + b.first) + k) * floats;
        for (size_t p = 0; p < floats; p++) {
            shape[p] += b.value[k] * from[p];
        }
    }
}

// Where the plane across the axis holds x: Newton from u.
double Surface::foot(const Piece &piece, const Vector3d &x, double u) const
{
    for (int i = 0; i < 20; i++) {
        const Basis b = basis_at(u, piece.intervals);
        Vector3d c = Vector3d::Zero(), d1 = Vector3d::Zero(), d2 = Vector3d::Zero();
        for (size_t k = 0; k < 4; k++) {
            const Vector3d &p = control_[static_cast<size_t>(piece.first + b.first) + k];
            c += b.value[k] * p;
            d1 += b.d1[k] * p;
            d2 += b.d2[k] * p;
        }
        const double slope = d1.squaredNorm() - (x - c).dot(d2);
        // Inside the bend's centre of curvature the plane turns round: keep to the side it came from.
        const double step = (x - c).dot(d1) / std::max(slope, 0.2 * d1.squaredNorm());
        u += std::clamp(step, -1.0, 1.0);
        u = std::clamp(u, -1.0, piece.intervals + 1.0);
        if (std::abs(step) < 1e-10) {
            break;
        }
    }
    return u;
}

// Distances, scale and weights at the present state; of all points at the end, of those in use while fitting.
void Surface::reweigh(bool all)
{
    std::vector<double> section(static_cast<size_t>(floats_));
    for (size_t i = 0; i < u_.size(); i++) {
        weight_[i] = robust_[i] = 0.0;
        if (of_piece_[i] < 0 || (!all && !used_[i])) {
            continue;
        }
        const Piece &piece = piece_[static_cast<size_t>(of_piece_[i])];
        const Vector3d x = cloud_.points.col(static_cast<Eigen::Index>(i));
        u_[i] = foot(piece, x, u_[i]);
        const Frame f = frame(piece, u_[i]);
        shape_at(piece, u_[i], section.data());
        const Vector3d d = x - f.centre;
        const Offset o = section_distance(order_, section.data(), {d.dot(f.first), d.dot(f.second)}, nullptr);
        distance_[i] = o.distance;
        noise_[i] = cloud_.variance(static_cast<int>(i), (o.n[0] * f.first + o.n[1] * f.second).normalized());
    }
    measure_roughness();
    const double information = 1.0 / (TUKEY_VARIANCE * correlation_), floor = 1e-9 * diameter_;
    for (size_t i = 0; i < u_.size(); i++) {
        if (of_piece_[i] < 0 || (!all && !used_[i]) || std::abs(distance_[i]) > GATE * 0.5 * diameter_) {
            continue;
        }
        const Piece &piece = piece_[static_cast<size_t>(of_piece_[i])];
        const auto c =
            static_cast<size_t>(piece.first + 1 + std::clamp(static_cast<int>(std::lround(u_[i])), 0, piece.intervals));
        const double variance = noise_[i] + tau_[c] * tau_[c] + floor * floor;
        robust_[i] = tukey_weight(distance_[i] * distance_[i] / variance);
        weight_[i] = robust_[i] * information / variance;
    }
}

// Around each control, from the points within 1.5 knots; from all where these are few.
void Surface::measure_roughness()
{
    constexpr size_t ENOUGH = 60;
    std::vector<std::vector<double>> r(control_.size()), noise(control_.size());
    std::vector<double> all_r, all_noise;
    for (size_t i = 0; i < u_.size(); i++) {
        if (!used_[i] || std::abs(distance_[i]) > GATE * 0.5 * diameter_) {
            continue;
        }
        const Piece &piece = piece_[static_cast<size_t>(of_piece_[i])];
        const int middle = static_cast<int>(std::lround(u_[i]));
        for (int k = std::max(0, middle - 1); k <= std::min(piece.intervals, middle + 1); k++) {
            const size_t c = static_cast<size_t>(piece.first + 1 + k);
            r[c].push_back(distance_[i]);
            noise[c].push_back(noise_[i]);
        }
        all_r.push_back(distance_[i]);
        all_noise.push_back(noise_[i]);
    }
    // The fit takes about as many degrees of freedom as there are controls, less what smoothing gives back.
    const int used = covariance_.empty() ? 0 : static_cast<int>(freedom_ * 3.0 / static_cast<double>(control_.size()));
    const double overall = roughness(all_r, all_noise, static_cast<int>(covariance_.empty() ? 0.0 : freedom_));
    for (size_t c = 0; c < control_.size(); c++) {
        tau_[c] = r[c].size() >= ENOUGH ? roughness(r[c], noise[c], used) : overall;
    }
}

void Surface::find_gaps()
{
    std::vector<std::array<int, BINS>> count(control_.size());
    for (auto &c : count) {
        c.fill(0);
    }
    for (size_t i = 0; i < u_.size(); i++) {
        if (!(weight_[i] > 0.0)) {
            continue;
        }
        const Piece &piece = piece_[static_cast<size_t>(of_piece_[i])];
        const Frame f = frame(piece, u_[i]);
        const Vector3d d = cloud_.points.col(static_cast<Eigen::Index>(i)) - f.centre;
        const double turn = std::atan2(d.dot(f.second), d.dot(f.first)) / (2.0 * std::numbers::pi) + 0.5;
        const auto bin = static_cast<size_t>(std::clamp(static_cast<int>(turn * BINS), 0, BINS - 1));
        const int middle = static_cast<int>(std::lround(u_[i]));
        for (int k = middle - 1; k <= middle + 1; k++) {
            const int c = std::clamp(k, -1, piece.intervals + 1) + piece.first + 1;
            count[static_cast<size_t>(c)][bin]++;
        }
    }
    for (size_t c = 0; c < control_.size(); c++) {
        pinned_[c] = widest_gap(count[c]) > ELLIPSE_GAP;
    }
}

bool Surface::solve(int rounds, bool adapt)
{
    SurfaceProblem problem(*this);
    optim::LeastSquares<1, 1> solver;
    const size_t each = static_cast<size_t>(problem.each());
    double moved = 0.0;
    for (int round = 0; round < rounds; round++) {
        reweigh(false);
        const std::vector<double> before = shape_;
        const std::vector<Vector3d> where = control_;
        solver.minimize(problem, {.max_iterations = round == 0 ? 3 : 1}); // the loop around goes on
        const auto known = solver.covariance(problem);
        const auto between = [&](size_t a, size_t b) { return a >= b ? known.f[a][a - b][0] : known.f[b][b - a][0]; };
        covariance_.assign(control_.size(), {});
        moved = 0.0;
        for (size_t c = 0; c < control_.size(); c++) {
            for (size_t back = 0; back <= std::min<size_t>(3, c); back++) {
                Eigen::MatrixXd block(each, each);
                for (size_t p = 0; p < each; p++) {
                    for (size_t q = 0; q < each; q++) {
                        block(static_cast<Eigen::Index>(p), static_cast<Eigen::Index>(q)) =
                            between(c * each + p, (c - back) * each + q);
                    }
                }
                covariance_[c].push_back(block);
            }
            const Eigen::MatrixXd &v = covariance_[c][0];
            const size_t rho = c * static_cast<size_t>(floats_);
            moved = std::max({moved, (control_[c] - where[c]).norm() / std::sqrt(v(0, 0) + v(1, 1)),
                              std::abs(shape_[rho] - before[rho]) / std::sqrt(v(2, 2))});
        }
        smooth(problem, between, adapt);
    }
    reweigh(false);
    return moved < 0.3;
}

// Fellner and Schall: the variance of each group of second differences, from their sizes and from what the data left of
// their freedom. A pseudo-observation of almost nothing keeps few rows from infinity. A pipe is straight and round over
// metres and then changes over decimetres: second differences are not normal but Student's, with GIVE degrees of
// freedom; their local factors are that distribution's weights, at the expected squares.
void Surface::smooth(const SurfaceProblem &problem, const SurfaceVariance &variance, bool adapt)
{
    constexpr double GIVE = 2.0;
    std::array<double, 4> rows{}, squares{}, trace{};
    std::vector<std::array<double, 4>> local(control_.size()), count(control_.size());
    problem.each_prior([&](double r, std::span<const int> f, std::span<const double *const> jf, int g) {
        if (g < 0) {
            return;
        }
        const auto k = static_cast<size_t>(g), c = static_cast<size_t>(f[f.size() / 2] / problem.each());
        double left = 0.0;
        for (size_t a = 0; a < f.size(); a++) {
            for (size_t b = 0; b < f.size(); b++) {
                left += *jf[a] * *jf[b] * variance(static_cast<size_t>(f[a]), static_cast<size_t>(f[b]));
            }
        }
        rows[k] += 1.0;
        squares[k] += r * r / stiffness_[k];
        trace[k] += left;
        local[c][k] += (r * r + left) / give_[c][k];
        count[c][k] += 1.0;
    });
    freedom_ = static_cast<double>(problem.each()) * static_cast<double>(control_.size());
    const double least = 1e-4 * 0.5 * diameter_, most = 0.3 * 0.5 * diameter_;
    for (size_t k = 0; k < 4; k++) {
        freedom_ -= trace[k];
        if (adapt && rows[k] > 0.0) {
            const double before = stiffness_[k],
                         wanted = (std::max(0.0, rows[k] - trace[k]) + 1.0) / (squares[k] + least * least);
            // Not faster: where the pipe changes, the fit must give way before it is flattened.
            stiffness_[k] =
                std::clamp(std::clamp(wanted, before / 30.0, before * 4.0), 1.0 / (most * most), 1.0 / (least * least));
            for (size_t c = 0; c < control_.size(); c++) {
                give_[c][k] = (GIVE + count[c][k]) / (GIVE + local[c][k] * stiffness_[k] / before);
            }
        }
    }
}

void Surface::widen(int order)
{
    const int floats = shape_parameters(order);
    std::vector<double> wider;
    for (size_t c = 0; c < control_.size(); c++) {
        for (int p = 0; p < floats; p++) {
            wider.push_back(p < floats_ ? shape_[c * static_cast<size_t>(floats_) + static_cast<size_t>(p)] : 0.0);
        }
    }
    shape_ = std::move(wider);
    order_ = order;
    floats_ = floats;
}

// Residuals of one stretch, standardised, and their places.
struct Stretch {
    std::vector<double> z, angle, along;
};

namespace
{

constexpr int TERMS = 2 * MAX_ORDER + 1;

// Least squares of z on harmonics 0 to MAX_ORDER: how much each order takes from the sum of squares. `basis` becomes
// orthonormal.
std::array<double, MAX_ORDER + 1> take_harmonics(Stretch &stretch, Eigen::MatrixXd &basis)
{
    const auto n = static_cast<Eigen::Index>(stretch.z.size());
    basis.resize(n, TERMS);
    for (Eigen::Index i = 0; i < n; i++) {
        basis(i, 0) = 1.0;
        for (int h = 1; h <= MAX_ORDER; h++) {
            basis(i, 2 * h - 1) = std::cos(h * stretch.angle[static_cast<size_t>(i)]);
            basis(i, 2 * h) = std::sin(h * stretch.angle[static_cast<size_t>(i)]);
        }
    }
    Eigen::Map<Eigen::VectorXd> z(stretch.z.data(), n);
    // Gram-Schmidt in order: each next pair's own share.
    std::array<double, MAX_ORDER + 1> taken{};
    for (int c = 0; c < TERMS; c++) {
        const double before = basis.col(c).squaredNorm();
        for (int pass = 0; pass < 2; pass++) {
            for (int b = 0; b < c; b++) {
                basis.col(c) -= basis.col(b).dot(basis.col(c)) * basis.col(b);
            }
        }
        const double norm = basis.col(c).norm();
        if (norm * norm < 1e-3 * before) {
            basis.col(c).setZero(); // not seen: a gap in azimuth
            continue;
        }
        basis.col(c) /= norm;
        const double part = basis.col(c).dot(z);
        taken[static_cast<size_t>((c + 1) / 2)] += part * part;
        z -= part * basis.col(c);
    }
    return taken;
}

} // namespace

// Neighbouring points share the wall's relief and the sensor's waviness: means over cells (30 degrees by a third of a
// diameter) then scatter more than independent points would let them. The factor by which variances widen.
void Surface::measure_correlation()
{
    constexpr int AROUND = 12, ALONG = 3;
    double sum = 0.0, cells = 0.0;
    Eigen::MatrixXd basis;
    for (Stretch &stretch : stretches()) {
        if (stretch.z.size() < 5 * TERMS) {
            continue;
        }
        take_harmonics(stretch, basis);
        std::array<double, AROUND * ALONG> total{}, count{};
        Eigen::MatrixXd taken = Eigen::MatrixXd::Zero(AROUND * ALONG, TERMS);
        for (size_t i = 0; i < stretch.z.size(); i++) {
            const double turn = stretch.angle[i] / (2.0 * std::numbers::pi) + 0.5;
            const int cell = std::min(AROUND - 1, static_cast<int>(turn * AROUND)) * ALONG +
                             std::clamp(static_cast<int>(stretch.along[i] * ALONG), 0, ALONG - 1);
            total[static_cast<size_t>(cell)] += stretch.z[i];
            count[static_cast<size_t>(cell)] += 1.0;
            taken.row(cell) += basis.row(static_cast<Eigen::Index>(i));
        }
        double variance = 0.0;
        for (const double z : stretch.z) {
            variance += z * z;
        }
        variance /= static_cast<double>(stretch.z.size() - TERMS);
        for (size_t c = 0; c < total.size(); c++) {
            if (count[c] >= 3.0) {
                // Of independent residuals the cell's sum has its count as variance, less what the harmonics took.
                const double left = count[c] - taken.row(static_cast<Eigen::Index>(c)).squaredNorm();
                if (left > 0.3 * count[c]) {
                    sum += total[c] * total[c] / (left * variance);
                    cells += 1.0;
                }
            }
        }
    }
    correlation_ = 1.0;
    if (cells >= 10.0) {
        const double factor = sum / cells;
        // Chance alone scatters it by sqrt(2 / cells).
        correlation_ = factor > 1.0 + 2.0 * std::sqrt(2.0 / cells) ? factor : 1.0;
    }
}

// Stretches of one diameter with their standardised residuals.
std::vector<Stretch> Surface::stretches() const
{
    std::vector<Stretch> out;
    std::vector<size_t> start;
    for (const Piece &piece : piece_) {
        start.push_back(out.size());
        out.resize(out.size() +
                   static_cast<size_t>(std::max(1.0, std::round(piece.intervals * piece.step / diameter_))));
    }
    start.push_back(out.size());
    const double information = 1.0 / (TUKEY_VARIANCE * correlation_);
    for (size_t i = 0; i < u_.size(); i++) {
        if (!(robust_[i] > 0.1)) {
            continue;
        }
        const size_t k = static_cast<size_t>(of_piece_[i]);
        const Piece &piece = piece_[k];
        const double place =
            std::clamp(u_[i] / piece.intervals, 0.0, 1.0) * static_cast<double>(start[k + 1] - start[k]);
        const size_t at = std::min(start[k + 1] - 1, start[k] + static_cast<size_t>(place));
        const Frame f = frame(piece, u_[i]);
        const Vector3d d = cloud_.points.col(static_cast<Eigen::Index>(i)) - f.centre;
        out[at].z.push_back(distance_[i] * std::sqrt(weight_[i] / robust_[i] / information));
        out[at].angle.push_back(std::atan2(d.dot(f.second), d.dot(f.first)));
        out[at].along.push_back(place - static_cast<double>(at - start[k]));
    }
    return out;
}

// The order with the least BIC: what harmonics beyond the present take from the residuals of each stretch, against
// their cost.
int Surface::choose_order() const
{
    std::array<double, MAX_ORDER + 1> gain{};
    Eigen::MatrixXd basis;
    for (Stretch &stretch : stretches()) {
        if (stretch.z.size() < 5 * TERMS) {
            continue;
        }
        const double price = 2.0 * std::log(static_cast<double>(stretch.z.size()) / correlation_);
        const std::array<double, MAX_ORDER + 1> taken = take_harmonics(stretch, basis);
        double variance = 0.0;
        for (const double z : stretch.z) {
            variance += z * z;
        }
        variance /= static_cast<double>(stretch.z.size() - TERMS);
        for (size_t h = 3; h <= MAX_ORDER; h++) {
            gain[h] += taken[h] / (variance * correlation_) - price;
        }
    }
    int best = order_;
    double sum = 0.0, most = 0.0;
    for (int h = order_ + 1; h <= MAX_ORDER; h++) {
        sum += gain[static_cast<size_t>(h)];
        if (h != 5 && sum > most) { // orders 5 and 6 come together
            most = sum;
            best = h;
        }
    }
    return best;
}

void Surface::tabulate()
{
    double s = 0.0;
    for (Piece &piece : piece_) {
        piece.start_s = s;
        piece.arc.assign(1, s);
        for (int i = 0; i < piece.intervals * ARC; i++) {
            const double a = static_cast<double>(i) / ARC, h = 1.0 / ARC;
            s += h / 6.0 * (frame(piece, a).speed + 4.0 * frame(piece, a + 0.5 * h).speed + frame(piece, a + h).speed);
            piece.arc.push_back(s);
        }
        piece.end_s = s;
    }
}

double Surface::chainage(const Piece &piece, double u) const
{
    const double x = std::clamp(u, 0.0, 1.0 * piece.intervals) * ARC;
    const size_t i = std::min(piece.arc.size() - 2, static_cast<size_t>(x));
    const double inside = piece.arc[i] + (x - static_cast<double>(i)) * (piece.arc[i + 1] - piece.arc[i]);
    const double beyond = u < 0.0 ? u : std::max(0.0, u - piece.intervals);
    return inside + beyond * piece.step;
}

double Surface::parameter(const Piece &piece, double s) const
{
    const auto after = std::upper_bound(piece.arc.begin() + 1, piece.arc.end() - 1, s);
    const size_t i = static_cast<size_t>(after - piece.arc.begin()) - 1;
    return std::clamp((static_cast<double>(i) + (s - piece.arc[i]) / (piece.arc[i + 1] - piece.arc[i])) / ARC, 0.0,
                      1.0 * piece.intervals);
}

void Surface::describe()
{
    placed_.resize(u_.size());
    std::vector<double> section(static_cast<size_t>(floats_));
    for (size_t i = 0; i < u_.size(); i++) {
        OnSurface &p = placed_[i];
        p = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, of_piece_[i]};
        if (of_piece_[i] < 0) {
            continue;
        }
        const Piece &piece = piece_[static_cast<size_t>(of_piece_[i])];
        const Frame f = frame(piece, u_[i]);
        const Vector3d d = cloud_.points.col(static_cast<Eigen::Index>(i)) - f.centre;
        const auto c =
            static_cast<size_t>(piece.first + 1 + std::clamp(static_cast<int>(std::lround(u_[i])), 0, piece.intervals));
        p.s = chainage(piece, u_[i]);
        p.angle = std::atan2(d.dot(f.second), d.dot(f.first));
        p.r = d.norm();
        p.distance = distance_[i];
        p.sigma = std::sqrt(noise_[i] + tau_[c] * tau_[c]);
        p.weight = robust_[i];
        if (robust_[i] > 0.0) {
            by_s_.emplace_back(p.s, static_cast<int>(i));
        }
    }
    std::sort(by_s_.begin(), by_s_.end());
}

OnSurface Surface::project(const Vector3d &x) const
{
    OnSurface best{0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1};
    double nearest = std::numeric_limits<double>::infinity();
    std::vector<double> section(static_cast<size_t>(floats_));
    for (size_t k = 0; k < piece_.size(); k++) {
        const Piece &piece = piece_[k];
        double start = 0.0, closest = std::numeric_limits<double>::infinity();
        for (int i = 0; i <= 2 * piece.intervals; i++) {
            const double d = (frame(piece, 0.5 * i).centre - x).squaredNorm();
            if (d < closest) {
                closest = d;
                start = 0.5 * i;
            }
        }
        const double u = foot(piece, x, start);
        if (u < -0.05 || u > piece.intervals + 0.05) {
            continue;
        }
        const Frame f = frame(piece, u);
        const Vector3d d = x - f.centre;
        if (d.norm() < nearest) {
            nearest = d.norm();
            shape_at(piece, u, section.data());
            const Vector2d y(d.dot(f.first), d.dot(f.second));
            best = {chainage(piece, u),
                    std::atan2(y[1], y[0]),
                    d.norm(),
                    section_distance(order_, section.data(), y, nullptr).distance,
                    0.0,
                    0.0,
                    static_cast<int>(k)};
        }
    }
    return best;
}

double Surface::thinning() const
{
    double on = 0.0, used = 0.0;
    for (size_t i = 0; i < used_.size(); i++) {
        on += of_piece_[i] >= 0;
        used += used_[i];
    }
    return used > 0.0 ? on / used : 1.0;
}

std::vector<std::pair<double, double>> Surface::pieces() const
{
    std::vector<std::pair<double, double>> out;
    for (const Piece &piece : piece_) {
        out.emplace_back(piece.start_s, piece.end_s);
    }
    return out;
}

Station Surface::station(double s, int which) const
{
    if (which < 0) {
        which = 0;
        while (which + 1 < static_cast<int>(piece_.size()) && s > piece_[static_cast<size_t>(which)].end_s) {
            which++;
        }
    }
    const Piece &piece = piece_[static_cast<size_t>(which)];
    const double u = parameter(piece, s);
    const Frame f = frame(piece, u);
    const Basis b = basis_at(u, piece.intervals);
    Station out;
    out.s = s;
    out.piece = which;
    out.centre = f.centre;
    out.tangent = f.tangent;
    out.first = f.first;
    out.second = f.second;
    out.shape.resize(floats_);
    shape_at(piece, u, out.shape.data());
    out.covariance = Eigen::MatrixXd::Zero(floats_ + 2, floats_ + 2);
    out.tangent_covariance.setZero();
    double bend = 0.0;
    for (size_t i = 0; i < 4; i++) {
        for (size_t j = 0; j < 4; j++) {
            const size_t a = static_cast<size_t>(piece.first + b.first) + std::max(i, j), back = i > j ? i - j : j - i;
            const Eigen::MatrixXd &stored = covariance_[a][back];
            const Eigen::MatrixXd v = i >= j ? stored : Eigen::MatrixXd(stored.transpose());
            out.covariance += b.value[i] * b.value[j] * v;
            out.tangent_covariance += b.d1[i] * b.d1[j] / (f.speed * f.speed) * v.topLeftCorner<2, 2>();
            bend += b.d2[i] * b.d2[j] * 0.5 * v.topLeftCorner<2, 2>().trace();
        }
    }
    const Vector3d turn = f.second_derivative - f.second_derivative.dot(f.tangent) * f.tangent;
    out.curvature = turn.norm() / (f.speed * f.speed);
    out.curvature_sigma = std::sqrt(std::max(0.0, bend)) / (f.speed * f.speed);
    const auto c =
        static_cast<size_t>(piece.first + 1 + std::clamp(static_cast<int>(std::lround(u)), 0, piece.intervals));
    out.roughness = tau_[c];
    out.ellipse = !pinned_[c];
    count_around(out);
    return out;
}

// Points within three eighths of a diameter: how many, how they lie around the wall, how well they fit.
void Surface::count_around(Station &station) const
{
    const double half = 0.375 * diameter_;
    std::array<int, BINS> count{};
    double squares = 0.0;
    const auto from = std::lower_bound(by_s_.begin(), by_s_.end(), std::pair(station.s - half, -1));
    for (auto it = from; it != by_s_.end() && it->first < station.s + half; ++it) {
        const OnSurface &p = placed_[static_cast<size_t>(it->second)];
        if (p.piece != station.piece) {
            continue;
        }
        const double turn = p.angle / (2.0 * std::numbers::pi) + 0.5;
        count[static_cast<size_t>(std::clamp(static_cast<int>(turn * BINS), 0, BINS - 1))]++;
        squares += p.distance * p.distance;
        station.inliers++;
    }
    station.gap = widest_gap(count);
    station.rms = station.inliers > 0 ? std::sqrt(squares / station.inliers) : 0.0;
}

} // namespace pipefish::tube
