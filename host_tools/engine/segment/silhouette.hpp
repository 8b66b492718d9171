// The outline of a recognised object in a scene: where it is expected, settled by the scene's colours with a cut.
#pragma once

#include "group/support.hpp"
#include "segment/colours.hpp"

namespace pipefish::segment
{

struct SilhouetteOptions {
    double rim = 3;        // pixels by which the expected outline may be off beside what was matched
    double spread = 0.3;   // and how much more for each pixel away from there: a map is extrapolated
    double evidence = 0.5; // of a pixel's colour: neighbours are not independent
    double smoothness = 4; // nats for neighbours of which one is in
    int rounds = 5;        // of colours and cut in turn, at most
    int most = 120'000;    // pixels of the surroundings; larger ones are made smaller
};

// Which pixels show the object. planes: one or three of the scene; expected: where all of the object would be; seen:
// where its surface was matched, which is kept; others: where other objects were matched, which is not. All of the
// scene's size. What hangs together with neither `seen` nor, by half, with `expected` is left out. Empty without
// `seen` and `expected`.
group::Mask silhouette(const std::vector<Image> &planes, const group::Mask &expected, const group::Mask &seen,
                       const group::Mask &others, const SilhouetteOptions &options);

} // namespace pipefish::segment
