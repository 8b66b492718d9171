#include "tube/surface.hpp"

#include "linalg/linalg.hpp"
#include "tube/bspline.hpp"
#include "tube/cylinder.hpp"
#include "tube/nearest.hpp"
#include "tube/section.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace pipefish::tube
{

using Eigen::Vector2d;
using Eigen::Vector3d;

namespace
{

constexpr int ARC = 16;                 // steps of the table of chainages, a knot interval
constexpr double FAR = 3.0;             // radii: points beyond say nothing of this pipe
constexpr int ENOUGH_A_DIAMETER = 1500; // points: 2.6 % of their noise is left in a radius; more only cost time

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
    reach_ = std::max(1, static_cast<int>(std::lround(0.5 / options.knot)));
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
            first = c == 0 ? t.unitOrthogonal() : Vector3d(linalg::turn_between(tangent, t) * first);
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
    std::array<int, AZIMUTH_BINS> count{};
    double squares = 0.0;
    const auto from = std::lower_bound(by_s_.begin(), by_s_.end(), std::pair(station.s - half, -1));
    for (auto it = from; it != by_s_.end() && it->first < station.s + half; ++it) {
        const OnSurface &p = placed_[static_cast<size_t>(it->second)];
        if (p.piece != station.piece) {
            continue;
        }
        count[azimuth_bin(p.angle)]++;
        squares += p.distance * p.distance;
        station.inliers++;
    }
    station.gap = widest_gap(count);
    station.rms = station.inliers > 0 ? std::sqrt(squares / station.inliers) : 0.0;
}

} // namespace pipefish::tube
