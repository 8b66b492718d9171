#include "tube/section.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace pipefish::tube
{

namespace
{

// For the ellipse with semi-axes a >= b and p >= 0: cosine and sine of the foot's parameter. The foot solves
// (r z0 / (s + r))^2 + (z1 / (s + 1))^2 = 1 for its largest root s > -1, with r = (a / b)^2 and z = (p0 / a, p1 / b)
// (D. Eberly, "Distance from a point to an ellipse", 2013, where bisection is proved to be safe).
std::pair<double, double> first_quadrant(double a, double b, double p0, double p1)
{
    const double z0 = p0 / a, z1 = p1 / b, r = (a / b) * (a / b);
    if (p1 <= 0.0) {
        // On the long axis between the centres of curvature the nearest points lie to both sides.
        const double reach = (a - b) * (a + b);
        if (a * p0 < reach) {
            const double c = a * p0 / reach;
            return {c, std::sqrt((1.0 - c) * (1.0 + c))};
        }
        return {1.0, 0.0};
    }
    double low = z1 - 1.0, high = std::max(low, std::hypot(r * z0, z1) - 1.0), s = low;
    for (int i = 0; i < 200; i++) {
        const double c = r * z0 / (s + r), d = z1 / (s + 1.0);
        const double value = (c - 1.0) * (c + 1.0) + d * d;
        (value >= 0.0 ? low : high) = s;
        // Convex and falling: Newton from the left never overshoots; it is slow only near the pole, where halving
        // helps.
        const double slope = -2.0 * (c * c / (s + r) + d * d / (s + 1.0));
        double next = value >= 0.0 ? s - value / slope : 0.5 * (low + high);
        if (!(next > low && next < high) || (i % 8) == 7) {
            next = 0.5 * (low + high);
        }
        if (next == s || next == low || next == high || value == 0.0) {
            break;
        }
        s = next;
    }
    const double c = r * z0 / (s + r), d = z1 / (s + 1.0), norm = std::hypot(c, d);
    return {c / norm, d / norm};
}

} // namespace

Foot ellipse_foot(double rho, double ec, double es, const Eigen::Vector2d &y)
{
    const double e = std::hypot(ec, es), a = rho + e, b = rho - e;
    const double psi = e > 0.0 ? 0.5 * std::atan2(es, ec) : 0.0, cp = std::cos(psi), sp = std::sin(psi);
    const double q0 = cp * y[0] + sp * y[1], q1 = -sp * y[0] + cp * y[1];
    double c, s;
    if (e > 1e-14 * rho) {
        std::tie(c, s) = first_quadrant(a, b, std::abs(q0), std::abs(q1));
    } else {
        const double norm = std::hypot(q0, q1);
        c = norm > 0.0 ? std::abs(q0) / norm : 1.0;
        s = norm > 0.0 ? std::abs(q1) / norm : 0.0;
    }
    c = std::copysign(c, q0);
    s = std::copysign(s, q1);
    // In principal axes the foot is (a c, b s) and the normal goes along (b c, a s).
    const double norm = std::hypot(b * c, a * s), n0 = b * c / norm, n1 = a * s / norm;
    Foot foot;
    foot.distance = n0 * (q0 - a * c) + n1 * (q1 - b * s);
    foot.speed = std::hypot(a * s, b * c);
    foot.n = {cp * n0 - sp * n1, sp * n0 + cp * n1};
    foot.u = {cp * c - sp * s, sp * c + cp * s};
    return foot;
}

Offset section_distance(int order, const double *shape, const Eigen::Vector2d &y, double *by_shape)
{
    const Foot f = ellipse_foot(shape[0], shape[1], shape[2], y);
    Offset out{f.distance, f.n, std::atan2(f.u[1], f.u[0])};
    if (by_shape) {
        by_shape[0] = -f.n.dot(f.u);
        by_shape[1] = -(f.n[0] * f.u[0] - f.n[1] * f.u[1]);
        by_shape[2] = -(f.n[0] * f.u[1] + f.n[1] * f.u[0]);
    }
    if (order == 2) {
        return out;
    }
    double g = 0.0, slope = 0.0;
    for (int h = 3; h <= order; h++) {
        const double ch = std::cos(h * out.t), sh = std::sin(h * out.t), *p = shape + shape_parameters(h - 1);
        g += p[0] * ch + p[1] * sh;
        slope += h * (p[1] * ch - p[0] * sh);
    }
    slope /= f.speed;
    const double scale = 1.0 / std::sqrt(1.0 + slope * slope);
    out.distance = (f.distance - g) * scale;
    // dt/dy of the foot is the tangent over the speed, so g turns the normal.
    const Eigen::Vector2d tangent(-f.n[1], f.n[0]);
    out.n = (f.n - slope * tangent) * scale;
    if (by_shape) {
        for (int i = 0; i < 3; i++) {
            by_shape[i] *= scale;
        }
        for (int h = 3; h <= order; h++) {
            double *p = by_shape + shape_parameters(h - 1);
            p[0] = -std::cos(h * out.t) * scale;
            p[1] = -std::sin(h * out.t) * scale;
        }
    }
    return out;
}

Eigen::Vector2d section_point(int order, const double *shape, double t)
{
    const double c = std::cos(t), s = std::sin(t), rho = shape[0], ec = shape[1], es = shape[2];
    Eigen::Vector2d y((rho + ec) * c + es * s, es * c + (rho - ec) * s);
    if (order > 2) {
        // Normal of the ellipse: along M^-1 u, M symmetric.
        Eigen::Vector2d n((rho - ec) * c - es * s, -es * c + (rho + ec) * s);
        double g = 0.0;
        for (int h = 3; h <= order; h++) {
            const double *p = shape + shape_parameters(h - 1);
            g += p[0] * std::cos(h * t) + p[1] * std::sin(h * t);
        }
        y += g * n.normalized();
    }
    return y;
}

} // namespace pipefish::tube
