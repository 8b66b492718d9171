// Rigid motions as calibration uses them: X' = R X + t, perturbed from the left: R <- exp(w) R, t <- t + d.
#pragma once

#include "linalg/linalg.hpp"

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace pipefish::calib
{

inline Eigen::Matrix3d cross(const Eigen::Vector3d &v)
{
    Eigen::Matrix3d m;
    m << 0.0, -v.z(), v.y(), v.z(), 0.0, -v.x(), -v.y(), v.x(), 0.0;
    return m;
}

// The rotation next to a matrix that is nearly one.
inline Eigen::Matrix3d nearest_rotation(const Eigen::Matrix3d &m)
{
    const linalg::Svd svd = linalg::svd(m);
    Eigen::Matrix3d u = svd.u;
    if ((u * svd.v.transpose()).determinant() < 0.0) {
        u.col(2) *= -1.0;
    }
    return u * svd.v.transpose();
}

struct Pose {
    Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
    Eigen::Vector3d translation = Eigen::Vector3d::Zero();

    Eigen::Vector3d operator*(const Eigen::Vector3d &point) const { return rotation * point + translation; }
    Pose operator*(const Pose &other) const
    {
        return {rotation * other.rotation, rotation * other.translation + translation};
    }
    Pose inverse() const { return {rotation.transpose(), -(rotation.transpose() * translation)}; }

    // The motion after the step (w, d).
    Pose moved(const Eigen::Matrix<double, 6, 1> &step) const
    {
        const Eigen::Vector3d w = step.head<3>();
        const double angle = w.norm();
        if (angle == 0.0) {
            return {rotation, translation + step.tail<3>()};
        }
        const Eigen::Matrix3d turn = Eigen::AngleAxisd(angle, w / angle).toRotationMatrix();
        return {turn * rotation, translation + step.tail<3>()};
    }
};

} // namespace pipefish::calib
