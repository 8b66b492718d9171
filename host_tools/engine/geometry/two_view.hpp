// Relative pose of two views from rays with the noise of their pixels: robust, anywhere on the sphere.
#pragma once

#include "geometry/sight.hpp"

#include <cstdint>
#include <span>
#include <vector>

namespace pipefish::geometry
{

struct TwoViewOptions {
    double chi2 = 6.63;        // inlier limit of the squared Sampson distance: 99 % of chi^2 with 1 degree of freedom
    double confidence = 0.999; // of having drawn five inliers
    int min_iterations = 20, max_iterations = 5000;
    uint64_t seed = 0; // of the random numbers; the result is a function of input and seed alone
};

enum class TwoViewStatus {
    ok,
    plane,       // ok, but a plane explains the points: a second solution may do as well; decide with a third view
    no_baseline, // a rotation alone explains the points: `pose.t` is meaningless
    too_few,     // fewer than 8 pairs, or no model that 8 pairs agree with
    behind,      // fewer than 90 % of the points lie along their rays: not the motion of a camera in a rigid scene
};

struct TwoView {
    TwoViewStatus status = TwoViewStatus::too_few;
    Pose pose;                   // cam2_from_cam1, |t| = 1 (0 for no_baseline)
    std::vector<uint8_t> inlier; // one a pair
    int inliers = 0, iterations = 0;
    double sigma = 0.0;           // robust, of the inliers' Sampson distances: 1 = noise as stated
    double median_parallax = 0.0; // radians, of the inliers
    Eigen::Matrix<double, 5, 5> covariance = Eigen::Matrix<double, 5, 5>::Zero(); // rotation (left, 3), direction (2)
    Matrix32 direction_basis = Matrix32::Zero(); // tangent vectors that the last two refer to
};

// Pairs a[i], b[i]. Pairs with an invalid sight are no inliers.
TwoView two_view(std::span<const Sight> a, std::span<const Sight> b, const TwoViewOptions &options = {});

// Squared Sampson distance of one pair, chi^2 with 1 degree of freedom: e^2 over the variance of e = f2 . (t x R f1).
double sampson_squared(const Pose &pose, const Sight &a, const Sight &b);

// Sum of the squared sines of the angles by which the two rays must turn to meet, at its least over all epipolar planes
// (Oliensis 2002, in the form that keeps its digits): for rays without known noise.
double ray_angles_squared(const Matrix3d &essential, const Vector3d &f1, const Vector3d &f2);

} // namespace pipefish::geometry
