// A ray in one segment of the tube: where it is, the wall's function there, and the march to the wall.
#pragma once

#include "sim/tube.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

namespace pipefish::sim
{

inline constexpr double TWO_PI = 2.0 * std::numbers::pi;
inline constexpr double INFINITE = std::numeric_limits<double>::infinity();
inline constexpr int MAX_STEPS = 4000;
inline constexpr double NEAR = 1e-12; // of the wall's function: half a picometre per metre of radius

inline double wrap_clock(double clock)
{
    const double c = std::fmod(clock, TWO_PI);
    return c < 0.0 ? c + TWO_PI : c;
}

// The first root h of value + rate h + bound h^2 / 2 = 0, for value <= 0.
inline double safe_step(double value, double rate, double bound)
{
    return -2.0 * value / (rate + std::sqrt(rate * rate - 2.0 * bound * value));
}

// A place on a ray, in its segment.
struct Tube::RayState {
    double x, y, u, z, q;      // (right, down) in the section; in a bend u, z and q = hypot(u, z)
    double vx, vy, vs;         // their rates along the ray, and the arc length's
    double rho, clock;         // where the segment has reliefs
    bool inner;                // so near to the axis that no wall can be; g is then that of the cylinder around it
    double g, rate;            // the wall's function and its derivative along the ray
    Eigen::Vector2d g_section; // gradient of g by (right, down)
    double g_s;                // and by the arc length
};

// A ray in a segment's frame. In a bend, the plane of the centreline and the direction across it: u points from the
// bend's centre to the segment's start, z along the start's tangent, w across.
struct Tube::SegmentRay {
    using State = RayState;

    const Tube &tube;
    const Segment &segment;
    Eigen::Vector3d o, d;
    double ou, du, ow, dw;

    SegmentRay(const Tube &the_tube, const Segment &the_segment, const Eigen::Vector3d &origin,
               const Eigen::Vector3d &direction)
        : tube(the_tube), segment(the_segment), o(origin), d(direction),
          ou(segment.bend_radius - (o.x() * segment.nx + o.y() * segment.ny)),
          du(-(d.x() * segment.nx + d.y() * segment.ny)), ow(o.y() * segment.nx - o.x() * segment.ny),
          dw(d.y() * segment.nx - d.x() * segment.ny)
    {
    }

    bool bend() const { return segment.bend_radius > 0.0; }
    bool detailed() const { return !segment.reliefs.empty(); }

    // Where the ray passes the segment's end (step +1) or its start (step -1).
    double exit(bool has_next, bool has_previous, int &step) const
    {
        double t_exit = INFINITE;
        const double end_rate = segment.end_normal.dot(d), start_rate = segment.start_normal.dot(d);
        if (has_next && end_rate > 0.0) {
            t_exit = (segment.end_offset - segment.end_normal.dot(o)) / end_rate;
            step = 1;
        }
        if (has_previous && start_rate < 0.0) {
            const double t = -segment.start_normal.dot(o) / start_rate;
            if (t < t_exit) {
                t_exit = t;
                step = -1;
            }
        }
        return t_exit;
    }

    // A bound of g'' = 2 |w'|^2 + 2 w.w'' along the ray inside the segment, from w = A^-1 p, |w| <= 1, |A'| <= slope,
    // |A''| <= curvature and |A^-1| <= l.
    double ellipse_bound(double l, double slope, double curvature) const
    {
        if (!bend()) {
            const double across = std::sqrt(d.x() * d.x() + d.y() * d.y()), grow = l * (across + slope);
            return 2.0 * grow * grow + 2.0 * l * (2.0 * l * slope * (across + slope) + curvature);
        }
        const double q = segment.curvature_radius, ds = segment.bend_radius / q, dds = 2.0 * ds / q;
        const double grow = l * (1.0 + slope * ds);
        return 2.0 * grow * grow +
               2.0 * l * (1.0 / q + 2.0 * l * slope * ds * (1.0 + slope * ds) + curvature * ds * ds + slope * dds);
    }

    // The same for g = 2 (rho - r(s, clock)) / radius at least 0.7 `inner` from the axis.
    double relief_bound(const HeightBounds &b) const
    {
        const double least = 0.7 * segment.inner, q = bend() ? segment.curvature_radius : INFINITE;
        const double v2 = bend() ? 1.0 : d.x() * d.x() + d.y() * d.y(), turn = std::sqrt(v2) / least;
        const double along = bend() ? segment.bend_radius / q : std::abs(d.z());
        const double rho2 = v2 / least + 1.0 / q, clock2 = v2 / (least * least) + 1.0 / (q * least);
        const double s2 = bend() ? 2.0 * along / q : 0.0;
        return 2.0 / tube.radius_ *
               (rho2 + b.by_ss * along * along + 2.0 * b.by_sphi * along * turn + b.by_phiphi * turn * turn +
                b.by_phi * clock2 + b.by_s * s2);
    }

    void place(double t, State &st) const
    {
        st.z = o.z() + t * d.z();
        if (!bend()) {
            st.x = o.x() + t * d.x();
            st.y = o.y() + t * d.y();
            st.vx = d.x();
            st.vy = d.y();
            st.vs = d.z();
            return;
        }
        st.u = ou + t * du;
        st.q = std::sqrt(st.u * st.u + st.z * st.z);
        const double w = ow + t * dw, n = segment.bend_radius - st.q, vn = -(st.u * du + st.z * d.z()) / st.q;
        st.x = n * segment.nx - w * segment.ny;
        st.y = n * segment.ny + w * segment.nx;
        st.vx = vn * segment.nx - dw * segment.ny;
        st.vy = vn * segment.ny + dw * segment.nx;
        st.vs = segment.bend_radius * (st.u * d.z() - st.z * du) / (st.q * st.q);
    }

    State at(double t, bool cover = false) const
    {
        State st{};
        place(t, st);
        if (detailed()) {
            wall_with_reliefs(st, 0.0, cover);
        } else {
            ellipse(st);
        }
        st.rate = st.g_section.x() * st.vx + st.g_section.y() * st.vy + st.g_s * st.vs;
        return st;
    }

    void ellipse(State &st) const
    {
        Section sec = segment.constant;
        if (segment.varying) {
            sec = tube.section(arc(st));
            sec.rho += segment.groove;
        }
        const double inv_det = 1.0 / (sec.rho * sec.rho - sec.e_c * sec.e_c - sec.e_s * sec.e_s);
        const auto inverse = [&](double px, double py) {
            return Eigen::Vector2d(((sec.rho + sec.e_c) * px + sec.e_s * py) * inv_det,
                                   (sec.e_s * px + (sec.rho - sec.e_c) * py) * inv_det);
        };
        const Eigen::Vector2d w = inverse(st.x, st.y);
        st.g = w.squaredNorm() - 1.0;
        st.g_section = 2.0 * inverse(w.x(), w.y());
        if (segment.varying) { // d(A^-1 p)/ds = -A^-1 A' w with A' = [-d_c, -d_s; -d_s, d_c]
            st.g_s = -2.0 * w.dot(inverse(-sec.d_c * w.x() - sec.d_s * w.y(), -sec.d_s * w.x() + sec.d_c * w.y()));
        }
    }

    // `deeper`: metres by which the surface lies behind the wall. `cover`: of the reliefs' covers.
    void wall_with_reliefs(State &st, double deeper, bool cover = false) const
    {
        const double rho2 = st.x * st.x + st.y * st.y, inner = segment.inner;
        st.inner = rho2 < inner * inner * (1.0 - 2e-7);
        if (st.inner) {
            st.g = rho2 / (inner * inner) - 1.0;
            st.g_section = {2.0 * st.x / (inner * inner), 2.0 * st.y / (inner * inner)};
            return;
        }
        st.rho = std::sqrt(rho2);
        st.clock = wrap_clock(std::atan2(st.x, -st.y));
        Height wall;
        const double scale = 2.0 / tube.radius_,
                     r = tube.radius_at(segment, arc(st), st.clock, st.x / st.rho, st.y / st.rho, wall, cover);
        const double turn = wall.by_phi / rho2;
        st.g = scale * (st.rho - r - deeper);
        st.g_section = {scale * (st.x / st.rho + turn * st.y), scale * (st.y / st.rho - turn * st.x)};
        st.g_s = -scale * wall.by_s;
    }

    double arc(const State &st) const
    {
        return segment.s0 + (bend() ? segment.bend_radius * std::atan2(st.z, st.u) : st.z);
    }

    // The gradient in the segment's frame of a function with these derivatives by (right, down) and the arc length. In
    // a bend the section at the angle a has the axes cos a n - sin a z (to the bend's centre) and sin a n + cos a z
    // (tangent), and an arc length of bend_radius / q per metre.
    Eigen::Vector3d gradient(const State &st, const Eigen::Vector2d &section, double by_s) const
    {
        if (!bend()) {
            return {section.x(), section.y(), by_s};
        }
        const double gn = section.x() * segment.nx + section.y() * segment.ny;
        const double gw = section.y() * segment.nx - section.x() * segment.ny;
        const double gt = by_s * segment.bend_radius / st.q, c = st.u / st.q, s = st.z / st.q;
        const double n = gn * c + gt * s;
        return {n * segment.nx - gw * segment.ny, n * segment.ny + gw * segment.nx, gt * c - gn * s};
    }

    // The way to the nearest deposit at least, from its clock angle alone; 0 inside one's.
    double clear(const State &st) const
    {
        double least = INFINITE;
        for (const Relief *relief : segment.reliefs) {
            if (relief->deposit >= 0) {
                least = std::min(least, st.rho * std::sin(std::min(0.5 * std::numbers::pi, relief->outside(st.clock))));
            }
        }
        return least;
    }

    // Marches from t to the wall, or to `limit`; t is then there. Along the ray g(t + h) <= g + g' h + K h^2 / 2 with K
    // a bound of g'' over the segment, so the root h of the right side never passes the first hit and converges to it
    // like Newton's method. On a straight segment of constant section K is exact and the first step lands on the wall.
    // Reliefs: the same, first up to the cylinder inside which there is no wall, from there with their own bound (that
    // without the deposits as far as the ray cannot reach one), in steps that keep 0.7 of its radius off the axis.
    // Where a rough relief has a smoother cover, long steps lead to near it, and only there begin those that the grains
    // ask for. Returns true at the wall.
    bool to_wall(double &t, double limit, int &steps, State &st) const
    {
        const double inner_bound = detailed() ? ellipse_bound(1.0 / segment.inner, 0.0, 0.0)
                                              : ellipse_bound(segment.inverse_axis, segment.slope, segment.curvature);
        const double bound = detailed() ? relief_bound(segment.bounds) : inner_bound;
        const double calm_bound = detailed() ? relief_bound(segment.calm) : 0.0, longest = 0.3 * segment.inner;
        const bool covered = detailed() && segment.cover_depth > 0.0;
        const double cover_bound = covered ? relief_bound(segment.cover) : 0.0;
        const double close = -0.1 * segment.cover_depth * 2.0 / tube.radius_;
        for (; steps < MAX_STEPS; steps++) {
            st = at(t, covered);
            const bool far = covered && st.g < close;
            if (covered && !st.inner && !far) {
                st = at(t);
            }
            if (!st.inner && st.g > -NEAR) {
                return true;
            }
            double h = safe_step(st.g, st.rate, st.inner ? inner_bound : far ? cover_bound : bound);
            if (detailed() && !st.inner) {
                h = std::min(std::max(h, std::min(safe_step(st.g, st.rate, calm_bound), clear(st))), longest);
            }
            if (t + h >= limit) {
                break;
            }
            t += h;
        }
        t = std::max(t, limit);
        return false;
    }
};

} // namespace pipefish::sim
