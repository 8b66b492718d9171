#include "match/epipolar.hpp"

#include <Eigen/Geometry>

#include <cmath>
#include <limits>

namespace pipefish::match
{

double EpipolarLine::distance() const
{
    const double norm = std::sqrt(n.squaredNorm() + n_2.squaredNorm());
    return norm > 0 ? std::abs(error) / norm : std::numeric_limits<double>::infinity();
}

Eigen::Matrix2f EpipolarLine::corrected(const Eigen::Matrix2f &a) const
{
    // Towards an epipole a normal vanishes, in forward motion both at once, and a match's error of 0.1 px turns it at
    // will: the lines count where both normals are 20 times what that error adds.
    const double noise = 0.1 * twist;
    if (!(n_2.norm() >= 20 * noise && n.norm() >= 20 * noise && n_2.norm() > 0))
        return a;
    const Eigen::Matrix2d before = a.cast<double>();
    const Eigen::RowVector2d off = n_2.transpose() * before + n.transpose();
    return (before - n_2 * off / n_2.squaredNorm()).cast<float>();
}

EpipolarLine line_of(const Eigen::Matrix3d &f, const Eigen::Vector2d &x, const Eigen::Vector2d &x_2)
{
    const Eigen::Vector3d line_2 = f * x.homogeneous(), line = f.transpose() * x_2.homogeneous();
    return {x_2.homogeneous().dot(line_2), line.head<2>(), line_2.head<2>(), f.topLeftCorner<2, 2>().norm()};
}

Epipolar::Epipolar(const pf_camera &first, const pf_camera &second, const Eigen::Matrix<double, 3, 4> &cam2_from_cam1)
    : first_(first), second_(second)
{
    const Eigen::Vector3d t = cam2_from_cam1.col(3).normalized();
    Eigen::Matrix3d cross;
    cross << 0, -t.z(), t.y(), t.z(), 0, -t.x(), -t.y(), t.x(), 0;
    essential_ = cross * cam2_from_cam1.leftCols<3>();
}

std::optional<EpipolarLine> Epipolar::at(const Eigen::Vector2d &x, const Eigen::Vector2d &x_2) const
{
    using Slope = Eigen::Matrix<double, 3, 2, Eigen::RowMajor>;
    Eigen::Vector3d f, f_2;
    Slope j, j_2;
    if (pf_camera_unproject(&first_, x.data(), f.data(), nullptr, j.data()) != PF_OK ||
        pf_camera_unproject(&second_, x_2.data(), f_2.data(), nullptr, j_2.data()) != PF_OK)
        return std::nullopt;
    const Eigen::Vector3d line_2 = essential_ * f, line = essential_.transpose() * f_2;
    const Eigen::Matrix2d both = j_2.transpose() * essential_ * j;
    return EpipolarLine{f_2.dot(line_2), j.transpose() * line, j_2.transpose() * line_2, both.norm()};
}

} // namespace pipefish::match
