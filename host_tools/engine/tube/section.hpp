// One cross-section of a tube: an ellipse without a preferred axis, so that the circle is an ordinary point, and normal
// offsets by harmonics for eggs and dents.
//
//   { M u + g(t) n(t) : u = (cos t, sin t) },  M = rho I + [ec es; es -ec],  g(t) = sum_{h >= 3} a_h cos ht + b_h sin
//   ht
//
// n(t) is the ellipse's outward normal. Semi-axes rho +- |e|, direction of the longer one atan2(es, ec) / 2.
#pragma once

#include <Eigen/Core>

namespace pipefish::tube
{

struct Foot {
    double distance;   // signed, positive outside; along the normal
    Eigen::Vector2d u; // unit vector whose image M u is the foot point
    Eigen::Vector2d n; // outward unit normal there
    double speed;      // |d(M u) / dt|
};

// The point of the ellipse nearest to y. Wants rho > |e|. Exact to rounding, also at the centre, on the axes and inside
// the evolute.
Foot ellipse_foot(double rho, double ec, double es, const Eigen::Vector2d &y);

// rho, ec, es, then a_3, b_3, a_4, b_4, ..: a section of order h has 3 + 2 (h - 2) parameters.
constexpr int shape_parameters(int order)
{
    return 3 + 2 * (order - 2);
}

struct Offset {
    double distance;   // to the section: the ellipse's for order 2, to first order in the harmonics above
    Eigen::Vector2d n; // derivative of the distance by y
    double t;          // parameter of the foot
};

// Signed distance of y from the section `shape`, and its derivatives by the shape's parameters (or null).
Offset section_distance(int order, const double *shape, const Eigen::Vector2d &y, double *by_shape);

// The point of the section at parameter t.
Eigen::Vector2d section_point(int order, const double *shape, double t);

} // namespace pipefish::tube
