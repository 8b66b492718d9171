// Initial values from the data alone: homographies from a board's plane to directed rays, which hold beyond 180 degrees
// too, and a sweep of classical projections and focal lengths.
#pragma once

#include "calib/bundle.hpp"

#include <optional>
#include <span>
#include <vector>

namespace pipefish::calib
{

// The pose that carries drawn points onto unit rays, |points| = |rays|; weights may be empty. A plane Z = 0 needs four
// points (a homography H with the sign that makes most of x . (H p) positive), other boards six. None: too few or
// degenerate.
std::optional<Pose> pose_from_rays(std::span<const Eigen::Vector3d> points, std::span<const Eigen::Vector3d> rays,
                                   std::span<const double> weights);

// The pose of a view's board in its camera by rays of its points, robust to outliers; its camera must be one-to-one up
// to its theta_max. `every`: uses each n-th point only. None: fewer than four points with a ray, or degenerate.
std::optional<Pose> view_pose(const pf_camera &camera, const View &view, const Shape &shape, size_t every = 1);

struct Start {
    pf_camera camera;       // generic, with k2 (p6)
    double median_px = 0.0; // of the distance between measured and projected points
    uint32_t radial = 0;    // the classical projection that it comes from
};

// The best equidistant lens over focal lengths; or, `classical`, that of each other classical projection near the best
// equidistant one, best first. Views are of one camera. Empty: none explains them.
std::vector<Start> sweep(std::span<const View> views, uint32_t width, uint32_t height, double c_u, double c_v,
                         bool classical);

} // namespace pipefish::calib
