// Adjustment of one lens and the relative poses of pairs of views by the angular error.
#pragma once

#include "geometry/sight.hpp"
#include "optim/least_squares.hpp"
#include "selfcal/lens.hpp"

#include <cstdint>
#include <vector>

namespace pipefish::selfcal
{

using geometry::Pose;

struct Pair {
    std::vector<double> uv1, uv2; // n x 2 pixels
    size_t size() const { return uv1.size() / 2; }
    Eigen::Vector2d one(size_t i) const { return {uv1[2 * i], uv1[2 * i + 1]}; }
    Eigen::Vector2d two(size_t i) const { return {uv2[2 * i], uv2[2 * i + 1]}; }
};

struct Prior {
    double bend = 0.01;               // of the radius: how far a lens differs from a nominal one at the rim
    Eigen::Vector2d centre{0.0, 0.0}; // principal point, pixels, and its sigma
    double centre_sigma = 10.0;
};

// What may move: each stage has the one before inside.
enum class Stage { poses, radius, centre, all };

class Adjustment
{
public:
    static constexpr int kPose = 5; // rotation on the left, direction in its tangent plane

    uint32_t width = 0, height = 0;
    LensFamily family{1.0, 0.01};
    LensVector lens = LensVector::Zero();
    Prior prior;
    double sigma = 1.0; // pixels
    optim::RobustLoss loss;
    const std::vector<Pair> *pairs = nullptr;
    std::vector<int> used;               // pairs that take part
    std::vector<Pose> poses;             // of all pairs
    std::vector<std::vector<int>> match; // of all pairs: which matches count

    optim::Summary adjust(Stage stage, int iterations = 30);
    pf_camera camera() const { return camera_at(lens); }

    // Residual of a match in pixels; NaN where a pixel is outside the model, 0 for a ray along the baseline.
    double error(size_t pair, size_t i) const;
    // Of the matches that count of a used pair (its place in `used`), after a step of all unknowns, the lens's and the
    // pose's: errors in sigmas, and their derivatives there. What adjust() works with, for tests.
    struct Errors {
        Eigen::VectorXd value;
        Eigen::Matrix<double, Eigen::Dynamic, kLens + kPose> slope;
    };
    Errors errors_after(int place, const Eigen::Matrix<double, kLens + kPose, 1> &step);
    // Sum of min(square, 9) in sigmas over all matches of the used pairs.
    double truncated(double at_sigma) const;

    // Covariance of the lens, with the information at matches that are moved onto their epipolar planes: the noise's
    // own products in J^T J would feign knowledge of directions that nothing tells.
    LensMatrix covariance() const;
    LensVector prior_mean() const;
    LensVector prior_sigma() const;

    // ---- the problem as the optimiser sees it
    int eliminated() const { return static_cast<int>(used.size()); }
    int banded() const { return 0; }
    int border() const { return static_cast<int>(free_.size()); }
    int reach() const { return 0; }
    std::span<const int> couplings(int) const { return {}; }
    template <class Sink> void linearize(int e, Sink &sink) const;
    double cost(int e) const;
    void apply(const optim::Step<kPose, 1> &step);
    void save()
    {
        saved_lens_ = lens;
        saved_poses_ = poses;
    }

private:
    pf_camera camera_at(const LensVector &at) const;
    void set_stage(Stage stage);

    std::vector<int> free_;
    LensVector saved_lens_ = LensVector::Zero();
    std::vector<Pose> saved_poses_;
    pf_camera now_{};
    bool valid_ = false;
};

} // namespace pipefish::selfcal
