// Whether less than an essential matrix explains two views: a rotation, or the homography of a plane (GRIC, Torr 1998).
#pragma once

#include "geometry/sight.hpp"

#include <cstdint>
#include <optional>
#include <span>

namespace pipefish::geometry
{

// Both for the inliers of the essential solution `pose`. The rotation, if it explains them for less.
std::optional<Matrix3d> explaining_rotation(const Pose &pose, std::span<const Sight> a, std::span<const Sight> b,
                                            std::span<const int> inliers, uint64_t seed);
bool explained_by_plane(const Pose &pose, std::span<const Sight> a, std::span<const Sight> b,
                        std::span<const int> inliers);

} // namespace pipefish::geometry
