// Whether the matches of a pair are of a plane, whatever the lens: a homography between the rays of the two views and
// the lens are fitted together. A lens that was found with the epipolar constraint alone cannot tell: on a plane that
// constraint leaves so much free that the lens it ends at needs not map the plane by a homography.
#pragma once

#include "selfcal/adjust.hpp"

namespace pipefish::selfcal
{

enum class Flat {
    no,
    plane,
    turned, // the homography is a rotation's: without a change of place everything is as far away
};

// For the matches that count in `at`, of one of its pairs: whether plane and lens explain them for less (GRIC, Torr
// 1998) than its epipolar geometry.
Flat flatness(const Adjustment &at, size_t pair);

} // namespace pipefish::selfcal
