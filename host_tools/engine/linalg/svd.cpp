#include "linalg/linalg.hpp"

#include <Eigen/SVD>

namespace pipefish::linalg
{

Svd svd(const Eigen::Matrix3d &m)
{
    const Eigen::JacobiSVD<Eigen::Matrix3d> solver(m, Eigen::ComputeFullU | Eigen::ComputeFullV);
    return {solver.matrixU(), solver.matrixV()};
}

Eigen::Quaterniond turn_between(const Eigen::Vector3d &from, const Eigen::Vector3d &to)
{
    return Eigen::Quaterniond::FromTwoVectors(from, to);
}

} // namespace pipefish::linalg
