// How the surface comes to fit: weights and roughness, smoothness as the data want it, how many harmonics, and by how
// much the likeness of neighbours widens variances. Where things are on it: surface.cpp.
#include "tube/surface.hpp"

#include "tube/cylinder.hpp"
#include "tube/section.hpp"
#include "tube/surface_problem.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::tube
{

using Eigen::Vector3d;

namespace
{

constexpr double GATE = 0.5; // radii: distances beyond are gross whatever the scale
constexpr double ELLIPSE_GAP = 150.0 * std::numbers::pi / 180.0;

} // namespace

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
    const double information = 1.0 / (TUKEY_VARIANCE * correlation_), floor = EXACT * diameter_;
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

// Around each control, from the points within reach; from all where these are few.
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
        for (int k = std::max(0, middle - reach_); k <= std::min(piece.intervals, middle + reach_); k++) {
            const size_t c = static_cast<size_t>(piece.first + 1 + k);
            r[c].push_back(distance_[i]);
            noise[c].push_back(noise_[i]);
        }
        all_r.push_back(distance_[i]);
        all_noise.push_back(noise_[i]);
    }
    // The fit takes about as many degrees of freedom as there are controls, less what smoothing gives back.
    const int used = covariance_.empty()
                         ? 0
                         : static_cast<int>(freedom_ * (2.0 * reach_ + 1.0) / static_cast<double>(control_.size()));
    const double overall = roughness(all_r, all_noise, static_cast<int>(covariance_.empty() ? 0.0 : freedom_));
    for (size_t c = 0; c < control_.size(); c++) {
        tau_[c] = r[c].size() >= ENOUGH ? roughness(r[c], noise[c], used) : overall;
    }
}

void Surface::find_gaps()
{
    std::vector<std::array<int, AZIMUTH_BINS>> count(control_.size());
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
        const size_t bin = azimuth_bin(std::atan2(d.dot(f.second), d.dot(f.first)));
        const int middle = static_cast<int>(std::lround(u_[i]));
        for (int k = middle - reach_; k <= middle + reach_; k++) {
            const int c = std::clamp(k, -1, piece.intervals + 1) + piece.first + 1;
            count[static_cast<size_t>(c)][bin]++;
        }
    }
    for (const Piece &piece : piece_) {
        const int end = piece.first + piece.intervals + 3;
        for (int c = piece.first, run = 0; c < end; c++) {
            const bool gap = widest_gap(count[static_cast<size_t>(c)]) > ELLIPSE_GAP;
            run = gap ? run + 1 : 0;
            pinned_[static_cast<size_t>(c)] = run;
        }
        for (int c = end - 2; c >= piece.first; c--) { // the length of the run, at each of it
            int &here = pinned_[static_cast<size_t>(c)];
            here = here > 0 ? std::max(here, pinned_[static_cast<size_t>(c) + 1]) : 0;
        }
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

void Surface::keep_information()
{
    const SurfaceProblem problem(*this);
    information_ = std::make_unique<Information>();
    information_->normal.prepare(problem);
    information_->normal.linearize(problem, 1);
    if (!information_->factor.compute(information_->normal, 0.0)) {
        throw std::domain_error("tube: the surface is not determined");
    }
}

double Surface::variance(std::span<const double> s, std::span<const int> piece, const Eigen::MatrixXd &weight) const
{
    const size_t each = static_cast<size_t>(floats_) + 2;
    std::vector<double> by(control_.size() * each, 0.0);
    for (size_t i = 0; i < s.size(); i++) {
        const Piece &of = piece_.at(static_cast<size_t>(piece[i]));
        const Basis b = basis_at(parameter(of, s[i]), of.intervals);
        for (size_t k = 0; k < 4; k++) {
            const size_t first = (static_cast<size_t>(of.first + b.first) + k) * each + 2;
            for (Eigen::Index p = 0; p < weight.cols(); p++) {
                by[first + static_cast<size_t>(p)] += b.value[k] * weight(static_cast<Eigen::Index>(i), p);
            }
        }
    }
    optim::NormalMatrix<1, 1> system = information_->normal;
    for (size_t i = 0; i < by.size(); i++) {
        system.common.b_f[i][0] = -by[i];
    }
    const optim::Step<1, 1> solved = information_->factor.solve(system); // N^-1 by
    double sum = 0.0;
    for (size_t i = 0; i < by.size(); i++) {
        sum += by[i] * solved.f[i][0];
    }
    return sum;
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
    // A pipe may be straight and round to a hair over all its length: a limit at 1e-4 of the radius left ellipses more
    // freedom than they had, and their intervals a quarter too wide.
    const double least = 1e-6 * 0.5 * diameter_, most = 0.3 * 0.5 * diameter_;
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

} // namespace pipefish::tube
