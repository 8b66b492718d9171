#include "segment/lattice.hpp"

#include <algorithm>
#include <cmath>
#include <span>
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
    const double scale = 1 / spacing;
    const auto along = [&](double place, int from, int length, std::array<double, 4> &w, std::array<double, 4> &slope) {
        const double u = std::clamp(place - from, 0.0, length - 1.0) * scale;
        const double cell = std::floor(u), t = u - cell, s = 1 - t;
        w = {s * s * s / 6, 2.0 / 3 - t * t * (1 - t / 2), 2.0 / 3 - s * s * (1 - s / 2), t * t * t / 6};
        slope = {-s * s / 2, t * (1.5 * t - 2), -s * (1.5 * s - 2), t * t / 2};
        for (double &v : slope)
            v *= scale;
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

namespace
{

// Calls body(weight, first, {{dx, dy, factor}, ...}) for each second difference: of points that far from the first.
struct Term {
    int dx, dy;
    double factor;
};

template <typename Body> void second_differences(const Lattice &lattice, const Body &body)
{
    constexpr Term across[] = {{0, 0, 1}, {1, 0, -2}, {2, 0, 1}}, down[] = {{0, 0, 1}, {0, 1, -2}, {0, 2, 1}};
    constexpr Term twist[] = {{0, 0, 1}, {1, 0, -1}, {0, 1, -1}, {1, 1, 1}};
    for (int j = 0; j < lattice.ny; j++)
        for (int i = 0; i < lattice.nx; i++) {
            const size_t p = static_cast<size_t>(j) * static_cast<size_t>(lattice.nx) + static_cast<size_t>(i);
            if (i + 2 < lattice.nx)
                body(1, p, std::span<const Term>(across));
            if (j + 2 < lattice.ny)
                body(1, p, std::span<const Term>(down));
            if (i + 1 < lattice.nx && j + 1 < lattice.ny)
                body(2, p, std::span<const Term>(twist));
        }
}

size_t point_of(const Lattice &lattice, size_t first, const Term &term)
{
    return first + static_cast<size_t>(term.dy * lattice.nx + term.dx);
}

Vector2d difference(const Warp &warp, size_t first, std::span<const Term> terms)
{
    Vector2d sum = Vector2d::Zero();
    for (const Term &t : terms)
        sum += t.factor * warp.d.segment<2>(static_cast<Eigen::Index>(2 * point_of(warp.lattice, first, t)));
    return sum;
}

} // namespace

Normal::Normal(const Lattice &lattice, const std::shared_ptr<const Factor> &similar)
    : lattice_(lattice),
      system_(similar ? similar->pattern() : std::make_shared<const Pattern>(lattice.nx, lattice.ny, 3))
{
    for (size_t p = 0; p < lattice.points(); p++)
        system_.add(p, 0, 0, 1e-6, 0, 1e-6); // where nothing holds a point
}

void Normal::add(const Lattice::Spot &at, const Matrix2d &q, const Vector2d &b)
{
    if (!any_ || at.first != first_ || at.wy != wy_) {
        flush();
        first_ = at.first, wy_ = at.wy, any_ = true;
        sum_.fill(Eigen::Array3d::Zero());
        pull_.fill(Vector2d::Zero());
    }
    const Eigen::Array3d entries(q(0, 0), q(0, 1), q(1, 1));
    for (size_t k = 0, pair = 0; k < 4; k++) {
        pull_[k] += at.wx[k] * b;
        for (size_t m = k; m < 4; m++, pair++)
            sum_[pair] += at.wx[k] * at.wx[m] * entries;
    }
}

void Normal::flush()
{
    if (!any_)
        return;
    constexpr size_t pair_of[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
    for (size_t k = 0; k < 16; k++) {
        const size_t i = k % 4, j = k / 4, point = first_ + j * static_cast<size_t>(lattice_.nx) + i;
        system_.right().segment<2>(static_cast<Eigen::Index>(2 * point)) += wy_[j] * pull_[i];
        for (size_t m = k; m < 16; m++) {
            const Eigen::Array3d v = wy_[j] * wy_[m / 4] * sum_[pair_of[i][m % 4]];
            system_.add(point, static_cast<int>(m % 4) - static_cast<int>(i), static_cast<int>(m / 4 - j), v[0], v[1],
                        v[2]);
        }
    }
    any_ = false;
}

Eigen::VectorXd Normal::solve(std::shared_ptr<const Factor> &similar)
{
    flush();
    return system_.solve(similar);
}

void Normal::bend(const Warp &warp, double weight)
{
    second_differences(lattice_, [&](double share, size_t first, std::span<const Term> terms) {
        const Vector2d pull = -weight * share * difference(warp, first, terms);
        for (size_t k = 0; k < terms.size(); k++) {
            const size_t p = point_of(lattice_, first, terms[k]);
            system_.right().segment<2>(static_cast<Eigen::Index>(2 * p)) += terms[k].factor * pull;
            for (size_t m = k; m < terms.size(); m++) {
                const double v = weight * share * terms[k].factor * terms[m].factor;
                system_.add(p, terms[m].dx - terms[k].dx, terms[m].dy - terms[k].dy, v, 0, v);
            }
        }
    });
}

double bending(const Warp &warp)
{
    double sum = 0;
    second_differences(warp.lattice, [&](double share, size_t first, std::span<const Term> terms) {
        sum += share / 2 * difference(warp, first, terms).squaredNorm();
    });
    return sum;
}

} // namespace pipefish::segment
