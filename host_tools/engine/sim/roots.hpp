// Roots in the pipe: bundles of strands, every strand a chain of rounded cones (the hull of two spheres).
#pragma once

#include "sim/wall.hpp"

#include <Eigen/Core>

#include <vector>

namespace pipefish::sim
{

struct RoundCone {
    Eigen::Vector3d a, b; // centres, metres
    double radius_a, radius_b;
};

struct Ball { // around something
    Eigen::Vector3d centre;
    double radius;
};

// A tree over the cones: a node's descendants follow it, up to `skip`.
struct Twig {
    Ball around;
    size_t skip;
    int cone; // of a leaf, else -1
};

struct Bundle {
    std::vector<RoundCone> cones; // strand by strand
    std::vector<Twig> tree;       // the first one: around all
};

// Grows a bundle from `base` along the unit vector `inward`, bending towards `down`.
Bundle grow_roots(const Root &spec, const Eigen::Vector3d &base, const Eigen::Vector3d &inward,
                  const Eigen::Vector3d &down);

// The same, moved: out = rotation (p - origin).
Bundle moved(const Bundle &bundle, const Eigen::Matrix3d &rotation, const Eigen::Vector3d &origin);

// First hit (or with `any`, one of them) of the ray (unit direction) with t in (0, t_max); every radius is `grow`
// metres larger a metre of t. False: none. `t` and the outward normal of the hit.
bool hit_bundle(const Bundle &bundle, const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, double t_max,
                double grow, bool any, double &t, Eigen::Vector3d &normal);

} // namespace pipefish::sim
