// What may be a corner or a disc, anywhere in a picture, before anything is known about the target's place.
#pragma once

#include <Eigen/Dense>
#include <opencv2/core.hpp>

#include <vector>

namespace pipefish::detect
{

struct Corner {
    Eigen::Vector2d at;      // pixels
    Eigen::Vector2d edge[2]; // unit directions; from edge[0] counter-clockwise on the screen (x right, y down: from x
                             // to y) to edge[1] it is dark
    double strength = 0.0;   // grey levels between light and dark
};

// Places where four sectors, dark and light by turns, meet. scale: 1, or 2, 4 to look at the picture made so much
// smaller (blurred, large or noisy squares).
std::vector<Corner> find_corners(const cv::Mat &image, int scale);

struct Blob {
    Eigen::Vector2d at;        // pixels
    Eigen::Matrix2d half_axes; // columns: of the ellipse with the blob's second moments
    double contrast = 0.0;     // grey levels
};

// Dark ellipses on light ground, at least about five pixels long.
std::vector<Blob> find_blobs(const cv::Mat &image);

} // namespace pipefish::detect
