#include "sim/tube.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <stdexcept>

namespace pipefish::sim
{

namespace
{

constexpr double TWO_PI = 2.0 * std::numbers::pi;
constexpr double INFINITE = std::numeric_limits<double>::infinity();
constexpr double END_RUN = 1.0; // metres
constexpr double MAX_SEGMENT_ANGLE = std::numbers::pi / 3.0;

// Quintic step 6x^5 - 15x^4 + 10x^3 and its derivative; |step'| <= 15/8, |step''| <= 10/sqrt(3).
double smooth_step(double x, double &slope)
{
    if (x <= 0.0 || x >= 1.0) {
        slope = 0.0;
        return x <= 0.0 ? 0.0 : 1.0;
    }
    slope = 30.0 * x * x * (x - 1.0) * (x - 1.0);
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0);
}

double wrap_clock(double clock)
{
    const double c = std::fmod(clock, TWO_PI);
    return c < 0.0 ? c + TWO_PI : c;
}

} // namespace

Tube::Tube(double radius, const std::vector<Piece> &pieces, const std::vector<OvalStretch> &ovals)
    : radius_(radius), length_(0.0), ovals_(ovals)
{
    double ovality = 0.0;
    for (const OvalStretch &o : ovals_) {
        ovality += std::abs(o.ovality);
        const double e = 0.5 * o.ovality * radius_;
        largest_.emplace_back(e * std::cos(2.0 * o.clock), e * std::sin(2.0 * o.clock));
        if (!(o.ramp > 0.0) || !(o.start + 2.0 * o.ramp <= o.end)) {
            throw std::invalid_argument("an oval stretch must be at least two ramps long");
        }
    }
    if (ovality > 0.5) {
        throw std::invalid_argument("the ovality of all stretches together must be at most 0.5");
    }
    // Straight segments before the start and after the end; their outer ends are never reached.
    Frame3 frame{Eigen::Matrix3d::Identity(), {0.0, 0.0, -END_RUN}};
    double s = -END_RUN;
    add_segments(Piece{END_RUN, 0.0, 0.0, 0.0}, s, frame);
    for (const Piece &piece : pieces) {
        if (piece.angle != 0.0 && !(piece.radius > 1.25 * radius_ * (1.0 + 0.5 * ovality))) {
            throw std::invalid_argument("a bend's radius must be above 1.25 times the pipe's largest radius");
        }
        add_segments(piece, s, frame);
    }
    length_ = s;
    add_segments(Piece{END_RUN, 0.0, 0.0, 0.0}, s, frame);
}

void Tube::add_segments(const Piece &piece, double &s, Frame3 &frame)
{
    // Cuts where the section starts or stops changing, so that most segments have a constant one; bends into at most 60
    // degrees, so that a segment's end planes meet only far outside the wall.
    const double length = piece.angle != 0.0 ? piece.angle * piece.radius : piece.length;
    std::vector<double> cuts{s, s + length};
    for (const OvalStretch &o : ovals_) {
        for (const double c : {o.start, o.start + o.ramp, o.end - o.ramp, o.end}) {
            if (c > s + 1e-9 && c < s + length - 1e-9) {
                cuts.push_back(c);
            }
        }
    }
    const int parts = std::max(1, static_cast<int>(std::ceil(piece.angle / MAX_SEGMENT_ANGLE)));
    for (int i = 1; i < parts; i++) {
        cuts.push_back(s + length * i / parts);
    }
    std::sort(cuts.begin(), cuts.end());
    for (size_t i = 0; i + 1 < cuts.size(); i++) {
        Segment segment{};
        segment.s0 = cuts[i];
        segment.length = cuts[i + 1] - cuts[i];
        if (segment.length < 1e-9) {
            continue;
        }
        segment.bend_radius = piece.angle != 0.0 ? piece.radius : 0.0;
        segment.bend_angle = piece.angle != 0.0 ? segment.length / piece.radius : 0.0;
        segment.nx = std::sin(piece.clock);
        segment.ny = -std::cos(piece.clock);
        segment.frame = frame;
        set_section_bounds(segment);
        segments_.push_back(segment);
        frame = advance(frame, segment, segment.length);
    }
    s += length;
}

void Tube::set_section_bounds(Segment &segment) const
{
    double largest = 0.0;
    for (const OvalStretch &o : ovals_) {
        const double amplitude = 0.5 * std::abs(o.ovality) * radius_;
        const double mid = segment.s0 + 0.5 * segment.length;
        if (mid <= o.start || mid >= o.end) {
            continue;
        }
        largest += amplitude;
        if (mid < o.start + o.ramp || mid > o.end - o.ramp) {
            segment.varying = true;
            segment.slope += amplitude * 15.0 / 8.0 / o.ramp;
            segment.curvature += amplitude * 10.0 / std::sqrt(3.0) / (o.ramp * o.ramp);
        }
    }
    segment.inverse_axis = 1.0 / (radius_ - largest);
    segment.constant = section(segment.s0 + 0.5 * segment.length);
    segment.cos_end = std::cos(segment.bend_angle);
    segment.sin_end = std::sin(segment.bend_angle);
    segment.curvature_radius = segment.bend_radius - (radius_ + largest);
}

Section Tube::section(double s) const
{
    Section out{radius_, 0.0, 0.0, 0.0, 0.0};
    for (size_t i = 0; i < ovals_.size(); i++) {
        const OvalStretch &o = ovals_[i];
        if (s <= o.start || s >= o.end) {
            continue;
        }
        double up_slope = 0.0, down_slope = 0.0;
        const double up = smooth_step((s - o.start) / o.ramp, up_slope);
        const double down = smooth_step((o.end - s) / o.ramp, down_slope);
        const Eigen::Vector2d &e = largest_[i];
        const double value = up * down, slope = (up_slope * down - up * down_slope) / o.ramp;
        out.e_c += value * e.x();
        out.e_s += value * e.y();
        out.d_c += slope * e.x();
        out.d_s += slope * e.y();
    }
    return out;
}

int Tube::segment_at(double s) const
{
    int i = 0;
    while (i + 1 < static_cast<int>(segments_.size()) && s >= segments_[static_cast<size_t>(i) + 1].s0) {
        i++;
    }
    return i;
}

Frame3 Tube::advance(const Frame3 &frame, const Segment &segment, double along)
{
    if (segment.bend_radius == 0.0) {
        return {frame.world_from_frame, frame.origin + along * frame.world_from_frame.col(2)};
    }
    const double angle = along / segment.bend_radius, c = std::cos(angle), si = std::sin(angle);
    const Eigen::Vector3d n(segment.nx, segment.ny, 0.0), z = Eigen::Vector3d::UnitZ();
    const Eigen::Vector3d step = segment.bend_radius * ((1.0 - c) * n + si * z);
    // Rotation by `angle` that takes z towards n.
    const Eigen::Matrix3d turn = Eigen::AngleAxisd(angle, z.cross(n)).toRotationMatrix();
    return {frame.world_from_frame * turn, frame.origin + frame.world_from_frame * step};
}

Frame3 Tube::frame(double s) const
{
    const Segment &segment = segments_[static_cast<size_t>(segment_at(s))];
    return advance(segment.frame, segment, s - segment.s0);
}

Eigen::Vector3d Tube::wall(double s, double clock) const
{
    const Section sec = section(s);
    const double ux = std::sin(clock), uy = -std::cos(clock);
    const double det = sec.rho * sec.rho - sec.e_c * sec.e_c - sec.e_s * sec.e_s;
    const double wx = ((sec.rho + sec.e_c) * ux + sec.e_s * uy) / det;
    const double wy = (sec.e_s * ux + (sec.rho - sec.e_c) * uy) / det;
    const double r = 1.0 / std::hypot(wx, wy);
    const Frame3 f = frame(s);
    return f.origin + f.world_from_frame * Eigen::Vector3d(r * ux, r * uy, 0.0);
}

WallPoint Tube::to_section(const Segment &segment, const Eigen::Vector3d &p)
{
    if (segment.bend_radius == 0.0) {
        return {segment.s0 + p.z(), wrap_clock(std::atan2(p.x(), -p.y())), std::hypot(p.x(), p.y())};
    }
    const double u = segment.bend_radius - (p.x() * segment.nx + p.y() * segment.ny);
    const double w = p.y() * segment.nx - p.x() * segment.ny;
    const double n = segment.bend_radius - std::hypot(u, p.z());
    const double x = n * segment.nx - w * segment.ny, y = n * segment.ny + w * segment.nx;
    return {segment.s0 + segment.bend_radius * std::atan2(p.z(), u), wrap_clock(std::atan2(x, -y)), std::hypot(x, y)};
}

bool Tube::locate(const Eigen::Vector3d &world, WallPoint &out) const
{
    double best = 1.5 * radius_;
    bool found = false;
    for (size_t i = 0; i < segments_.size(); i++) {
        const Segment &segment = segments_[i];
        const Eigen::Vector3d p = segment.frame.world_from_frame.transpose() * (world - segment.frame.origin);
        const WallPoint q = to_section(segment, p);
        const double lo = i == 0 ? -INFINITE : segment.s0 - 1e-9;
        const double hi = i + 1 == segments_.size() ? INFINITE : segment.s0 + segment.length + 1e-9;
        if (q.s >= lo && q.s <= hi && q.distance < best) {
            best = q.distance;
            out = q;
            found = true;
        }
    }
    return found;
}

Tube::View::View(const Tube &tube, const Eigen::Matrix3d &world_from_cam, const Eigen::Vector3d &centre)
    : tube_(tube), start_(-1)
{
    WallPoint at{};
    if (tube.locate(centre, at)) {
        start_ = tube.segment_at(at.s);
    }
    for (const Segment &segment : tube.segments_) {
        const Eigen::Matrix3d segment_from_world = segment.frame.world_from_frame.transpose();
        local_.push_back({segment_from_world * world_from_cam, segment_from_world * (centre - segment.frame.origin)});
    }
}

// A ray in a segment's frame. In a bend, the plane of the centreline and the direction across it: u points from the
// bend's centre to the segment's start, z along the start's tangent, w across.
struct Tube::SegmentRay {
    struct State {
        double x, y, u, z, q;      // (right, down) in the section; in a bend u, z and q = hypot(u, z)
        double g, rate;            // the wall's function and its derivative along the ray
        Eigen::Vector2d g_section; // gradient of g by (right, down)
        double g_s;                // and by the arc length
    };

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

    // Where the ray passes the segment's end (step +1) or its start (step -1).
    double exit(bool has_next, bool has_previous, int &step) const
    {
        double t_exit = INFINITE;
        if (has_next) {
            const double offset = bend() ? o.z() * segment.cos_end - ou * segment.sin_end : o.z() - segment.length;
            const double rate = bend() ? d.z() * segment.cos_end - du * segment.sin_end : d.z();
            if (rate > 0.0) {
                t_exit = -offset / rate;
                step = 1;
            }
        }
        if (has_previous && d.z() < 0.0 && -o.z() / d.z() < t_exit) {
            t_exit = -o.z() / d.z();
            step = -1;
        }
        return t_exit;
    }

    // A bound of g'' = 2 |w'|^2 + 2 w.w'' along the ray inside the segment, from w = A^-1 p, |w| <= 1, |A'| <= slope,
    // |A''| <= curvature and |A^-1| <= l.
    double bound() const
    {
        const double l = segment.inverse_axis, slope = segment.slope, curvature = segment.curvature;
        if (!bend()) {
            const double across = std::sqrt(d.x() * d.x() + d.y() * d.y()), grow = l * (across + slope);
            return 2.0 * grow * grow + 2.0 * l * (2.0 * l * slope * (across + slope) + curvature);
        }
        const double q = segment.curvature_radius, ds = segment.bend_radius / q, dds = 2.0 * ds / q;
        const double grow = l * (1.0 + slope * ds);
        return 2.0 * grow * grow +
               2.0 * l * (1.0 / q + 2.0 * l * slope * ds * (1.0 + slope * ds) + curvature * ds * ds + slope * dds);
    }

    State at(double t) const
    {
        State st{};
        st.z = o.z() + t * d.z();
        double vx = d.x(), vy = d.y(), vs = d.z();
        if (!bend()) {
            st.x = o.x() + t * d.x();
            st.y = o.y() + t * d.y();
        } else {
            st.u = ou + t * du;
            st.q = std::sqrt(st.u * st.u + st.z * st.z);
            const double w = ow + t * dw, n = segment.bend_radius - st.q, vn = -(st.u * du + st.z * d.z()) / st.q;
            st.x = n * segment.nx - w * segment.ny;
            st.y = n * segment.ny + w * segment.nx;
            vx = vn * segment.nx - dw * segment.ny;
            vy = vn * segment.ny + dw * segment.nx;
            vs = segment.bend_radius * (st.u * d.z() - st.z * du) / (st.q * st.q);
        }
        const Section sec = segment.varying ? tube.section(arc(st)) : segment.constant;
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
        st.rate = st.g_section.x() * vx + st.g_section.y() * vy + st.g_s * vs;
        return st;
    }

    double arc(const State &st) const
    {
        return segment.s0 + (bend() ? segment.bend_radius * std::atan2(st.z, st.u) : st.z);
    }

    // Outward gradient of g in the segment's frame. In a bend the section at the angle a has the axes cos a n - sin a z
    // (to the bend's centre) and sin a n + cos a z (tangent), and an arc length of bend_radius / q per metre.
    Eigen::Vector3d gradient(const State &st) const
    {
        if (!bend()) {
            return {st.g_section.x(), st.g_section.y(), st.g_s};
        }
        const double gn = st.g_section.x() * segment.nx + st.g_section.y() * segment.ny;
        const double gw = st.g_section.y() * segment.nx - st.g_section.x() * segment.ny;
        const double gt = st.g_s * segment.bend_radius / st.q, c = st.u / st.q, s = st.z / st.q;
        const double n = gn * c + gt * s;
        return {n * segment.nx - gw * segment.ny, n * segment.ny + gw * segment.nx, gt * c - gn * s};
    }
};

// The ray is marched on g(p) = |A(s)^-1 p|^2 - 1, negative inside. Along the ray g(t + h) <= g + g' h + K h^2 / 2 with
// K a bound of g'' over the segment, so the root h of the right side never passes the first hit and converges to it
// like Newton's method. On a straight segment of constant section K is exact and the first step lands on the wall.
bool Tube::View::cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Hit &hit) const
{
    constexpr int MAX_STEPS = 2000;
    constexpr double NEAR = 1e-12; // of g: half a picometre per metre of radius
    if (start_ < 0) {
        return false;
    }
    const double far = 1000.0 * tube_.radius_;
    const int last = static_cast<int>(tube_.segments_.size()) - 1;
    int index = start_, steps = 0;
    double t = 0.0;
    while (true) {
        const Local &local = local_[static_cast<size_t>(index)];
        const SegmentRay ray(tube_, tube_.segments_[static_cast<size_t>(index)], local.rotation * origin + local.offset,
                             local.rotation * direction);
        int hop = 0;
        const double t_exit = ray.exit(index<last, index> 0, hop), bound = ray.bound();
        while (true) {
            const SegmentRay::State st = ray.at(t);
            if ((steps == 0 && st.g >= 0.0) || steps++ >= MAX_STEPS || t >= far) {
                return false;
            }
            if (st.g > -NEAR) {
                hit = {t, ray.arc(st), wrap_clock(std::atan2(st.x, -st.y)),
                       -(local.rotation.transpose() * ray.gradient(st)).normalized()};
                return true;
            }
            const double h = -2.0 * st.g / (st.rate + std::sqrt(st.rate * st.rate - 2.0 * bound * st.g));
            if (t + h >= t_exit) {
                t = std::max(t, t_exit);
                index += hop;
                break;
            }
            t += h;
        }
    }
}

} // namespace pipefish::sim
