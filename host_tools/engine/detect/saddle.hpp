// The corner of four squares, measured by fitting what a camera makes of it.
#pragma once

#include <Eigen/Dense>
#include <opencv2/core.hpp>

namespace pipefish::detect
{

struct SaddleSetup {
    Eigen::Matrix2d cell;     // pixels from the corner to its neighbours: columns along the rows, along the columns
    double reach = 0.7;       // how far the window goes, in cells
    double white_free = 1.0;  // in the white quadrants only this far from the edges (markers stand there), in cells
    int dark = 0;             // 1: the upper left quadrant (both cell coordinates negative) is dark, -1: it is
                              // light, 0: not known
    double max_radius = 10.0; // pixels
};

struct Saddle {
    bool found = false;
    Eigen::Vector2d at = Eigen::Vector2d::Zero();         // pixels
    Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero(); // pixels^2
    double contrast = 0.0; // half the step from dark to light, grey levels; positive: the upper left is dark
    double blur = 0.0;     // sigma, pixels
    double share = 0.0;    // of the window's variance that the fit explains
};

// Fits, to the grey levels around `start`, the product of two blurred edges that may be curved, times a light that may
// change linearly, plus another linear light: I = a + b.x + (c + d.x) erf(f1) erf(f2). The light terms keep a gradient
// from moving the corner. Not found: no such corner within 0.45 cells of the start, or not certain enough to be used.
Saddle fit_saddle(const cv::Mat &image, const Eigen::Vector2d &start, const SaddleSetup &setup);

} // namespace pipefish::detect
