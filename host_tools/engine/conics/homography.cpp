#include "conics.hpp"

#include "linalg/linalg.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <complex>
#include <stdexcept>
#include <string>

namespace pipefish::conics
{
namespace
{

using Eigen::Matrix3cd;
using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector3d;

// A similarity that brings the ellipses' centres and sizes near to the unit disc; the identity where they are no
// ellipses (cones of rays are normalised as they are).
Matrix3d normaliser(const Conics &conics)
{
    Vector2d low(INFINITY, INFINITY), high = -low;
    for (const Matrix3d &c : conics) {
        if (!is_ellipse(c))
            return Matrix3d::Identity();
        for (const Vector2d &p : ellipse_points(c, 8)) {
            low = low.cwiseMin(p);
            high = high.cwiseMax(p);
        }
    }
    const Vector2d middle = 0.5 * (low + high);
    const double size = std::max(0.5 * (high - low).maxCoeff(), 1e-300);
    Matrix3d t;
    t << 1 / size, 0, -middle.x() / size, 0, 1 / size, -middle.y() / size, 0, 0, 1;
    return t;
}

// In the coordinates that t gives, with determinant 1 or -1.
Conics normalised(const Conics &conics, const Matrix3d &t, const char *which)
{
    const Matrix3d back = t.inverse();
    Conics out;
    for (size_t k = 0; k < conics.size(); k++) {
        const Matrix3d c = back.transpose() * conics[k] * back;
        const Matrix3d unit = c / c.norm();
        const double det = unit.determinant();
        if (!unit.allFinite() || std::abs(det) < 1e-14)
            throw std::invalid_argument(std::string(which) + ": conic " + std::to_string(k) +
                                        " is degenerate (a point, a line, a pair of lines, or not finite)");
        out.push_back(unit / std::cbrt(det)); // det = 1: the cube root keeps the sign
    }
    return out;
}

Matrix3d with_unit_determinant(const Matrix3d &h)
{
    const double det = h.determinant();
    if (!h.allFinite() || std::abs(det) < 1e-12 * std::pow(h.norm(), 3))
        throw std::invalid_argument("the conics do not determine a homography (what they leave is singular)");
    return h / std::cbrt(det);
}

// H A = A' H for every pair, A = C_i^-1 C_j: linear in H.
Matrix3d linear(const Conics &from, const Conics &to)
{
    Eigen::Matrix<double, 9, 9> normal = Eigen::Matrix<double, 9, 9>::Zero();
    for (size_t i = 0; i < from.size(); i++)
        for (size_t j = 0; j < from.size(); j++) {
            if (i == j)
                continue;
            const Matrix3d a = from[i].inverse() * from[j], b = to[i].inverse() * to[j];
            const double weight = 1.0 / (a.norm() * b.norm());
            Eigen::Matrix<double, 9, 9> rows = Eigen::Matrix<double, 9, 9>::Zero();
            for (int r = 0; r < 3; r++)
                for (int c = 0; c < 3; c++)
                    for (int k = 0; k < 3; k++) {
                        rows(3 * r + c, 3 * r + k) += a(k, c);
                        rows(3 * r + c, 3 * k + c) -= b(r, k);
                    }
            normal += weight * rows.transpose() * rows;
        }
    const linalg::SymmetricEigen<9> eigen = linalg::symmetric_eigen<9>(normal);
    // A second vanishing direction: all conics in one pencil, or alike under a family of maps.
    if (eigen.values[1] < 1e-12 * eigen.values[8])
        throw std::invalid_argument("the conics leave a family of homographies (such as concentric circles do)");
    const Eigen::Matrix<double, 9, 1> h = eigen.vectors.col(0);
    Matrix3d out;
    out << h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8];
    return with_unit_determinant(out);
}

// Distances of mapped points to their conics, to first order.
Eigen::VectorXd distances(const Matrix3d &h, const std::vector<std::vector<Vector2d>> &points, const Conics &to)
{
    Eigen::VectorXd e(static_cast<Eigen::Index>(points.size() * points[0].size()));
    Eigen::Index row = 0;
    for (size_t k = 0; k < points.size(); k++)
        for (const Vector2d &p : points[k]) {
            const Vector3d x = h * p.homogeneous(), line = to[k] * x;
            const double steep = std::max(line.head<2>().norm(), 1e-12 * to[k].norm() * x.norm());
            e[row++] = x.dot(line) / (2 * x.z() * steep);
        }
    return e;
}

// Levenberg-Marquardt over the nine entries, the scale held by the damping; derivatives by central differences, whose
// error (1e-10) only slows the last step.
Matrix3d refined(Matrix3d h, const Conics &from, const Conics &to)
{
    std::vector<std::vector<Vector2d>> points;
    for (size_t k = 0; k < from.size(); k++) {
        if (!is_ellipse(from[k]) || !is_ellipse(to[k]))
            return h;
        points.push_back(ellipse_points(from[k], 16));
    }
    double damping = 1e-3;
    Eigen::VectorXd e = distances(h, points, to);
    for (int round = 0; round < 50; round++) {
        Eigen::MatrixXd j(e.size(), 9);
        const double step = 1e-6 * h.norm();
        for (int k = 0; k < 9; k++) {
            Matrix3d before = h, after = h;
            before(k / 3, k % 3) -= step;
            after(k / 3, k % 3) += step;
            j.col(k) = (distances(after, points, to) - distances(before, points, to)) / (2 * step);
        }
        const Eigen::Matrix<double, 9, 9> normal = j.transpose() * j;
        const Eigen::Matrix<double, 9, 1> right = -j.transpose() * e;
        bool moved = false;
        for (; damping < 1e8 && !moved; damping *= moved ? 0.1 : 10.0) {
            Eigen::Matrix<double, 9, 9> damped = normal;
            damped.diagonal().array() += damping * (normal.trace() / 9 + 1e-300);
            const Eigen::Matrix<double, 9, 1> change = damped.ldlt().solve(right);
            Matrix3d next = h;
            for (int k = 0; k < 9; k++)
                next(k / 3, k % 3) += change[k];
            if (!next.allFinite() || !(next.determinant() > 0))
                continue;
            next /= std::cbrt(next.determinant());
            const Eigen::VectorXd then = distances(next, points, to);
            if (!(then.squaredNorm() <= e.squaredNorm()))
                continue;
            moved = true;
            const bool still = (next - h).norm() < 1e-13 * h.norm();
            h = next;
            e = then;
            if (still)
                return h;
        }
        if (!moved)
            break;
    }
    return h;
}

struct Pencil { // eigenvalues of C1^-1 C2, the real one first if only one is, else ascending; a complex pair: + i first
    std::array<std::complex<double>, 3> values;
    Matrix3cd vectors;
    bool real = true;
};

Pencil pencil(const Conics &c)
{
    const linalg::GeneralEigen eigen = linalg::general_eigen(c[0].inverse() * c[1]);
    std::array<int, 3> order = {0, 1, 2};
    const auto value = [&](int k) { return eigen.values[k]; };
    Pencil p;
    for (int k = 0; k < 3; k++)
        p.real = p.real && value(k).imag() == 0.0;
    std::sort(order.begin(), order.end(), [&](int a, int b) {
        return p.real ? value(a).real() < value(b).real()
                      : std::pair(value(a).imag() != 0, -value(a).imag()) <
                            std::pair(value(b).imag() != 0, -value(b).imag());
    });
    double size = 0.0, gap = INFINITY;
    for (int k = 0; k < 3; k++) {
        p.values[size_t(k)] = value(order[size_t(k)]);
        p.vectors.col(k) = eigen.vectors.col(order[size_t(k)]);
        size = std::max(size, std::abs(p.values[size_t(k)]));
    }
    for (size_t k = 0; k < 3; k++)
        gap = std::min(gap, std::abs(p.values[k] - p.values[(k + 1) % 3]));
    if (gap < 1e-7 * size)
        throw std::invalid_argument(
            "the two conics leave a family of homographies (repeated eigenvalue: concentric circles, touching conics)");
    return p;
}

std::vector<Matrix3d> from_two(const Conics &from, const Conics &to)
{
    const Pencil a = pencil(from), b = pencil(to);
    double off = 0.0;
    for (size_t k = 0; k < 3; k++)
        off = std::max(off, std::abs(a.values[k] - b.values[k]) / std::abs(a.values[k]));
    if (a.real != b.real || off > 0.05)
        throw std::invalid_argument("no homography maps these two conics: their projective invariants differ");
    Matrix3cd scale = Matrix3cd::Zero();
    for (int k = 0; k < 3; k++) {
        const std::complex<double> one =
            (a.vectors.col(k).transpose() * from[0].cast<std::complex<double>>() * a.vectors.col(k))(0);
        const std::complex<double> two =
            (b.vectors.col(k).transpose() * to[0].cast<std::complex<double>>() * b.vectors.col(k))(0);
        scale(k, k) = std::sqrt(one / two); // either root: all signs are tried
    }
    // A complex pair's vectors are conjugate, so its roots must be: two real homographies; else all signs: four.
    std::vector<Matrix3d> found;
    for (int signs = 0; signs < (a.real ? 4 : 2); signs++) {
        Matrix3cd d = scale;
        d(0, 0) *= signs & 1 ? -1 : 1;
        if (a.real)
            d(1, 1) *= signs & 2 ? -1 : 1;
        else
            d(2, 2) = std::conj(d(1, 1));
        const Matrix3cd h = b.vectors * d * a.vectors.inverse();
        if (h.imag().norm() < 1e-6 * h.real().norm())
            found.push_back(with_unit_determinant(h.real()));
    }
    if (found.empty())
        throw std::invalid_argument("no real homography maps these two conics");
    return found;
}

// How many conics keep their centre inside, and whether orientation holds there: larger is likelier.
int plausible(const Matrix3d &h, const Conics &from, const Conics &to)
{
    int score = 0;
    for (size_t k = 0; k < from.size(); k++) {
        Vector2d middle, other;
        if (!is_ellipse(from[k], &middle) || !is_ellipse(to[k], &other))
            continue;
        const Vector3d x = h * middle.homogeneous();
        const Vector2d p = x.hnormalized();
        const double inside = p.homogeneous().dot(to[k] * p.homogeneous());
        score += 2 * (inside * to[k].topLeftCorner<2, 2>().trace() < 0);
        score += x.z() > 0; // with det H = 1 this is the sign of the Jacobian
    }
    return score;
}

} // namespace

std::vector<Matrix3d> homography(const Conics &from, const Conics &to)
{
    if (from.size() != to.size() || from.size() < 2)
        throw std::invalid_argument("as many conics on both sides are needed, at least two");
    const Matrix3d t = normaliser(from), s = normaliser(to);
    const Conics a = normalised(from, t, "C"), b = normalised(to, s, "C_prime");
    const auto back = [&](const Matrix3d &h) { return with_unit_determinant(s.inverse() * h * t); };
    if (from.size() > 2)
        return {back(refined(linear(a, b), a, b))};
    std::vector<Matrix3d> found = from_two(a, b);
    std::stable_sort(found.begin(), found.end(),
                     [&](const Matrix3d &x, const Matrix3d &y) { return plausible(x, a, b) > plausible(y, a, b); });
    std::transform(found.begin(), found.end(), found.begin(), back);
    return found;
}

} // namespace pipefish::conics
