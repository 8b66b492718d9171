// What the ways to find a lattice share.
#pragma once

#include "lattice.hpp"

namespace pipefish::detect
{

inline constexpr std::array<Site, 4> kSteps = {{{1, 0}, {0, 1}, {-1, 0}, {0, -1}}};

inline Site plus(const Site &a, const Site &b)
{
    return {a[0] + b[0], a[1] + b[1]};
}

inline double cross(const Eigen::Vector2d &a, const Eigen::Vector2d &b)
{
    return a.x() * b.y() - a.y() * b.x();
}

// Drops what is not where its neighbours on both sides say, the worst first.
void prune(Grid &grid);

} // namespace pipefish::detect
