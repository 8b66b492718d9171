// Smooth fields over a rectangle of an image: values at the points of a regular grid, cubic B-splines between them.
#pragma once

#include <Eigen/Core>
#include <Eigen/SparseCore>
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
    explicit Normal(const Lattice &lattice);

    // Adds 1/2 v'Qv - b'v, with v the change of the displacement at a place; Q is symmetric.
    void add(const Lattice::Spot &at, const Matrix2d &q, const Vector2d &b);
    // Adds weight/2 (d + change)' K (d + change) for both components.
    void bend(const Eigen::SparseMatrix<double> &k, double weight, const Eigen::VectorXd &d);
    // The change of least cost.
    Eigen::VectorXd solve() const;

private:
    static constexpr size_t kSlots = 25; // offsets (0..3, 0) and (-3..3, 1..3)
    const Lattice &lattice_;
    std::vector<std::array<double, 3 * kSlots>> block_; // [point][slot]: xx, xy, yy
    Eigen::VectorXd right_;
    std::vector<Eigen::Triplet<double>> extra_;
};

// The matrix K of sum of squared second differences: d'Kd, for one component.
Eigen::SparseMatrix<double> bending(const Lattice &lattice);

} // namespace pipefish::segment
