// Decompositions of small matrices, compiled here once: a solver of Eigen's for one size is some hundred types, 10 to
// 20 s of the compiler's time in every file that names it.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace pipefish::linalg
{

// Of a symmetric matrix, whose lower half is read: values ascending, vectors in columns.
template <int N> struct SymmetricEigen {
    Eigen::Matrix<double, N, 1> values;
    Eigen::Matrix<double, N, N> vectors;
    bool converged;
};
template <int N> SymmetricEigen<N> symmetric_eigen(const Eigen::Matrix<double, N, N> &m); // N: 2, 3, 9, 12

struct GeneralEigen {
    Eigen::Vector3cd values;
    Eigen::Matrix3cd vectors;
};
GeneralEigen general_eigen(const Eigen::Matrix3d &m);

struct Svd { // m = u diag(s) v^T, s descending
    Eigen::Matrix3d u, v;
};
Svd svd(const Eigen::Matrix3d &m);

// The least rotation that takes the direction of one vector to another's.
Eigen::Quaterniond turn_between(const Eigen::Vector3d &from, const Eigen::Vector3d &to);

} // namespace pipefish::linalg
