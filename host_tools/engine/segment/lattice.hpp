// Smooth fields over a rectangle of an image: values at the points of a regular grid, cubic B-splines between them.
#pragma once

#include "segment/system.hpp"

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include <array>
#include <vector>

namespace pipefish::segment
{

using Eigen::Matrix2d;
using Eigen::Vector2d;

struct Lattice {
    cv::Rect box; // pixels; fields are defined from its first pixel's centre to its last
    double spacing = 16;
    int nx = 0, ny = 0; // grid points, one spacing beyond the box and more

    Lattice() = default;
    Lattice(const cv::Rect &rectangle, double h);
    size_t points() const { return static_cast<size_t>(nx) * static_cast<size_t>(ny); }
    Vector2d place(size_t point) const; // pixels

    // Of a place, clamped into the box: the first of 4 x 4 grid points and their weights along x and y, with the
    // weights' derivatives per pixel.
    struct Spot {
        size_t first;
        std::array<double, 4> wx, wy, dx, dy;
    };
    Spot at(double x, double y) const;
    bool holds(double x, double y) const;
};

// A displacement field: two values a grid point.
struct Warp {
    Lattice lattice;
    Eigen::VectorXd d; // x and y of point 0, of point 1, ...

    Vector2d to(double x, double y) const; // place + displacement
    Matrix2d slope(double x, double y) const;
};

// The same field on a grid of half the spacing.
Warp finer(const Warp &warp);

// Normal equations of a change of a Warp: sums of quadratic costs, sparse because a spline is local.
class Normal
{
public:
    // `similar`: a factor of such equations over the lattice, or none.
    Normal(const Lattice &lattice, const std::shared_ptr<const Factor> &similar);

    // Adds 1/2 v'Qv - b'v, with v the change of the displacement at a place; Q is symmetric.
    void add(const Lattice::Spot &at, const Matrix2d &q, const Vector2d &b);
    // Adds weight times the bending of the warp with its change.
    void bend(const Warp &warp, double weight);
    // The change of least cost, to a thousandth of it. `similar` is brought up to date where it does not serve.
    Eigen::VectorXd solve(std::shared_ptr<const Factor> &similar);

private:
    void flush();

    const Lattice &lattice_;
    System system_;
    // Sums over places along a row of a cell: of Q times the product of two weights along x, of b times each.
    size_t first_ = 0;
    std::array<double, 4> wy_ = {0, 0, 0, 0};
    std::array<Eigen::Array3d, 10> sum_;
    std::array<Vector2d, 4> pull_;
    bool any_ = false;
};

// Half the sum of squared second differences, of both components.
double bending(const Warp &warp);

} // namespace pipefish::segment
