// Where no odometry tells lengths: how large the shift of the camera's pupil is in a map's unit.
#pragma once

#include "sfm/bundle.hpp"

namespace pipefish::sfm
{

// Of a segment that no encoder measures: its unit in metres, by the size of the pipe, tells how large the pupil's shift
// is in it. From there the pixels tell: what it does to them is as large as the wall is near, and is like nothing else.
// pupil_sigma: metres of the shift that the camera leaves open, 0: nothing is done, lenses are central; pipe_radius:
// metres, about, 0: unknown.
void guess_pupil(BundleOptions &settings, const Submap &map, const TrackTable &table, const pf_camera &camera,
                 double pupil_sigma, double pipe_radius);

} // namespace pipefish::sfm
