// The surface as the optimiser sees it: a chain of scalars, of each control axis (2), then section.
#pragma once

#include "optim/least_squares.hpp"
#include "tube/bspline.hpp"
#include "tube/section.hpp"
#include "tube/surface.hpp"

#include <cmath>
#include <limits>
#include <numbers>

namespace pipefish::tube
{

struct Surface::Information {
    optim::NormalMatrix<1, 1> normal;
    optim::ArrowFactor<1, 1> factor;
};

class SurfaceProblem
{
public:
    explicit SurfaceProblem(Surface &surface)
        : t_(surface), each_(surface.floats_ + 2), saved_control_(surface.control_), saved_shape_(surface.shape_)
    {
    }

    int each() const { return each_; } // scalars a control

    int eliminated() const { return 0; }
    int banded() const { return each_ * static_cast<int>(t_.control_.size()); }
    int border() const { return 0; }
    int reach() const { return 4 * each_ - 1; }
    std::span<const int> couplings(int) const { return {}; }

    void save()
    {
        saved_control_ = t_.control_;
        saved_shape_ = t_.shape_;
    }

    void apply(const optim::Step<1, 1> &step)
    {
        const size_t each = static_cast<size_t>(each_), floats = each - 2;
        for (size_t c = 0; c < t_.control_.size(); c++) {
            const auto *f = step.f.data() + c * each;
            t_.control_[c] = saved_control_[c] + f[0][0] * t_.first_[c] + f[1][0] * t_.second_[c];
            for (size_t k = 0; k < floats; k++) {
                t_.shape_[c * floats + k] = saved_shape_[c * floats + k] + f[k + 2][0];
            }
        }
    }

    double cost(int e) const
    {
        if (e >= 0) {
            return 0.0;
        }
        for (size_t c = 0; c < t_.control_.size(); c++) {
            const double *q = shape(c);
            if (!(q[0] > std::hypot(q[1], q[2]))) {
                return std::numeric_limits<double>::infinity();
            }
        }
        double sum = 0.0;
        for (size_t i = 0; i < t_.u_.size(); i++) {
            if (t_.weight_[i] > 0.0) {
                const double d = residual(i, nullptr, nullptr);
                sum += t_.weight_[i] * d * d;
            }
        }
        each_prior([&](double r, auto, auto, int) { sum += r * r; });
        return 0.5 * sum;
    }

    template <class Sink> void linearize(int e, Sink &sink) const
    {
        if (e >= 0) {
            return;
        }
        double j[4 * MOST], of_shape[MOST];
        const double *rows[4 * MOST];
        int f[4 * MOST];
        for (size_t k = 0; k < 4 * MOST; k++) {
            rows[k] = j + k;
        }
        const size_t each = static_cast<size_t>(each_);
        for (size_t i = 0; i < t_.u_.size(); i++) {
            if (!(t_.weight_[i] > 0.0)) {
                continue;
            }
            Eigen::Vector3d n;
            const double w = std::sqrt(t_.weight_[i]), r = w * residual(i, &n, of_shape);
            const Surface::Piece &piece = t_.piece_[static_cast<size_t>(t_.of_piece_[i])];
            const Basis b = basis_at(t_.u_[i], piece.intervals);
            for (size_t k = 0; k < 4; k++) {
                const size_t c = static_cast<size_t>(piece.first + b.first) + k;
                const double wb = w * b.value[k];
                double *to = j + k * each;
                to[0] = -wb * n.dot(t_.first_[c]);
                to[1] = -wb * n.dot(t_.second_[c]);
                for (size_t p = 2; p < each; p++) {
                    to[p] = wb * of_shape[p - 2];
                }
                for (size_t p = 0; p < each; p++) {
                    f[k * each + p] = static_cast<int>(c * each + p);
                }
            }
            sink.add(1, &r, optim::RobustLoss{}, nullptr, std::span<const int>(f, 4 * each),
                     std::span<const double *const>(rows, 4 * each), nullptr);
        }
        each_prior([&](double r, std::span<const int> of, std::span<const double *const> jf, int) {
            sink.add(1, &r, optim::RobustLoss{}, nullptr, of, jf, nullptr);
        });
    }

    // Calls take(residual, scalars, derivatives, group) for each second difference along the pipe, those of a control
    // one after the other; group -1: what is assumed where half the wall is seen at most.
    template <class Take> void each_prior(const Take &take) const
    {
        constexpr double PIN = 1e-4; // of the radius, harmonics: none for all that matters
        constexpr double FACTOR[3] = {1.0, -2.0, 1.0};
        double j[6];
        const double *rows[6] = {j, j + 1, j + 2, j + 3, j + 4, j + 5};
        int f[6];
        for (const Surface::Piece &piece : t_.piece_) {
            for (int c = piece.first + 1; c < piece.first + piece.intervals + 2; c++) {
                const size_t mid = static_cast<size_t>(c);
                for (int p = 0; p < each_; p++) {
                    const auto g = static_cast<size_t>(group(p));
                    const double root = std::sqrt(t_.stiffness_[g] * t_.give_[mid][g]);
                    double r = 0.0;
                    size_t used = 0;
                    for (size_t k = 0; k < 3; k++) {
                        const size_t at = mid + k - 1;
                        const double scale = root * FACTOR[k];
                        if (p >= 2) {
                            r += scale * shape(at)[p - 2];
                            f[used] = static_cast<int>(at) * each_ + p;
                            j[used++] = scale;
                            continue;
                        }
                        const Eigen::Vector3d &along = p == 0 ? t_.first_[mid] : t_.second_[mid];
                        r += scale * t_.control_[at].dot(along);
                        f[used] = static_cast<int>(at) * each_;
                        j[used++] = scale * t_.first_[at].dot(along);
                        f[used] = static_cast<int>(at) * each_ + 1;
                        j[used++] = scale * t_.second_[at].dot(along);
                    }
                    take(r, std::span<const int>(f, used), std::span<const double *const>(rows, used), group(p));
                }
            }
        }
        for (size_t c = 0; c < t_.control_.size(); c++) {
            for (int p = 3; t_.pinned_[c] > 0 && p < each_; p++) {
                const double scale =
                    p < 5 ? std::sqrt(ellipse_information(t_.pinned_[c])) : 1.0 / (PIN * 0.5 * t_.diameter_);
                f[0] = static_cast<int>(c) * each_ + p;
                j[0] = scale;
                take(scale * shape(c)[p - 2], std::span<const int>(f, 1), std::span<const double *const>(rows, 1), -1);
            }
        }
    }

    // Of the parameters of one control: axis, rho, ellipse, harmonics.
    static int group(int p) { return p < 2 ? 0 : p == 2 ? 1 : p < 5 ? 2 : 3; }

private:
    // Of one parameter of the ellipse, a control of a run of so many that see half the wall at most: what is assumed of
    // pipes. Independent rows and the second differences' together give any one place of a long run the variance v
    // where each row has (2 sqrt(2) v l^(1/4))^(-4/3), l the differences' stiffness; a short or stiff run is one
    // ellipse, whose variance the rows have together.
    double ellipse_information(int run) const
    {
        const double sigma = t_.ovality_ * 0.5 * t_.diameter_ / (2.0 * std::numbers::sqrt2), v = sigma * sigma;
        const double along = std::pow(2.0 * std::numbers::sqrt2 * v * std::pow(t_.stiffness_[2], 0.25), -4.0 / 3.0);
        return std::max(along, 1.0 / (run * v));
    }

    static constexpr size_t MOST = shape_parameters(MAX_ORDER) + 2;

    const double *shape(size_t c) const { return t_.shape_.data() + c * static_cast<size_t>(t_.floats_); }

    // Signed distance of point i; the normal in space and the derivatives by the section's parameters.
    double residual(size_t i, Eigen::Vector3d *n, double *by_shape) const
    {
        const Surface::Piece &piece = t_.piece_[static_cast<size_t>(t_.of_piece_[i])];
        const Eigen::Vector3d x = t_.cloud_.points.col(static_cast<Eigen::Index>(i));
        t_.u_[i] = t_.foot(piece, x, t_.u_[i]);
        const Surface::Frame frame = t_.frame(piece, t_.u_[i]);
        double section[MOST];
        t_.shape_at(piece, t_.u_[i], section);
        const Eigen::Vector3d d = x - frame.centre;
        const Offset offset = section_distance(t_.order_, section, {d.dot(frame.first), d.dot(frame.second)}, by_shape);
        if (n) {
            *n = offset.n[0] * frame.first + offset.n[1] * frame.second;
        }
        return offset.distance;
    }

    Surface &t_;
    int each_;
    std::vector<Eigen::Vector3d> saved_control_;
    std::vector<double> saved_shape_;
};

} // namespace pipefish::tube
