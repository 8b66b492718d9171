// A printed disc, measured: the centroid of its grey levels, and its outline.
#pragma once

#include <Eigen/Dense>
#include <opencv2/core.hpp>

#include <vector>

namespace pipefish::detect
{

struct DiscSetup {
    Eigen::Matrix2d half_axes; // pixels: where the sheet's x and y take the disc's radius
    double free = 1.5;         // radii around its middle in which there is nothing else
};

struct Disc {
    bool found = false;
    Eigen::Vector2d at = Eigen::Vector2d::Zero();         // pixels: centroid of the area
    Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero(); // pixels^2
    double contrast = 0.0;                                // from dark to light, grey levels
    double area = 0.0;                                    // pixels
    bool hole = false;                                    // light in the middle
    // The light around it, grey levels: a plane over the offset from light_from. The dark within, where the light is
    // light[0].
    Eigen::Vector3d light = Eigen::Vector3d::Zero();
    double dark = 0.0;
    Eigen::Vector2d light_from = Eigen::Vector2d::Zero();
};

// The centroid of the dark disc near `start`: of the pixels at least half covered and two more around, whatever its
// shape. Each counts by the share of it that is covered: its grey level between the light around the disc (a plane
// fitted to the clear ground) and the dark within (the median); so a gradient of light moves nothing, and the centroid
// is that of the area, as calibration projects it. Not found: no ellipse of about this size and shape within 0.6 radii
// of the start, or the picture's edge cuts it.
Disc measure_disc(const cv::Mat &image, const Eigen::Vector2d &start, const DiscSetup &setup);

// Points on the outline of a disc that was found, pixels, evenly around: where the grey level is half between dark and
// light. Fewer than `count` where it has no such crossing.
std::vector<Eigen::Vector2d> disc_outline(const cv::Mat &image, const Disc &disc, const DiscSetup &setup, int count);

// Grey level between pixels, bilinear; the edge's beyond the edge.
double grey_at(const cv::Mat &image, double x, double y);

} // namespace pipefish::detect
