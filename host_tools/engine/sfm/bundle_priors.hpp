// What a bundle adjustment knows beside its pixels: odometry, gravity, priors of what all observations share, and the
// gauge. And where all that moves has its place in the normal matrix.
#pragma once

#include "sfm/bundle.hpp"

#include <array>
#include <cmath>

namespace pipefish::sfm
{

template <int R, int C> using Rows = Eigen::Matrix<double, R, C, Eigen::RowMajor>;
using RowsX = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// What the optimiser moves.
struct BundleState {
    std::vector<Matrix3d> rotation;
    std::vector<Vector3d> centre, point;
    double wheel = 0.0;
    Vector3d down = Vector3d::UnitY();
    double late = 1.0;  // of the stated line time
    double pupil = 0.0; // its shift e1
    Vector3d sag = Vector3d::Zero();
    Eigen::VectorXd camera; // in units of the prior's root, whose covariance is the unit matrix
};

// The relative whitened residual of the distance from the first to the last frame: stiff enough to be exact beside
// thousands of observations, soft enough to leave digits to the rest.
constexpr double SCALE_SIGMA = 1e-7;

// Places in the normal matrix: of frames in its chain, of what all share in its border. -1: is not estimated.
struct BundleLayout {
    int frames = 0, held_front = 0, held_back = 0;
    int border = 0, down_at = -1, sag_at = -1, late_at = -1, pupil_at = -1, camera_columns = 0;

    // Blocks run from the last frame to the first, which is held: the covariance then grows along the recursion that
    // makes it, block by block. The other way round it would be what is left of differences, of the far end's.
    int block_of(int f) const { return frames - 1 - f; }

    bool is_held(int f) const { return f < held_front || f >= frames - held_back; }
};

class BundlePriors
{
public:
    BundleLayout layout;

    // `state`: the start, which gets what is not of its map. `rolls`: whether rows count.
    BundlePriors(const BundleOptions &options, int first, bool rolls, BundleState &state)
        : options_(options), first_(first), start_length_((state.centre.back() - state.centre.front()).norm())
    {
        layout.frames = static_cast<int>(state.centre.size());
        layout.held_front = options.held_front;
        layout.held_back = options.held_back;
        if (options.odometry) {
            layout.border = 1;
        }
        if (options.gravity && start_gravity(state)) {
            layout.down_at = layout.border;
            layout.border += 2;
        }
        if (options.sag_sigma > 0.0) {
            layout.sag_at = layout.border;
            layout.border += 3;
        }
        if (options.late_sigma > 0.0 && rolls) {
            layout.late_at = layout.border++;
        }
        if (options.pupil_sigma > 0.0) {
            layout.pupil_at = layout.border++;
        }
        if (options.camera_prior) {
            layout.camera_columns = static_cast<int>(options.camera_prior->root.cols());
            layout.border += layout.camera_columns;
            state.camera = Eigen::VectorXd::Zero(layout.camera_columns);
        }
    }

    // Half the sum of squares.
    double cost(const BundleState &state) const
    {
        double sum = 0.0;
        if (holds_scale()) {
            sum += scale_residual(state) * scale_residual(state);
        }
        if (options_.odometry) {
            const optim::RobustLoss loss = slip();
            for (int f = 0; f + 1 < layout.frames; f++) {
                if (has_step(f)) {
                    const double r = step_residual(state, f, nullptr);
                    sum += loss(r * r).rho;
                }
            }
            sum += std::pow(state.wheel / options_.odometry->scale_sigma, 2);
        }
        if (layout.down_at >= 0) {
            for (int f = 0; f < layout.frames; f++) {
                if (!options_.gravity->down[static_cast<size_t>(f + first_)].isZero()) {
                    sum += down_residual(state, f).squaredNorm();
                }
            }
        }
        if (layout.sag_at >= 0) {
            sum += sag_root().cwiseProduct(state.sag).squaredNorm();
        }
        if (layout.late_at >= 0) {
            sum += std::pow((state.late - 1.0) / options_.late_sigma, 2);
        }
        if (layout.pupil_at >= 0) {
            sum += std::pow((state.pupil - options_.pupil) / options_.pupil_sigma, 2);
        }
        if (layout.camera_columns > 0) {
            sum += state.camera.squaredNorm();
        }
        return 0.5 * sum;
    }

    template <class Sink> void linearize(const BundleState &state, Sink &sink) const
    {
        const optim::RobustLoss plain;
        for (int f = 0; f < layout.frames; f++) {
            if (layout.is_held(f)) { // its derivatives are left out everywhere else
                const Eigen::Matrix<double, 6, 1> zero = Eigen::Matrix<double, 6, 1>::Zero();
                const Rows<6, 6> one = Rows<6, 6>::Identity();
                const std::array<const double *, 1> j{one.data()};
                const int block = layout.block_of(f);
                sink.add(6, zero.data(), plain, nullptr, std::span(&block, 1), j, nullptr);
            }
        }
        if (holds_scale()) {
            const int last = layout.block_of(layout.frames - 1);
            const double r = scale_residual(state);
            Rows<1, 6> j_last = Rows<1, 6>::Zero();
            j_last.rightCols<3>() =
                (state.centre.back() - state.centre.front()).normalized().transpose() / (start_length_ * SCALE_SIGMA);
            const std::array<const double *, 1> j{j_last.data()};
            sink.add(1, &r, plain, nullptr, std::span(&last, 1), j, nullptr);
        }
        if (options_.odometry) {
            linearize_odometry(state, sink);
        }
        if (layout.down_at >= 0) {
            linearize_gravity(state, sink);
        }
        if (layout.sag_at >= 0) {
            RowsX j = RowsX::Zero(3, layout.border);
            j.middleCols<3>(layout.sag_at) = sag_root().asDiagonal();
            const Vector3d r = sag_root().cwiseProduct(state.sag);
            sink.add(3, r.data(), plain, nullptr, {}, {}, j.data());
        }
        if (layout.late_at >= 0) {
            linearize_one(layout.late_at, state.late - 1.0, options_.late_sigma, sink);
        }
        if (layout.pupil_at >= 0) {
            linearize_one(layout.pupil_at, state.pupil - options_.pupil, options_.pupil_sigma, sink);
        }
        if (layout.camera_columns > 0) {
            RowsX j = RowsX::Zero(layout.camera_columns, layout.border);
            j.rightCols(layout.camera_columns).setIdentity();
            sink.add(layout.camera_columns, state.camera.data(), plain, nullptr, {}, {}, j.data());
        }
    }

private:
    // Of one parameter that is `off` by so much from what is known of it to a sigma.
    template <class Sink> void linearize_one(int at, double off, double sigma, Sink &sink) const
    {
        RowsX j = RowsX::Zero(1, layout.border);
        j(0, at) = 1.0 / sigma;
        const double r = off / sigma;
        sink.add(1, &r, optim::RobustLoss{}, nullptr, {}, {}, j.data());
    }

    // One over the sigmas of the sag's parts.
    Vector3d sag_root() const { return Vector3d(1.0, 2.0, 2.0) / options_.sag_sigma; }

    // False where the inclinometer says nothing of these frames: nothing would tell where down is.
    bool start_gravity(BundleState &state) const
    {
        Vector3d sum = Vector3d::Zero();
        bool known = false;
        for (size_t f = 0; f < state.rotation.size(); f++) {
            const Vector3d &down = options_.gravity->down[f + static_cast<size_t>(first_)];
            known = known || !down.isZero();
            sum += state.rotation[f].transpose() * down;
        }
        state.down = sum.isZero() ? Vector3d(Vector3d::UnitY()) : Vector3d(sum.normalized());
        return known;
    }

    bool has_step(int f) const { return std::isfinite(options_.odometry->step[static_cast<size_t>(f + first_)]); }

    optim::RobustLoss slip() const
    {
        return optim::RobustLoss{optim::RobustLoss::Kind::mixture, options_.odometry->slip_spread,
                                 options_.odometry->slip_share};
    }

    double step_residual(const BundleState &state, int f, Vector3d *direction) const
    {
        const size_t i = static_cast<size_t>(f), global = static_cast<size_t>(f + first_);
        const Vector3d moved = state.centre[i + 1] - state.centre[i];
        const double length = moved.norm();
        if (direction) {
            *direction = length > 0.0 ? Vector3d(moved / length) : Vector3d(Vector3d::Zero());
        }
        // In readings, whose noise it is: in metres the fit would shrink everything to make the noise smaller.
        return (length / (1.0 + state.wheel) - std::abs(options_.odometry->step[global])) /
               options_.odometry->sigma[global];
    }

    Vector2d down_residual(const BundleState &state, int f) const
    {
        const size_t i = static_cast<size_t>(f);
        const Vector3d &measured = options_.gravity->down[i + static_cast<size_t>(first_)];
        return geometry::tangent_basis(measured).transpose() * (state.rotation[i] * state.down) /
               options_.gravity->sigma;
    }

    double scale_residual(const BundleState &state) const
    {
        return ((state.centre.back() - state.centre.front()).norm() / start_length_ - 1.0) / SCALE_SIGMA;
    }

    bool holds_scale() const { return options_.hold_scale && !options_.odometry && options_.held_back == 0; }

    template <class Sink> void linearize_odometry(const BundleState &state, Sink &sink) const
    {
        const optim::RobustLoss loss = slip();
        RowsX j_border = RowsX::Zero(1, layout.border);
        for (int f = 0; f + 1 < layout.frames; f++) {
            if (!has_step(f)) {
                continue;
            }
            const size_t global = static_cast<size_t>(f + first_);
            const double gain = 1.0 + state.wheel, inverse = 1.0 / (gain * options_.odometry->sigma[global]);
            Vector3d direction;
            const double r = step_residual(state, f, &direction);
            Rows<1, 6> j[2] = {Rows<1, 6>::Zero(), Rows<1, 6>::Zero()};
            const int frames[2] = {f, f + 1};
            for (int side = 0; side < 2; side++) {
                if (!layout.is_held(frames[side])) {
                    j[side].rightCols<3>() = (side == 0 ? -inverse : inverse) * direction.transpose();
                }
            }
            const double length =
                (state.centre[static_cast<size_t>(f) + 1] - state.centre[static_cast<size_t>(f)]).norm();
            j_border(0, 0) = -inverse * length / gain;
            const std::array<const double *, 2> j_f{j[0].data(), j[1].data()};
            const int blocks[2] = {layout.block_of(f), layout.block_of(f + 1)};
            sink.add(1, &r, loss, nullptr, blocks, j_f, j_border.data());
        }
        j_border.setZero();
        j_border(0, 0) = 1.0 / options_.odometry->scale_sigma;
        const double r = state.wheel * j_border(0, 0);
        sink.add(1, &r, optim::RobustLoss{}, nullptr, {}, {}, j_border.data());
    }

    template <class Sink> void linearize_gravity(const BundleState &state, Sink &sink) const
    {
        const Matrix32 basis = geometry::tangent_basis(state.down);
        RowsX j_border = RowsX::Zero(2, layout.border);
        for (int f = 0; f < layout.frames; f++) {
            const Vector3d &measured = options_.gravity->down[static_cast<size_t>(f + first_)];
            if (measured.isZero()) {
                continue;
            }
            const size_t i = static_cast<size_t>(f);
            const Vector2d r = down_residual(state, f);
            const Matrix23 across = geometry::tangent_basis(measured).transpose() / options_.gravity->sigma;
            Rows<2, 6> j = Rows<2, 6>::Zero();
            if (!layout.is_held(f)) {
                j.leftCols<3>() = -across * geometry::cross_matrix(state.rotation[i] * state.down);
            }
            j_border.middleCols(layout.down_at, 2) = across * state.rotation[i] * basis;
            const std::array<const double *, 1> j_f{j.data()};
            const int block = layout.block_of(f);
            sink.add(2, r.data(), optim::RobustLoss{}, nullptr, std::span(&block, 1), j_f, j_border.data());
        }
    }

    BundleOptions options_;
    int first_;
    double start_length_;
};

} // namespace pipefish::sfm
