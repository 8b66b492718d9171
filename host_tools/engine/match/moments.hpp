// The affine map between two patches from their second moments, up to a rotation (Kannala & Brandt; Lindeberg).
#pragma once

#include "match/epipolar.hpp"
#include "match/grow.hpp"
#include "match/refine.hpp"

namespace pipefish::match
{

// The root of a symmetric positive definite matrix.
Eigen::Matrix2d root(const Eigen::Matrix2d &m);

// The map A with m_2 = A m A^T (spatial moments of intensity) or, with `gradient`, m_2 = A^-T m A^-1 (moments of the
// gradient, which transform the other way): root(m_2) R root(m)^-1, and root(m_2)^-1 R root(m).
Eigen::Matrix2d map_of_moments(const Eigen::Matrix2d &m, const Eigen::Matrix2d &m_2, const Eigen::Matrix2d &r,
                               bool gradient);

// One damped step of the map at a match by moments, kept when the correlation does not fall. `line` where known.
void adapt_by_moments(const ScaleStack &first, const ScaleStack &second, int x, int y, const Options &options,
                      const EpipolarLine *line, Local &local);

} // namespace pipefish::match
