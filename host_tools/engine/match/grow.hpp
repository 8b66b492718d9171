// Quasi-dense matching by growth: the best match passes its local affine map on to its neighbourhood, where new matches
// are found by correlation, again and again. After Lhuillier and Quan (2002) for `translation`, and Kannala and Brandt
// (CVPR 2007, 2008) for the affine maps.
#pragma once

#include "match/epipolar.hpp"
#include "match/image.hpp"

#include <cstdint>
#include <string>
#include <vector>

namespace pipefish::match
{

enum class Mode {
    kTranslation, // narrow baseline: no map, whole pixels, the fastest
    kConstant,    // each match keeps its seed's map
    kAdaptive,    // the map is estimated anew at each match
};

enum class Adaptation {
    kFit,       // least-squares fit of the patch
    kGradient,  // second moments of the gradient, then the fit
    kIntensity, // second moments of the intensity (the papers' way), no fit
};

enum class Turn {
    kCorrelation, // the rotation that moments leave open: of gradient directions' histograms, by correlation
    kPeak,        // of the histograms' peaks (the papers' way)
    kEpipolar,    // of the epipolar lines
};

struct Options {
    Mode mode = Mode::kAdaptive;
    Adaptation adaptation = Adaptation::kFit;
    Turn turn = Turn::kCorrelation;
    int radius = 5;        // of the correlation window; 2..7
    double zncc_min = 0.8; // of a match; maps of what correlates below 0.8 are not fitted but their parent's
    double seed_zncc_min = 0.8;
    double texture = 0.01;    // least difference to a neighbour (of 1)
    double sigma_min = 0.01;  // least deviation within a window
    double epipolar_px = 1.0; // largest Sampson distance, where there is an Epipolar
    bool refine_seeds = true;
    int classes = 1024; // of correlation, best first; within one, the last found first, which keeps to the cache
    int threads = 1;    // for what is independent; results do not depend on it
};

struct Match {
    int x = 0, y = 0;                                 // pixel of image 1
    Eigen::Vector2f centre = Eigen::Vector2f::Zero(); // where it is in image 2
    Eigen::Matrix2f a = Eigen::Matrix2f::Identity();  // maps offsets in image 1 to offsets in image 2
    // Of the window as resampled with its own map: one of radius + 1 where it was fitted, of `radius` where it was not
    // (translation), of radius 7 for a seed.
    float zncc = -1;
    int parent = -1; // the match it grew from, -1 for a seed
    int seed = -1;   // the seed it comes from, an index into what was given
};

struct Seed {
    Eigen::Vector2d at, centre;
    Eigen::Matrix2d a;
};

struct Growth {
    std::vector<Match> matches;
    int seeds_used = 0; // seeds that passed
    // Candidates that were looked at, and those turned away, by reason: low_zncc before or after the fit.
    int64_t tried = 0, low_zncc = 0, taken = 0, off_line = 0;
    int64_t at_border = 0; // matches found at the rim of their search: many mean a wrong map
};

// Grows matches from `seeds`. One-to-one: each match has a pixel of image 1, and the rounded position in image 2, to
// itself. Depends on the order of seeds of equal correlation only, never on `threads`. Time and memory linear in pixels
// and matches.
Growth grow(const ScaleStack &first, const ScaleStack &second, const std::vector<Seed> &seeds, const Options &options,
            const Epipolar *epipolar);

} // namespace pipefish::match
