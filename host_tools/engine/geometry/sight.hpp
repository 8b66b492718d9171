// Pixels as rays with their noise, poses, and rotations.
#pragma once

#include "pipefish/camera.h"

#include <Eigen/Core>
#include <Eigen/Geometry>

#include <span>
#include <vector>

namespace pipefish::geometry
{

using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector3d;
using Matrix32 = Eigen::Matrix<double, 3, 2>;
using Matrix23 = Eigen::Matrix<double, 2, 3>;

// X_cam = r X_world + t = r (X_world - c).
struct Pose {
    Matrix3d r = Matrix3d::Identity();
    Vector3d t = Vector3d::Zero();

    Vector3d centre() const { return -r.transpose() * t; }
    Vector3d operator*(const Vector3d &x) const { return r * x + t; }
    Pose operator*(const Pose &other) const { return {r * other.r, r * other.t + t}; }
    Pose inverse() const { return {r.transpose(), centre()}; }
};

// One pixel: a unit ray from `origin`, and how it moves (b) by one standard deviation of the pixel's noise along the
// two axes of `root`, root root^T = covariance of the pixel.
struct Sight {
    Vector3d ray = Vector3d::Zero();
    Vector3d origin = Vector3d::Zero(); // zero for a central camera
    Matrix32 b = Matrix32::Zero();
    Eigen::Matrix2d root = Eigen::Matrix2d::Identity();
    Vector2d uv = Vector2d::Zero();
    bool valid = false; // inside the model
};

// uv: 2; covariance: 2 x 2, or null for `sigma`^2 I. A covariance that is not positive definite: not valid.
Sight make_sight(const pf_camera &camera, const double *uv, const double *covariance, double sigma);

// Of n pixels: uv: n x 2; covariance: n x 2 x 2, or null.
std::vector<Sight> make_sights(const pf_camera &camera, size_t n, const double *uv, const double *covariance,
                               double sigma);

inline Matrix3d cross_matrix(const Vector3d &v)
{
    Matrix3d m;
    m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
    return m;
}

Matrix3d rotation_exp(const Vector3d &w);     // by the angle |w| about w
Vector3d rotation_log(const Matrix3d &r);     // its inverse, |w| <= pi
Matrix3d nearest_rotation(const Matrix3d &m); // in the Frobenius norm

// Two unit vectors across the unit vector `f`.
Matrix32 tangent_basis(const Vector3d &f);

} // namespace pipefish::geometry
