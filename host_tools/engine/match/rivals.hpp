// Whether a match could as well be elsewhere on its epipolar curve: repeated texture, or texture that runs along the
// curve. The places there are compared with the patch of image 1 like the match itself.
#pragma once

#include "match/epipolar.hpp"
#include "match/grow.hpp"

#include <functional>
#include <optional>
#include <vector>

namespace pipefish::match
{

// The epipolar line of a pixel of image 1 at a place of image 2.
using LineAt = std::function<std::optional<EpipolarLine>(const Eigen::Vector2d &, const Eigen::Vector2d &)>;

struct Reach {
    int nearest = 3, farthest = 20; // from the match along the curve, pixels of the coarser image
    int radius = 5;                 // of the correlation window
    double sigma_min = 0.01;
    int threads = 1; // do not change the result
};

// Of each match the largest correlation in reach over its own; 0 where nothing there can be compared, or the match
// itself cannot.
std::vector<double> rivals(const ScaleStack &first, const ScaleStack &second, const std::vector<Match> &matches,
                           const LineAt &line_at, const Reach &reach);

} // namespace pipefish::match
