// Where the image of a disc has its centre of gravity: not at the image of the disc's centre (Paper II, eq. 19).
#pragma once

#include <Eigen/Core>

#include <array>

namespace pipefish::calib
{

// Points around the disc's edge. The area integral becomes one around the edge (Green), the trapezoid rule there
// converges like a power of the number: 12 give 5e-10 px where the bias is 0.15 px.
inline constexpr int kRim = 12;

// Directions around the rim, the k-th at 2 pi k / kRim.
const std::array<Eigen::Vector2d, kRim> &rim_directions();

// Centroid of the region with the given closed boundary, and its derivatives by each boundary point.
Eigen::Vector2d centroid(const Eigen::Matrix<double, kRim, 2> &rim, std::array<Eigen::Matrix2d, kRim> *d);

} // namespace pipefish::calib
