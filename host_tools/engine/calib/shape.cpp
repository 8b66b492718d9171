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
    // One row of the basis is not zero for each coefficient but the first: no matrix unless it is asked for.
    if (d) {
        d->setZero();
    }
    Eigen::Vector3d point = drawn;
    const auto add = [&](int row, int term, double value) {
        point[row] += coefficient[static_cast<size_t>(term)] * value;
        if (d) {
            (*d)(row, term) = value;
        }
    };
    add(0, 0, 0.5 * half * s);
    add(1, 0, -0.5 * half * t);
    add(0, 1, half * t);
    int height = kShapeHeight, plane = kShapeInPlane;
    for (size_t degree = 2; degree <= 6; degree++) {
        for (size_t i = 0; i <= degree; i++) {
            const double value = half * p[degree - i] * q[i];
            add(2, height++, value);
            if (degree <= 3) {
                add(0, plane, value);
                add(1, plane + 7, value);
                plane++;
            }
        }
    }
    return point;
}

} // namespace pipefish::calib
