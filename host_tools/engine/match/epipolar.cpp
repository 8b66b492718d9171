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
    // At the epipole n' vanishes: |n'| there is below what a pixel's error turns it by. A ray per pixel is |J| ~ 1/f,
    // n ~ sin(angle to the epipole) / f, so the ratio of the two normals far from 1 tells as well as any bound.
    const Eigen::Matrix2d before = a.cast<double>();
    const double there = n_2.squaredNorm(), here = n.squaredNorm();
    if (!(there > 1e-4 * here) || !(here > 1e-4 * there))
        return a;
    const Eigen::RowVector2d off = n_2.transpose() * before + n.transpose();
    return (before - n_2 * off / there).cast<float>();
}

EpipolarLine line_of(const Eigen::Matrix3d &f, const Eigen::Vector2d &x, const Eigen::Vector2d &x_2)
{
    const Eigen::Vector3d line_2 = f * x.homogeneous(), line = f.transpose() * x_2.homogeneous();
    return {x_2.homogeneous().dot(line_2), line.head<2>(), line_2.head<2>()};
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
    return EpipolarLine{f_2.dot(line_2), j.transpose() * line, j_2.transpose() * line_2};
}

} // namespace pipefish::match
