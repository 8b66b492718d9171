// Patches of two images in one frame: sampled through a local affine map, and compared.
#pragma once

#include "match/image.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>
#include <limits>

namespace pipefish::match
{

// Around x in image 1 and centre in image 2, x + v corresponds to centre + a v.
struct Local {
    Eigen::Vector2f centre;
    Eigen::Matrix2f a;
    float zncc = -1; // of the patch, sampled by spline()
};

// How far apart samples are: `step` pixels in image 1 where image 1 is the finer one, else 1; levels to match.
struct Sampling {
    int step;
    const Image *first, *second, *spline; // spline: of second
};
Sampling sampling_for(const ScaleStack &first, const ScaleStack &second, const Eigen::Matrix2f &a);

constexpr int kPatchMost = 10; // largest radius of a patch, in samples

constexpr int kPatchWide = 2 * kPatchMost + 4; // a row of a patch with its rim, in whole Float4s from index 0

// (2 r + 3)^2 samples: row and column 0 are the rim at -(r + 1). Four zeros end each row.
struct Patch {
    alignas(16) float v[2 * kPatchMost + 3][kPatchWide + 4];
};
void sample_first(const Sampling &s, int x, int y, int r, Patch &out);
void sample_second(const Sampling &s, const Local &at, int r, Patch &out, int rim = 1); // rim 0: not the rim
// Whether both may be sampled.
bool fits(const Sampling &s, int x, int y, int r, const Local &at);

// Mean and deviation of the inner (2 r + 1)^2 samples, and the correlation of two patches.
struct Level {
    float mean, sigma;
};
Level level_of(const Patch &p, int r);
float correlate(const Patch &p, Level lp, const Patch &q, Level lq, int r);

// Both patches of a match in one frame.
struct Pair {
    Sampling s;
    Patch p, q;
    Level lp, lq;
};
// Samples both and sets local.zncc over (2 r + 1)^2 of them; false where a patch leaves its image or is flatter than
// sigma_min.
bool compare(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, Local &local,
             Pair &out);
// The same where only the correlation matters.
bool measure(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, Local &local);

// Ratio of the singular values of a map, 1 or more; infinite for a singular one.
template <typename T> T aspect(const Eigen::Matrix<T, 2, 2> &a)
{
    const T sum = a.squaredNorm(), det = std::abs(a.determinant()); // of their squares, and their product
    const T both = std::sqrt(std::max(T(0), sum * sum - 4 * det * det));
    return sum - both > 0 ? std::sqrt((sum + both) / (sum - both)) : std::numeric_limits<T>::infinity();
}

// Bounds on what a map may be: shape (ratio of singular values) at most 6, scale 1/6 to 6.
bool sane(const Eigen::Matrix2f &a);

} // namespace pipefish::match
