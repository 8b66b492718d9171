#include "calib/shape.hpp"

namespace pipefish::calib
{

namespace
{

std::array<double, 7> legendre(double x)
{
    std::array<double, 7> p{1.0, x};
    for (size_t n = 2; n < p.size(); n++) {
        const double k = static_cast<double>(n);
        p[n] = ((2.0 * k - 1.0) * x * p[n - 1] - (k - 1.0) * p[n - 2]) / k;
    }
    return p;
}

} // namespace

Eigen::Vector3d Shape::at(const Eigen::Vector3d &drawn, Eigen::Matrix<double, 3, kShape> *d) const
{
    if (!d && flat()) {
        return drawn;
    }
    const double s = (drawn.x() - centre_x) / half, t = (drawn.y() - centre_y) / half;
    const std::array<double, 7> p = legendre(s), q = legendre(t);
    Eigen::Matrix<double, 3, kShape> basis = Eigen::Matrix<double, 3, kShape>::Zero();
    basis(0, 0) = 0.5 * half * s;
    basis(1, 0) = -0.5 * half * t;
    basis(0, 1) = half * t;
    int height = kShapeHeight, plane = kShapeInPlane;
    for (size_t degree = 2; degree <= 6; degree++) {
        for (size_t i = 0; i <= degree; i++) {
            const double value = half * p[degree - i] * q[i];
            basis(2, height++) = value;
            if (degree <= 3) {
                basis(0, plane) = value;
                basis(1, plane + 7) = value;
                plane++;
            }
        }
    }
    Eigen::Vector3d point = drawn;
    for (int i = 0; i < kShape; i++) {
        point += coefficient[static_cast<size_t>(i)] * basis.col(i);
    }
    if (d) {
        *d = basis;
    }
    return point;
}

} // namespace pipefish::calib
