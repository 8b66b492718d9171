// Sparse symmetric positive systems over the points of a grid, two unknowns a point.
#pragma once

#include <Eigen/Core>

#include <cstddef>
#include <memory>
#include <vector>

namespace pipefish::segment
{

// Where the Cholesky factor of such a system has entries, by nested dissection. Points up to `reach` columns and rows
// apart share entries.
class Pattern
{
public:
    Pattern(int nx, int ny, int reach);

private:
    friend class System;
    friend class Factor;
    struct Near {
        int place; // of an earlier point
        size_t block;
    };
    void divide(int left, int top, int right, int bottom); // orders the points of a rectangle
    void factorise();

    int nx_, ny_, reach_;
    std::vector<size_t> order_;           // the points, in the order of elimination; a point's place is in it
    std::vector<std::vector<Near>> near_; // [place]
    std::vector<size_t> column_, row_;    // where each place's begin, and where the last ends
    std::vector<int> in_column_, in_row_; // places below, and left of, the diagonal, ascending
};

class Factor;

// A sum of quadratic costs 1/2 v'Av - b'v.
class System
{
public:
    explicit System(std::shared_ptr<const Pattern> pattern);

    // Adds the symmetric block (xx, xy; xy, yy) of a point and the one dx columns and dy rows on (dy > 0, or dy == 0
    // and dx >= 0), both ways.
    void add(size_t point, int dx, int dy, double xx, double xy, double yy)
    {
        double *to = &block_[3 * (point * slots_ + static_cast<size_t>(dy * width_ + dx + width_ / 2))];
        to[0] += xx, to[1] += xy, to[2] += yy;
    }
    Eigen::VectorXd &right() { return right_; } // b: x and y of point 0, of point 1, ...

    // Where the sum is least. Throws std::runtime_error where it has no minimum.
    Eigen::VectorXd solve() const;
    // The same by conjugate gradients from the factor of a similar system of the same pattern, which is replaced where
    // it does not serve, or is none: until the residual, measured by that system, is a hundredth.
    Eigen::VectorXd solve(std::shared_ptr<const Factor> &similar) const;

private:
    friend class Factor;
    Eigen::VectorXd times(const Eigen::VectorXd &v) const; // A v

    std::shared_ptr<const Pattern> pattern_;
    int width_; // of a point's rows of slots
    size_t slots_;
    std::vector<double> block_; // [point][slot]: xx, xy, yy
    Eigen::VectorXd right_;
};

// A = L D L', with blocks for entries: D's are symmetric, L's diagonal is one.
class Factor
{
public:
    explicit Factor(const System &system);
    const std::shared_ptr<const Pattern> &pattern() const { return pattern_; }
    Eigen::VectorXd solve(const Eigen::VectorXd &right) const;

private:
    using Double2 = double __attribute__((vector_size(16)));
    struct Block { // 2 x 2
        Double2 row[2] = {{0, 0}, {0, 0}};
    };

    std::shared_ptr<const Pattern> pattern_;
    std::vector<Block> below_, inverse_; // L's in the pattern's columns, D's inverse
};

} // namespace pipefish::segment
