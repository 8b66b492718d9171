// One straight section: a robust fit of a circular or elliptical cylinder by geometric distance.
#pragma once

#include "tube/cloud.hpp"

#include <Eigen/Core>

#include <span>
#include <vector>

namespace pipefish::tube
{

enum class FitStatus {
    ok,
    circle_only,    // a gap in azimuth too wide for an ellipse
    one_sided,      // too wide for a circle too
    too_few_points, // inliers
    not_determined, // the normal matrix is singular
    no_cylinder,    // residuals as large as the radius
};

struct Cylinder {
    Eigen::Vector3d centre = Eigen::Vector3d::Zero(); // on the axis, at the points' mean abscissa
    Eigen::Vector3d axis = Eigen::Vector3d::UnitZ();
    Eigen::Matrix<double, 3, 2> basis = Eigen::Matrix<double, 3, 2>::Zero(); // across the axis; first x second = axis
    double rho = 0.0, ec = 0.0, es = 0.0;
    // Of centre along the basis (2), axis along the basis (2, radians), rho, ec, es; zero rows for what is not fitted.
    Eigen::Matrix<double, 7, 7> covariance = Eigen::Matrix<double, 7, 7>::Zero();
    double roughness = 0.0; // metres
    double gap = 0.0;       // widest sector without inliers, radians
    int inliers = 0;
    FitStatus status = FitStatus::no_cylinder;
};

struct CylinderOptions {
    bool ellipse = true;
    double cone = 0.0;       // search for the axis so far around the start's, radians; 0: the start is near
    double tolerance = 0.04; // of the search, relative to the radius
    int min_inliers = 60;
    double max_gap_ellipse = 150.0 / 57.29577951308232, max_gap_circle = 220.0 / 57.29577951308232; // radians
};

// Fits to the points `index` of the cloud. The start's axis, centre and rho (0: unknown) are where it begins.
Cylinder fit_cylinder(const Cloud &cloud, std::span<const int> index, const Cylinder &start,
                      const CylinderOptions &options);

// Two unit vectors across `axis`, the first as near as possible to `near`.
Eigen::Matrix<double, 3, 2> basis_across(const Eigen::Vector3d &axis, const Eigen::Vector3d &near);

constexpr int AZIMUTH_BINS = 60;

// The bin of an angle of atan2, radians.
size_t azimuth_bin(double angle);

// Widest sector without points, in steps of 6 degrees; `count[k]`: points in bin k of AZIMUTH_BINS. Bins with less than
// a tenth of the mean count as empty.
double widest_gap(std::span<const int> count);

} // namespace pipefish::tube
