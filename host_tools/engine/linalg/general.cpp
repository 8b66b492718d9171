#include "linalg/linalg.hpp"

#include <Eigen/Eigenvalues>

namespace pipefish::linalg
{

GeneralEigen general_eigen(const Eigen::Matrix3d &m)
{
    const Eigen::EigenSolver<Eigen::Matrix3d> solver(m);
    return {solver.eigenvalues(), solver.eigenvectors()};
}

} // namespace pipefish::linalg
