// From a bare cloud to a path along the pipe: find a cylinder somewhere, then follow it both ways.
#pragma once

#include "tube/cylinder.hpp"

#include <vector>

namespace pipefish::tube
{

// A cylinder found anywhere in the cloud, whatever its axis, size and the share of gross points; status no_cylinder
// where there is none.
Cylinder find_cylinder(const Cloud &cloud, int threads);

// Sections one after another from `seed` both ways until the wall ends; a wall missing for up to two diameters is
// bridged. Ordered along the pipe, first section first.
std::vector<Cylinder> trace(const Cloud &cloud, const Cylinder &seed);

// Sections along a path inside the pipe (camera centres, in order, each a step on), and on beyond its ends as far as
// the wall goes. Only the good ones; empty where there are none.
std::vector<Cylinder> along(const Cloud &cloud, const Eigen::Matrix3Xd &path, int threads);

} // namespace pipefish::tube
