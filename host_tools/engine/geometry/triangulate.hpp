// Points from rays.
#pragma once

#include "geometry/sight.hpp"

#include <optional>
#include <span>

namespace pipefish::geometry
{

// One view of a point, for triangulation.
struct View {
    const Pose *pose = nullptr;
    const Sight *sight = nullptr;
};

// The point with the least weighted squared distances to the rays, weights 1 / (distance x angular noise)^2 refined
// once; then `steps` Gauss-Newton steps on the whitened angular errors. Nothing where the rays are parallel or the
// point lies behind an eye. `chi2`, where not null, gets the sum of squares of the whitened residuals, 2 a view.
std::optional<Vector3d> triangulate(std::span<const View> views, int steps = 2, double *chi2 = nullptr);

// Depths along two unit rays g (turned into the second frame) and f2 that meet best, f2 depth2 = g depth1 + t.
Vector2d midpoint_depths(const Vector3d &g, const Vector3d &f2, const Vector3d &t);

// Largest angle between any two of the rays, seen from the point, radians.
double parallax(std::span<const View> views, const Vector3d &x);

} // namespace pipefish::geometry
