// What departs from the smooth tube: steps between pipes, and patches of wall that stand in or out.
#pragma once

#include "tube/surface.hpp"

#include <Eigen/Core>

#include <span>
#include <vector>

namespace pipefish::tube
{

// Two fits that meet at s, one from each side: axis with slope and curvature, radius and ellipse with slope.
struct Step {
    double s;
    double chi2;                            // of the 7 differences below, jointly
    Eigen::Matrix<double, 7, 1> difference; // x, y, radius, ec, es (metres), slopes of x and y; after minus before
    Eigen::Matrix<double, 7, 7> covariance;
    int before, after; // points
};

// At every `every` metres of the tube's length; places with too few points on one side are left out.
std::vector<Step> scan_steps(std::span<const OnSurface> points, double length, double window, double every,
                             double radius);

// For one in `every` points the median distance of its k nearest among these on the unrolled wall (itself included);
// NaN for the others, and where the point is off the tube, gross (beyond `most` metres) or its neighbours are further
// than `reach` metres.
std::vector<double> local_medians(std::span<const OnSurface> points, double radius, int k, int every, double reach,
                                  double most);

} // namespace pipefish::tube
