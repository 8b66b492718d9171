#include "conics.hpp"

#include "linalg/linalg.hpp"

#include <cmath>
#include <stdexcept>

namespace pipefish::conics
{

Eigen::Matrix3d fit_ellipse(const std::vector<Eigen::Vector2d> &points)
{
    if (points.size() < 5)
        throw std::invalid_argument("an ellipse needs at least 5 points");
    const double n = static_cast<double>(points.size());
    Eigen::Vector2d mean = Eigen::Vector2d::Zero();
    for (const auto &p : points)
        mean += p / n;
    double size = 0.0;
    for (const auto &p : points)
        size += (p - mean).norm() / n;
    if (!(size > 0) || !std::isfinite(size))
        throw std::invalid_argument("the points of an ellipse must be finite and not all the same");
    // Scatter of the quadratic part, with the linear part eliminated; the constraint 4 a c - b^2 = 1.
    Eigen::Matrix3d s1 = Eigen::Matrix3d::Zero(), s2 = s1, s3 = s1;
    for (const auto &p : points) {
        const Eigen::Vector2d q = (p - mean) / size;
        const Eigen::Vector3d quadratic(q.x() * q.x(), q.x() * q.y(), q.y() * q.y()), linear(q.x(), q.y(), 1.0);
        s1 += quadratic * quadratic.transpose();
        s2 += quadratic * linear.transpose();
        s3 += linear * linear.transpose();
    }
    const Eigen::Matrix3d t = -s3.ldlt().solve(s2.transpose());
    const Eigen::Matrix3d m = s1 + s2 * t;
    Eigen::Matrix3d reduced;
    reduced << m.row(2) / 2, -m.row(1), m.row(0) / 2;
    const linalg::GeneralEigen eigen = linalg::general_eigen(reduced);
    for (int k = 0; k < 3; k++) {
        const Eigen::Vector3d a = eigen.vectors.col(k).real();
        if (4 * a[0] * a[2] - a[1] * a[1] <= 0)
            continue;
        const Eigen::Vector3d b = t * a;
        Eigen::Matrix3d c;
        c << a[0], a[1] / 2, b[0] / 2, a[1] / 2, a[2], b[1] / 2, b[0] / 2, b[1] / 2, b[2];
        if (a[0] < 0)
            c = -c;
        Eigen::Matrix3d normal;
        normal << 1 / size, 0, -mean.x() / size, 0, 1 / size, -mean.y() / size, 0, 0, 1;
        return normal.transpose() * c * normal;
    }
    throw std::invalid_argument("the points lie on no ellipse");
}

bool is_ellipse(const Eigen::Matrix3d &conic, Eigen::Vector2d *middle)
{
    const Eigen::Matrix2d a = conic.topLeftCorner<2, 2>();
    if (!(a.determinant() > 0))
        return false;
    const Eigen::Vector2d m = -a.ldlt().solve(conic.topRightCorner<2, 1>());
    if (middle)
        *middle = m;
    // Real when the middle has the other sign than the quadratic part.
    return (conic(2, 2) + conic.topRightCorner<2, 1>().dot(m)) * a.trace() < 0;
}

std::vector<Eigen::Vector2d> ellipse_points(const Eigen::Matrix3d &conic, int count)
{
    Eigen::Vector2d middle;
    if (!is_ellipse(conic, &middle))
        throw std::invalid_argument("not a real ellipse");
    const double level = -(conic(2, 2) + conic.topRightCorner<2, 1>().dot(middle));
    const Eigen::Matrix2d shape = conic.topLeftCorner<2, 2>() / level;
    const linalg::SymmetricEigen<2> eigen = linalg::symmetric_eigen<2>(shape);
    std::vector<Eigen::Vector2d> points;
    for (int k = 0; k < count; k++) {
        const double angle = 2 * M_PI * k / count;
        const Eigen::Vector2d unit(std::cos(angle), std::sin(angle));
        points.emplace_back(middle + eigen.vectors * unit.cwiseQuotient(eigen.values.cwiseSqrt()));
    }
    return points;
}

} // namespace pipefish::conics
