// What the matches tell of a lens: how well along alpha, how well its rays, and what motion would tell more.
#pragma once

#include "selfcal/adjust.hpp"

namespace pipefish::selfcal
{

struct Observability {
    // Of the map diag(1, 1, alpha) on rays, cot theta -> alpha cot theta, which no motion without rotation across the
    // axis and no plane in two views shows: sigma of ln alpha.
    double alpha_sigma = 1e3;
    double alpha_alone = 1e3;   // the same by the matches alone, without priors, were all else of the lens known
    double bearing_sigma = 1e3; // radians, largest over the covered field, after the best common rotation
    double radius = 0.0;        // of the covered field, pixels from the principal point: 95 % of the inliers' pixels
    double theta = 0.0;         // its angle
    double area = 0.0;          // share of the picture inside the inliers' convex hull, the farthest twentieth left out
    double tilt = 0.0;          // largest angle between the optical axes of a pair, radians
    double axial = 0.0;         // smallest angle between a pair's translation and either optical axis, radians
    double needed = 0.0;        // radians: the least tilt among 5, 10, .. 45 degrees that would do; 0: none would
};

// Area of the convex hull (Andrew's chain) of the points, the twentieth farthest from the median left out.
double hull_area(std::vector<Eigen::Vector2d> points);

// The covered field and all that follows from the covariance. `limit`: what alpha_sigma may be.
// `alone_limit`: what alpha_alone may be. `needed` is looked for where one of them is beyond.
Observability observe(const Adjustment &at, const LensMatrix &covariance, double limit, double alone_limit);

// The change of the unknowns that is one of ln alpha, as nearly as the family has it.
LensVector alpha_direction(const Adjustment &at);

// Derivative of ln alpha by the lens's unknowns.
Eigen::Matrix<double, 1, kLens> alpha_row(const Adjustment &at);

// Largest sigma of the rays within `radius` pixels of the principal point, and largest angle between the rays of two
// lenses there, both after the best common rotation.
double bearing_sigma(const Adjustment &at, const LensMatrix &covariance, double radius);
double bearing_difference(const pf_camera &a, const pf_camera &b, const Eigen::Vector2d &centre, double radius);

} // namespace pipefish::selfcal
