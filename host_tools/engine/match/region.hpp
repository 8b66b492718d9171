// Affine-covariant regions of an image, and their descriptors: what seeds are made of.
#pragma once

#include "match/image.hpp"

#include <vector>

namespace pipefish::match
{

// An ellipse: `shape` maps the unit circle to it (symmetric times a rotation by the dominant gradient).
struct Region {
    Eigen::Vector2d at;
    Eigen::Matrix2d shape;
};

struct RegionOptions {
    int most = 3000;      // of SIFT's, as many of the Hessian's, half as many extremal ones; strongest first
    bool adapt = true;    // shapes adapted to the surroundings (Lindeberg's iteration), else circles
    bool hessian = false; // blobs of the Hessian's determinant too
    bool extremal = true; // maximally stable extremal regions too
    int threads = 1;
};

constexpr int kDescriptor = 128;

struct Described {
    std::vector<Region> regions; // a region once for each of its orientations
    Eigen::MatrixXf descriptors; // one column a region, of unit norm
};

// Regions for description: about 3 times as large as what was detected.
Described describe_regions(const ScaleStack &image, const RegionOptions &options);

} // namespace pipefish::match
