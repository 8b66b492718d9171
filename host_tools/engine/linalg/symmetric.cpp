#include "linalg/linalg.hpp"

#include <Eigen/Eigenvalues>

namespace pipefish::linalg
{

template <int N> SymmetricEigen<N> symmetric_eigen(const Eigen::Matrix<double, N, N> &m)
{
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, N, N>> solver(m);
    return {solver.eigenvalues(), solver.eigenvectors(), solver.info() == Eigen::Success};
}

template SymmetricEigen<2> symmetric_eigen(const Eigen::Matrix<double, 2, 2> &);
template SymmetricEigen<3> symmetric_eigen(const Eigen::Matrix<double, 3, 3> &);
template SymmetricEigen<9> symmetric_eigen(const Eigen::Matrix<double, 9, 9> &);
template SymmetricEigen<12> symmetric_eigen(const Eigen::Matrix<double, 12, 12> &);

} // namespace pipefish::linalg
