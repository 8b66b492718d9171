// Two views of a rigid scene: how far a pair of pixels is from agreeing with the motion between any two central
// cameras, and what the motion demands of the affine map between their surroundings. Holds beyond 90 degrees: rays, not
// planes.
#pragma once

#include "pipefish/camera.h"

#include <Eigen/Core>

#include <optional>

namespace pipefish::match
{

// The linearised constraint at a pair of pixels: error + n . dx + n' . dx' = 0.
struct EpipolarLine {
    double error;           // f' . E f
    Eigen::Vector2d n, n_2; // its derivatives by the pixel of image 1 and of image 2
    double twist;           // of the second derivative by both (2,2), its norm: what a pixel's error adds to either

    // Pixels between the pair and the nearest pair that agrees (Sampson's distance).
    double distance() const;
    // The closest map with A^T n' + n = 0, which holds on every smooth surface (differentiate the constraint along it);
    // as it is where the lines say nothing: within 2 to 3 pixels of the epipole.
    Eigen::Matrix2f corrected(const Eigen::Matrix2f &a) const;
};

// The same of a fundamental matrix: x_2^T f x = 0.
EpipolarLine line_of(const Eigen::Matrix3d &f, const Eigen::Vector2d &x, const Eigen::Vector2d &x_2);

class Epipolar
{
public:
    // cam2_from_cam1 = [R | t] of any scale, t not 0. The cameras are copied.
    Epipolar(const pf_camera &first, const pf_camera &second, const Eigen::Matrix<double, 3, 4> &cam2_from_cam1);

    // Nothing where a pixel has no ray.
    std::optional<EpipolarLine> at(const Eigen::Vector2d &x, const Eigen::Vector2d &x_2) const;

private:
    pf_camera first_, second_;
    Eigen::Matrix3d essential_;
};

} // namespace pipefish::match
