// The pose between two others, at constant velocity: where a row of a rolling shutter was exposed.
#pragma once

#include "geometry/sight.hpp"

namespace pipefish::geometry
{

// At `share` of the way from `first` (0) to `second` (1), or beyond: the centre on the straight line, the rotation
// Exp(share Log(R2 R1^T)) R1. The two rotations must be less than half a turn apart.
Pose pose_between(const Pose &first, const Pose &second, double share);

// How that rotation R turns with the two: Exp(w1) R1 and Exp(w2) R2 make it Exp(by_first w1 + by_second w2) R.
struct TurnBetween {
    Matrix3d r; // R
    Matrix3d by_first, by_second;
};
// `turn`: Log(R2 R1^T).
TurnBetween turn_between(const Matrix3d &r1, const Vector3d &turn, double share);

} // namespace pipefish::geometry
