// Self-calibration from matches of one or many pairs of views: from nothing known but the size of the picture.
#pragma once

#include "geometry/two_view.hpp"
#include "selfcal/observe.hpp"

#include <optional>

namespace pipefish::selfcal
{

struct Options {
    Prior prior;
    double alpha_limit = 0.08, alone_limit = 0.02; // sigmas of ln alpha from which on a motion is missing
    double sigma_least = 0.2; // pixels: what matches have in common, and lenses that are not round, residuals hide
    uint64_t seed = 0;
    int threads = 1;
};

// What became of a pair.
enum class PairStatus {
    ok,
    few,      // fewer than 15 matches agree with one motion
    standing, // hardly anything moved
    turning,  // a rotation alone explains it: no translation
    plane,    // a homography of rays explains it
};

struct PairReport {
    PairStatus status = PairStatus::few;
    Pose pose;
    std::vector<uint8_t> inlier;
    int inliers = 0;
    double median_shift = 0.0; // pixels, of all matches
    double rms = 0.0;          // of the inliers' errors, pixels
};

struct Result {
    bool found = false; // a lens that matches agree with, determined or not
    pf_camera camera{};
    LensVector lens = LensVector::Zero();
    LensFamily family{1.0, 0.01};
    LensMatrix covariance = LensMatrix::Zero();
    double sigma = 0.0; // of a match's error, pixels
    std::vector<PairReport> pairs;
    Observability observed;
    int starts = 0, refined = 0, agreeing = 0; // starts tried, refined, that end at this lens
    double runner_up = 0.0;                    // truncated cost of the best other minimum over this one's; 0: none
};

Result self_calibrate(const std::vector<Pair> &pairs, uint32_t width, uint32_t height, const Options &options);

} // namespace pipefish::selfcal
