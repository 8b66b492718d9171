#include "sim/sheet.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::sim
{

namespace
{

double power(double x, int n)
{
    double p = 1.0;
    for (int k = 0; k < n; k++) {
        p *= x;
    }
    return p;
}

} // namespace

double Relief::at(double u, double v, double slope[2]) const
{
    double sum = 0.0;
    slope[0] = slope[1] = 0.0;
    for (const Monomial &m : powers) {
        const double pu = power(u, m.i), pv = power(v, m.j);
        sum += m.metres * pu * pv;
        slope[0] += m.i > 0 ? m.metres * m.i * power(u, m.i - 1) * pv : 0.0;
        slope[1] += m.j > 0 ? m.metres * m.j * pu * power(v, m.j - 1) : 0.0;
    }
    for (const Wave &w : waves) {
        const double angle = w.u_rate * u + w.v_rate * v + w.phase, turn = w.metres * std::cos(angle);
        sum += w.metres * std::sin(angle);
        slope[0] += turn * w.u_rate;
        slope[1] += turn * w.v_rate;
    }
    return sum;
}

double Relief::most(double reach) const
{
    double sum = 0.0;
    for (const Monomial &m : powers) {
        sum += std::abs(m.metres) * power(reach, m.i + m.j);
    }
    for (const Wave &w : waves) {
        sum += std::abs(w.metres);
    }
    return sum;
}

double Relief::most_curved(double reach) const
{
    double sum = 0.0;
    for (const Monomial &m : powers) { // the largest of the three second derivatives
        const int n = std::max({m.i * (m.i - 1), m.j * (m.j - 1), m.i * m.j});
        sum += n > 0 ? std::abs(m.metres) * n * power(reach, m.i + m.j - 2) : 0.0;
    }
    for (const Wave &w : waves) {
        const double rate = std::max(std::abs(w.u_rate), std::abs(w.v_rate));
        sum += std::abs(w.metres) * rate * rate;
    }
    return sum;
}

Sheet::Sheet(const SheetSpec &spec) : spec_(spec)
{
    const std::array<double, 12> &p = spec.pose;
    rotation_ << p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10];
    shift_ << p[3], p[7], p[11];
    if (!((rotation_.transpose() * rotation_ - Eigen::Matrix3d::Identity()).norm() < 1e-6 &&
          rotation_.determinant() > 0.0)) {
        throw std::invalid_argument("pose: not a rotation beside a translation");
    }
    if (spec.curvature != 0.0 && !spec.relief.empty()) {
        throw std::invalid_argument("curvature: a sheet is a cylinder or has a relief, not both");
    }
    if (spec.width * std::abs(spec.curvature) > 2.0 * std::numbers::pi * (1.0 + 1e-12)) {
        throw std::invalid_argument("curvature: the sheet is wider than the cylinder's circumference");
    }
    double bulge = 1.0; // how far the outline goes
    for (const OutlineWave &w : spec.outline_waves) {
        bulge += std::abs(w.share);
    }
    bulge = spec.outline == Outline::round ? bulge : 1.0;
    reach_u_ = bulge + 2.0 * spec.stretch_a.most(bulge) / spec.width;
    reach_v_ = bulge + 2.0 * spec.stretch_b.most(bulge) / spec.height;
    const double reach = std::max(reach_u_, reach_v_);
    most_ = spec.relief.most(reach);
    curved_ = spec.relief.most_curved(reach);
    constexpr int STEPS = 12;
    for (int i = 0; i <= STEPS; i++) {
        for (int j = 0; j <= STEPS; j++) {
            double x = 0.0, y = 0.0, s[4];
            stretched(bulge * (i - 0.5 * STEPS) / STEPS * spec.width, bulge * (j - 0.5 * STEPS) / STEPS * spec.height,
                      x, y, s);
            if (!(s[0] * s[3] - s[1] * s[2] > 0.1)) {
                throw std::invalid_argument("stretch_a, stretch_b: the texture folds");
            }
        }
    }
    // No point of the base is further from its middle along the surface than this, so none is in space.
    centre_ = shift_;
    radius_ = std::hypot(0.5 * spec.width * reach_u_, 0.5 * spec.height * reach_v_) + most_;
}

void Sheet::stretched(double a, double b, double &x, double &y, double slopes[4]) const
{
    const double ku = 2.0 / spec_.width, kv = 2.0 / spec_.height;
    double sa[2], sb[2];
    x = a + spec_.stretch_a.at(ku * a, kv * b, sa);
    y = b + spec_.stretch_b.at(ku * a, kv * b, sb);
    slopes[0] = 1.0 + ku * sa[0];
    slopes[1] = kv * sa[1];
    slopes[2] = ku * sb[0];
    slopes[3] = 1.0 + kv * sb[1];
}

bool Sheet::inside(double a, double b) const
{
    const double u = 2.0 * a / spec_.width, v = 2.0 * b / spec_.height;
    if (spec_.outline == Outline::rectangle) {
        return std::abs(u) <= 1.0 && std::abs(v) <= 1.0;
    }
    const double r2 = u * u + v * v;
    if (spec_.outline_waves.empty()) {
        return r2 <= 1.0;
    }
    const double angle = std::atan2(v, u);
    double radius = 1.0;
    for (const OutlineWave &w : spec_.outline_waves) {
        radius += w.share * std::cos(w.k * angle - w.phase);
    }
    return radius > 0.0 && r2 <= radius * radius;
}

Eigen::Vector3d Sheet::normal(double x, double y) const
{
    const double k = spec_.curvature;
    if (k != 0.0) {
        return {-std::sin(k * x), 0.0, std::cos(k * x)};
    }
    if (spec_.relief.empty()) {
        return {0.0, 0.0, 1.0};
    }
    double slope[2];
    spec_.relief.at(2.0 * x / spec_.width, 2.0 * y / spec_.height, slope);
    return Eigen::Vector3d(-2.0 * slope[0] / spec_.width, -2.0 * slope[1] / spec_.height, 1.0).normalized();
}

Eigen::Vector3d Sheet::place(double a, double b, Eigen::Vector3d *front) const
{
    double x = 0.0, y = 0.0, s[4];
    stretched(a, b, x, y, s);
    if (front != nullptr) {
        *front = -(rotation_ * normal(x, y));
    }
    const double k = spec_.curvature;
    Eigen::Vector3d p(x, y, 0.0);
    if (k != 0.0) {
        const double half = std::sin(0.5 * k * x);
        p = {std::sin(k * x) / k, y, 2.0 * half * half / k};
    } else if (!spec_.relief.empty()) {
        double slope[2];
        p.z() = spec_.relief.at(2.0 * x / spec_.width, 2.0 * y / spec_.height, slope);
    }
    return rotation_ * p + shift_;
}

double Sheet::light(double a, double b) const
{
    const double u = 2.0 * a / spec_.width, v = 2.0 * b / spec_.height;
    double slope[2], factor = spec_.gain;
    if (!spec_.light.empty()) {
        factor *= std::exp(spec_.light.at(u, v, slope));
    }
    for (const Shadow &s : spec_.shadows) {
        const double at = u * std::cos(s.angle) + v * std::sin(s.angle) - s.offset;
        const double x = std::clamp(0.5 + at / s.soft, 0.0, 1.0);
        factor *= 1.0 - (1.0 - s.share) * x * x * (3.0 - 2.0 * x);
    }
    return factor;
}

// From the base's (x, y) to the texture's (a, b); true if they are on the sheet.
bool Sheet::accept(double x, double y, SheetHit &hit) const
{
    hit.a = x;
    hit.b = y;
    if (!spec_.stretch_a.empty() || !spec_.stretch_b.empty()) {
        double error = 1.0;
        for (int k = 0; k < 20 && error > 1e-15; k++) { // Newton; the constructor has seen that it does not fold
            double at_x = 0.0, at_y = 0.0, s[4];
            stretched(hit.a, hit.b, at_x, at_y, s);
            const double ex = x - at_x, ey = y - at_y, det = s[0] * s[3] - s[1] * s[2];
            hit.a += (ex * s[3] - ey * s[1]) / det;
            hit.b += (ey * s[0] - ex * s[2]) / det;
            error = std::hypot(ex, ey);
        }
        if (!(error < 1e-12)) {
            return false;
        }
    }
    return inside(hit.a, hit.b);
}

bool Sheet::cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, SheetHit &hit) const
{
    const Eigen::Vector3d away = centre_ - origin;
    const double along = away.dot(direction);
    if (away.squaredNorm() * direction.squaredNorm() - along * along > radius_ * radius_ * direction.squaredNorm()) {
        return false;
    }
    const Eigen::Vector3d o = rotation_.transpose() * (origin - shift_), d = rotation_.transpose() * direction;
    if (spec_.curvature != 0.0) {
        return cast_cylinder(o, d, hit);
    }
    return spec_.relief.empty() ? cast_plane(o, d, hit) : cast_relief(o, d, hit);
}

bool Sheet::cast_plane(const Eigen::Vector3d &o, const Eigen::Vector3d &d, SheetHit &hit) const
{
    hit.t = -o.z() / d.z();
    hit.back = d.z() < 0.0;
    return hit.t > 0.0 && std::isfinite(hit.t) && accept(o.x() + hit.t * d.x(), o.y() + hit.t * d.y(), hit);
}

bool Sheet::cast_cylinder(const Eigen::Vector3d &o, const Eigen::Vector3d &d, SheetHit &hit) const
{
    const double k = spec_.curvature, radius = 1.0 / std::abs(k), oz = o.z() - 1.0 / k;
    const double a = d.x() * d.x() + d.z() * d.z(), b = o.x() * d.x() + oz * d.z();
    const double c = o.x() * o.x() + oz * oz - radius * radius, disc = b * b - a * c;
    if (!(disc > 0.0) || !(a > 0.0)) {
        return false;
    }
    const double q = -(b + std::copysign(std::sqrt(disc), b));
    const double roots[2] = {std::min(q / a, c / q), std::max(q / a, c / q)};
    for (const double t : roots) {
        if (!(t > 0.0)) {
            continue;
        }
        // The angle from the base's middle line, where the centre's direction is (0, -1 / k).
        const double x = o.x() + t * d.x(), z = oz + t * d.z();
        const double angle = std::atan2(x, k > 0.0 ? -z : z);
        hit.t = t;
        hit.back = (k > 0.0) == (b + a * t > 0.0); // from within the outside's back is seen
        if (accept(radius * angle, o.y() + t * d.y(), hit)) {
            return true;
        }
    }
    return false;
}

// Marches on f(t) = z - relief. A step s with |f| + f' sign(f) s - B s^2 / 2 >= 0, B a bound of |f''|, passes no root;
// near a root it is Newton's.
bool Sheet::cast_relief(const Eigen::Vector3d &o, const Eigen::Vector3d &d, SheetHit &hit) const
{
    const double ku = 2.0 / spec_.width, kv = 2.0 / spec_.height, scale = d.norm();
    double t = 0.0, last = INFINITY;
    const double low[3] = {-reach_u_ / ku, -reach_v_ / kv, -most_};
    for (int axis = 0; axis < 3; axis++) { // the box that holds the sheet
        const double near = (low[axis] * (1.0 + 1e-9) - 1e-9 - o[axis]) / d[axis];
        const double far = (-low[axis] * (1.0 + 1e-9) + 1e-9 - o[axis]) / d[axis];
        if (d[axis] == 0.0) {
            if (std::abs(o[axis]) > -low[axis]) {
                return false;
            }
            continue;
        }
        t = std::max(t, std::min(near, far));
        last = std::min(last, std::max(near, far));
    }
    const double run = std::abs(ku * d.x()) + std::abs(kv * d.y()), bound = curved_ * run * run;
    const double least = 1e-15 * (o.norm() + spec_.width) / scale, past = 1e-7 * spec_.width / scale;
    double side = 0.0; // of the sheet on which the march is
    for (int k = 0; k < 400 && t <= last; k++) {
        double s[2];
        const double x = o.x() + t * d.x(), y = o.y() + t * d.y();
        const double f = o.z() + t * d.z() - spec_.relief.at(ku * x, kv * y, s);
        const double slope = d.z() - ku * s[0] * d.x() - kv * s[1] * d.y();
        const double height = std::abs(f), fall = f > 0.0 ? -slope : slope;
        const double root = std::sqrt(fall * fall + 2.0 * bound * height);
        const double step =
            fall > 0.0 ? 2.0 * height / (root + fall) : (bound > 0.0 ? (root - fall) / bound : INFINITY);
        if (step <= least || f * side < 0.0) { // no step crosses, but by rounding
            hit.t = t;
            hit.back = slope < 0.0;
            if (t > 0.0 && accept(x, y, hit)) {
                return true;
            }
            t += past; // a hit beside the outline
            side = 0.0;
            continue;
        }
        side = f > 0.0 ? 1.0 : -1.0;
        t += step;
    }
    return false;
}

} // namespace pipefish::sim
