// Where no odometry tells lengths: how large the shift of the camera's pupil is in a map's unit.
#pragma once

#include "sfm/bundle.hpp"

namespace pipefish::sfm
{

// A map that was built without the pupil's shift grows or shrinks by as much on each metre of the way: by a factor of
// ten over 24 m of DN300 and 1 mm per rad^2, from where no adjustment finds back. Takes out what of the wall's distance
// from the camera's way is such a growth, to start from; the distance from the first frame to the last stays.
void straighten(Submap &map, const TrackTable &table);

// Whether the encoder was not read over more of the way than the wall is off it: over as much a pupil's shift that
// nobody told makes the scale wander by as much as it makes a diameter wrong beside an encoder, further on by far more.
bool is_unread(const Submap &map, const TrackTable &table, const Odometry &odometry);

// Of a segment that no encoder measures: its unit in metres, by the size of the pipe, tells how large the pupil's shift
// is in it. From there the pixels tell: what it does to them is as large as the wall is near, and is like nothing else.
// pupil_sigma: metres of the shift that the camera leaves open, 0: nothing is done, lenses are central; pipe_radius:
// metres, about, 0: unknown.
void guess_pupil(BundleOptions &settings, const Submap &map, const TrackTable &table, const pf_camera &camera,
                 double pupil_sigma, double pipe_radius);

} // namespace pipefish::sfm
