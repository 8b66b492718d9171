#include "segment/lattice.hpp"

#include <Eigen/SparseCholesky>

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace pipefish::segment
{

Lattice::Lattice(const cv::Rect &rectangle, double h)
    : box(rectangle), spacing(h), nx(static_cast<int>((rectangle.width - 1) / h) + 4),
      ny(static_cast<int>((rectangle.height - 1) / h) + 4)
{
    if (rectangle.empty())
        throw std::invalid_argument("a field over no pixels: no match is within the picture");
}

Vector2d Lattice::place(size_t point) const
{
    const auto columns = static_cast<size_t>(nx);
    return {box.x + (static_cast<double>(point % columns) - 1) * spacing,
            box.y + (static_cast<double>(point / columns) - 1) * spacing};
}

bool Lattice::holds(double x, double y) const
{
    return x >= box.x && y >= box.y && x <= box.x + box.width - 1 && y <= box.y + box.height - 1;
}

Lattice::Spot Lattice::at(double x, double y) const
{
    Spot out;
    const auto along = [&](double place, int from, int length, std::array<double, 4> &w, std::array<double, 4> &slope) {
        const double u = std::clamp(place - from, 0.0, length - 1.0) / spacing;
        const double cell = std::floor(u), t = u - cell, s = 1 - t;
        w = {s * s * s / 6, 2.0 / 3 - t * t * (1 - t / 2), 2.0 / 3 - s * s * (1 - s / 2), t * t * t / 6};
        slope = {-s * s / 2, t * (1.5 * t - 2), -s * (1.5 * s - 2), t * t / 2};
        for (double &v : slope)
            v /= spacing;
        return static_cast<size_t>(cell);
    };
    const size_t i = along(x, box.x, box.width, out.wx, out.dx), j = along(y, box.y, box.height, out.wy, out.dy);
    out.first = j * static_cast<size_t>(nx) + i;
    return out;
}

Vector2d Warp::to(double x, double y) const
{
    const Lattice::Spot s = lattice.at(x, y);
    Vector2d out(x, y);
    for (size_t j = 0; j < 4; j++)
        for (size_t i = 0; i < 4; i++)
            out += s.wx[i] * s.wy[j] *
                   d.segment<2>(static_cast<Eigen::Index>(2 * (s.first + j * static_cast<size_t>(lattice.nx) + i)));
    return out;
}

Matrix2d Warp::slope(double x, double y) const
{
    const Lattice::Spot s = lattice.at(x, y);
    Matrix2d out = Matrix2d::Identity();
    for (size_t j = 0; j < 4; j++)
        for (size_t i = 0; i < 4; i++) {
            const Vector2d v =
                d.segment<2>(static_cast<Eigen::Index>(2 * (s.first + j * static_cast<size_t>(lattice.nx) + i)));
            out.col(0) += s.dx[i] * s.wy[j] * v;
            out.col(1) += s.wx[i] * s.dy[j] * v;
        }
    return out;
}

Warp finer(const Warp &warp)
{
    const Lattice &old = warp.lattice;
    Warp out{Lattice(old.box, old.spacing / 2), {}};
    const Lattice &grid = out.lattice;
    out.d.resize(static_cast<Eigen::Index>(2 * grid.points()));
    // Every other point of the new grid is one of the old, whose neighbours have a share; the others are half way.
    struct Share {
        int first;
        std::array<double, 3> w;
    };
    const auto shares = [](int k) {
        return k % 2 == 0 ? Share{k / 2, {0.5, 0.5, 0}} : Share{(k - 1) / 2, {0.125, 0.75, 0.125}};
    };
    for (int j = 0; j < grid.ny; j++)
        for (int i = 0; i < grid.nx; i++) {
            const Share across = shares(i), down = shares(j);
            Vector2d v = Vector2d::Zero();
            for (int b = 0; b < 3; b++)
                for (int a = 0; a < 3; a++)
                    if (const double w = across.w[static_cast<size_t>(a)] * down.w[static_cast<size_t>(b)]; w > 0)
                        v += w * warp.d.segment<2>(2 * ((down.first + b) * old.nx + across.first + a));
            out.d.segment<2>(2 * (j * grid.nx + i)) = v;
        }
    return out;
}

Normal::Normal(const Lattice &lattice)
    : lattice_(lattice), block_(lattice.points()),
      right_(Eigen::VectorXd::Zero(static_cast<Eigen::Index>(2 * lattice.points())))
{
    for (auto &b : block_)
        b.fill(0);
}

void Normal::add(const Lattice::Spot &at, const Matrix2d &q, const Vector2d &b)
{
    std::array<double, 16> w;
    for (size_t k = 0; k < 16; k++)
        w[k] = at.wx[k % 4] * at.wy[k / 4];
    const double xx = q(0, 0), xy = q(0, 1), yy = q(1, 1);
    for (size_t k = 0; k < 16; k++) {
        const size_t point = at.first + (k / 4) * static_cast<size_t>(lattice_.nx) + k % 4;
        right_[static_cast<Eigen::Index>(2 * point)] += w[k] * b.x();
        right_[static_cast<Eigen::Index>(2 * point) + 1] += w[k] * b.y();
        auto &block = block_[point];
        for (size_t m = k; m < 16; m++) {
            const size_t rows = m / 4 - k / 4;
            const size_t slot = rows == 0 ? m - k : 7 * rows + m % 4 - k % 4;
            const double v = w[k] * w[m];
            block[3 * slot] += v * xx;
            block[3 * slot + 1] += v * xy;
            block[3 * slot + 2] += v * yy;
        }
    }
}

void Normal::bend(const Eigen::SparseMatrix<double> &k, double weight, const Eigen::VectorXd &d)
{
    for (Eigen::Index column = 0; column < k.outerSize(); column++)
        for (Eigen::SparseMatrix<double>::InnerIterator e(k, column); e; ++e)
            for (Eigen::Index c = 0; c < 2; c++) {
                right_[2 * e.row() + c] -= weight * e.value() * d[2 * e.col() + c];
                if (e.row() >= e.col())
                    extra_.emplace_back(2 * e.row() + c, 2 * e.col() + c, weight * e.value());
            }
}

Eigen::VectorXd Normal::solve() const
{
    std::vector<Eigen::Triplet<double>> entries = extra_;
    const auto columns = static_cast<size_t>(lattice_.nx);
    for (size_t p = 0; p < block_.size(); p++) {
        entries.emplace_back(2 * p, 2 * p, 1e-6); // where nothing holds a point
        entries.emplace_back(2 * p + 1, 2 * p + 1, 1e-6);
        for (size_t slot = 0; slot < kSlots; slot++) {
            const double *v = &block_[p][3 * slot];
            if (v[0] == 0 && v[2] == 0)
                continue;
            const size_t rows = slot < 4 ? 0 : (slot + 3) / 7;
            const size_t q = p + rows * columns + slot - 7 * rows;
            entries.emplace_back(2 * q, 2 * p, v[0]);
            entries.emplace_back(2 * q + 1, 2 * p, v[1]);
            entries.emplace_back(2 * q + 1, 2 * p + 1, v[2]);
            if (q != p)
                entries.emplace_back(2 * q, 2 * p + 1, v[1]);
        }
    }
    Eigen::SparseMatrix<double> matrix(right_.size(), right_.size());
    matrix.setFromTriplets(entries.begin(), entries.end());
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> factor(matrix);
    if (factor.info() != Eigen::Success)
        throw std::runtime_error("the normal equations of a layer's field are not positive");
    return factor.solve(right_);
}

Eigen::SparseMatrix<double> bending(const Lattice &lattice)
{
    std::vector<Eigen::Triplet<double>> entries;
    const auto add = [&](std::initializer_list<std::pair<int, double>> difference, double weight) {
        for (const auto &[p, a] : difference)
            for (const auto &[q, b] : difference)
                entries.emplace_back(p, q, weight * a * b);
    };
    for (int j = 0; j < lattice.ny; j++)
        for (int i = 0; i < lattice.nx; i++) {
            const int p = j * lattice.nx + i, down = lattice.nx;
            if (i + 2 < lattice.nx)
                add({{p, 1}, {p + 1, -2}, {p + 2, 1}}, 1);
            if (j + 2 < lattice.ny)
                add({{p, 1}, {p + down, -2}, {p + 2 * down, 1}}, 1);
            if (i + 1 < lattice.nx && j + 1 < lattice.ny)
                add({{p, 1}, {p + 1, -1}, {p + down, -1}, {p + down + 1, 1}}, 2);
        }
    const auto n = static_cast<Eigen::Index>(lattice.points());
    Eigen::SparseMatrix<double> out(n, n);
    out.setFromTriplets(entries.begin(), entries.end());
    return out;
}

} // namespace pipefish::segment
