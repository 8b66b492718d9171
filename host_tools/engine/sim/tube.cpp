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
constexpr double MAX_PIECE_ANGLE = std::numbers::pi / 3.0;

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

Tube::Tube(double radius, const std::vector<Run> &runs, const std::vector<OvalStretch> &ovals)
    : radius_(radius), length_(0.0), ovals_(ovals)
{
    if (runs.empty()) {
        throw std::invalid_argument("a pipe needs at least one run");
    }
    if (runs.front().bend_radius != 0.0 || runs.back().bend_radius != 0.0) {
        throw std::invalid_argument("the first and the last run must be straight");
    }
    double ratio_sum = 0.0;
    for (const OvalStretch &o : ovals_) {
        ratio_sum += std::abs(o.ratio);
        if (!(o.ramp > 0.0) || !(o.from + 2.0 * o.ramp <= o.to)) {
            throw std::invalid_argument("an oval stretch must be at least two ramps long");
        }
    }
    if (ratio_sum > 0.5) {
        throw std::invalid_argument("oval stretches add up to more than 50 percent");
    }
    Frame3 frame{Eigen::Matrix3d::Identity(), Eigen::Vector3d::Zero()};
    for (const Run &run : runs) {
        if (run.bend_radius != 0.0 && !(run.bend_radius > 1.25 * radius_ * (1.0 + 0.5 * ratio_sum))) {
            throw std::invalid_argument("a bend's radius must be above 1.25 times the pipe's largest radius");
        }
        add_pieces(run, length_, frame);
    }
}

void Tube::add_pieces(const Run &run, double &s, Frame3 &frame)
{
    // Cuts where the section starts or stops changing, so that most pieces have a constant one; bends into at most 60
    // degrees, so that a piece's end planes meet only far outside the wall.
    std::vector<double> cuts{s, s + run.length};
    for (const OvalStretch &o : ovals_) {
        for (const double c : {o.from, o.from + o.ramp, o.to - o.ramp, o.to}) {
            if (c > s + 1e-9 && c < s + run.length - 1e-9) {
                cuts.push_back(c);
            }
        }
    }
    if (run.bend_radius > 0.0) {
        const int parts = static_cast<int>(std::ceil(run.length / run.bend_radius / MAX_PIECE_ANGLE));
        for (int i = 1; i < parts; i++) {
            cuts.push_back(s + run.length * i / parts);
        }
    }
    std::sort(cuts.begin(), cuts.end());
    for (size_t i = 0; i + 1 < cuts.size(); i++) {
        Piece piece{};
        piece.s0 = cuts[i];
        piece.length = cuts[i + 1] - cuts[i];
        if (piece.length < 1e-9) {
            continue;
        }
        piece.bend_radius = run.bend_radius;
        piece.bend_angle = run.bend_radius > 0.0 ? piece.length / run.bend_radius : 0.0;
        piece.nx = std::sin(run.bend_clock);
        piece.ny = -std::cos(run.bend_clock);
        piece.frame = frame;
        set_section_bounds(piece);
        pieces_.push_back(piece);
        frame = advance(frame, piece, piece.length);
    }
    s += run.length;
}

void Tube::set_section_bounds(Piece &piece) const
{
    double largest = 0.0;
    for (const OvalStretch &o : ovals_) {
        const double amplitude = 0.5 * std::abs(o.ratio) * radius_;
        const double mid = piece.s0 + 0.5 * piece.length;
        if (mid <= o.from || mid >= o.to) {
            continue;
        }
        largest += amplitude;
        if (mid < o.from + o.ramp || mid > o.to - o.ramp) {
            piece.varying = true;
            piece.slope += amplitude * 15.0 / 8.0 / o.ramp;
            piece.curvature += amplitude * 10.0 / std::sqrt(3.0) / (o.ramp * o.ramp);
        }
    }
    piece.inverse_axis = 1.0 / (radius_ - largest);
    piece.constant = section(piece.s0 + 0.5 * piece.length);
    piece.cos_end = std::cos(piece.bend_angle);
    piece.sin_end = std::sin(piece.bend_angle);
    piece.curvature_radius = piece.bend_radius - (radius_ + largest);
}

Section Tube::section(double s) const
{
    Section out{radius_, 0.0, 0.0, 0.0, 0.0};
    for (const OvalStretch &o : ovals_) {
        double up_slope = 0.0, down_slope = 0.0;
        const double up = smooth_step((s - o.from) / o.ramp, up_slope);
        const double down = smooth_step((o.to - s) / o.ramp, down_slope);
        const double amplitude = 0.5 * o.ratio * radius_;
        const double value = amplitude * up * down;
        const double slope = amplitude * (up_slope * down - up * down_slope) / o.ramp;
        const double c = std::cos(2.0 * o.clock), si = std::sin(2.0 * o.clock);
        out.e_c += value * c;
        out.e_s += value * si;
        out.d_c += slope * c;
        out.d_s += slope * si;
    }
    return out;
}

int Tube::piece_at(double s) const
{
    int i = 0;
    while (i + 1 < static_cast<int>(pieces_.size()) && s >= pieces_[static_cast<size_t>(i) + 1].s0) {
        i++;
    }
    return i;
}

Frame3 Tube::advance(const Frame3 &frame, const Piece &piece, double along)
{
    if (piece.bend_radius == 0.0) {
        return {frame.world_from_frame, frame.origin + along * frame.world_from_frame.col(2)};
    }
    const double angle = along / piece.bend_radius, c = std::cos(angle), si = std::sin(angle);
    const Eigen::Vector3d n(piece.nx, piece.ny, 0.0), z = Eigen::Vector3d::UnitZ();
    const Eigen::Vector3d step = piece.bend_radius * ((1.0 - c) * n + si * z);
    // Rotation by `angle` that takes z towards n.
    const Eigen::Matrix3d turn = Eigen::AngleAxisd(angle, z.cross(n)).toRotationMatrix();
    return {frame.world_from_frame * turn, frame.origin + frame.world_from_frame * step};
}

Frame3 Tube::frame(double s) const
{
    const Piece &piece = pieces_[static_cast<size_t>(piece_at(s))];
    return advance(piece.frame, piece, s - piece.s0);
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

WallPoint Tube::to_section(const Piece &piece, const Eigen::Vector3d &p)
{
    if (piece.bend_radius == 0.0) {
        return {piece.s0 + p.z(), wrap_clock(std::atan2(p.x(), -p.y())), std::hypot(p.x(), p.y())};
    }
    const double u = piece.bend_radius - (p.x() * piece.nx + p.y() * piece.ny);
    const double w = p.y() * piece.nx - p.x() * piece.ny;
    const double n = piece.bend_radius - std::hypot(u, p.z());
    const double x = n * piece.nx - w * piece.ny, y = n * piece.ny + w * piece.nx;
    return {piece.s0 + piece.bend_radius * std::atan2(p.z(), u), wrap_clock(std::atan2(x, -y)), std::hypot(x, y)};
}

bool Tube::locate(const Eigen::Vector3d &world, WallPoint &out) const
{
    double best = 1.5 * radius_;
    bool found = false;
    for (size_t i = 0; i < pieces_.size(); i++) {
        const Piece &piece = pieces_[i];
        const Eigen::Vector3d p = piece.frame.world_from_frame.transpose() * (world - piece.frame.origin);
        const WallPoint q = to_section(piece, p);
        const double lo = i == 0 ? -INFINITE : piece.s0 - 1e-9;
        const double hi = i + 1 == pieces_.size() ? INFINITE : piece.s0 + piece.length + 1e-9;
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
        start_ = tube.piece_at(at.s);
    }
    for (const Piece &piece : tube.pieces_) {
        const Eigen::Matrix3d piece_from_world = piece.frame.world_from_frame.transpose();
        local_.push_back({piece_from_world * world_from_cam, piece_from_world * (centre - piece.frame.origin)});
    }
}

// A ray in a piece's frame. In a bend, the plane of the centreline and the direction across it: u points from the
// bend's centre to the piece's start, z along the start's tangent, w across.
struct Tube::PieceRay {
    struct State {
        double x, y, u, z, q;      // (right, down) in the section; in a bend u, z and q = hypot(u, z)
        double g, rate;            // the wall's function and its derivative along the ray
        Eigen::Vector2d g_section; // gradient of g by (right, down)
        double g_s;                // and by the arc length
    };

    const Tube &tube;
    const Piece &piece;
    Eigen::Vector3d o, d;
    double ou, du, ow, dw;

    PieceRay(const Tube &the_tube, const Piece &the_piece, const Eigen::Vector3d &origin,
             const Eigen::Vector3d &direction)
        : tube(the_tube), piece(the_piece), o(origin), d(direction),
          ou(piece.bend_radius - (o.x() * piece.nx + o.y() * piece.ny)), du(-(d.x() * piece.nx + d.y() * piece.ny)),
          ow(o.y() * piece.nx - o.x() * piece.ny), dw(d.y() * piece.nx - d.x() * piece.ny)
    {
    }

    bool bend() const { return piece.bend_radius > 0.0; }

    // Where the ray passes the piece's end (step +1) or its start (step -1).
    double exit(bool has_next, bool has_previous, int &step) const
    {
        double t_exit = INFINITE;
        if (has_next) {
            const double offset = bend() ? o.z() * piece.cos_end - ou * piece.sin_end : o.z() - piece.length;
            const double rate = bend() ? d.z() * piece.cos_end - du * piece.sin_end : d.z();
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

    // A bound of g'' = 2 |w'|^2 + 2 w.w'' along the ray inside the piece, from w = A^-1 p, |w| <= 1, |A'| <= slope,
    // |A''| <= curvature and |A^-1| <= l.
    double bound() const
    {
        const double l = piece.inverse_axis, slope = piece.slope, curvature = piece.curvature;
        if (!bend()) {
            const double across = std::sqrt(d.x() * d.x() + d.y() * d.y()), grow = l * (across + slope);
            return 2.0 * grow * grow + 2.0 * l * (2.0 * l * slope * (across + slope) + curvature);
        }
        const double q = piece.curvature_radius, ds = piece.bend_radius / q, dds = 2.0 * ds / q;
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
            const double w = ow + t * dw, n = piece.bend_radius - st.q, vn = -(st.u * du + st.z * d.z()) / st.q;
            st.x = n * piece.nx - w * piece.ny;
            st.y = n * piece.ny + w * piece.nx;
            vx = vn * piece.nx - dw * piece.ny;
            vy = vn * piece.ny + dw * piece.nx;
            vs = piece.bend_radius * (st.u * d.z() - st.z * du) / (st.q * st.q);
        }
        const Section sec = piece.varying ? tube.section(arc(st)) : piece.constant;
        const double inv_det = 1.0 / (sec.rho * sec.rho - sec.e_c * sec.e_c - sec.e_s * sec.e_s);
        const auto inverse = [&](double px, double py) {
            return Eigen::Vector2d(((sec.rho + sec.e_c) * px + sec.e_s * py) * inv_det,
                                   (sec.e_s * px + (sec.rho - sec.e_c) * py) * inv_det);
        };
        const Eigen::Vector2d w = inverse(st.x, st.y);
        st.g = w.squaredNorm() - 1.0;
        st.g_section = 2.0 * inverse(w.x(), w.y());
        if (piece.varying) { // d(A^-1 p)/ds = -A^-1 A' w with A' = [-d_c, -d_s; -d_s, d_c]
            st.g_s = -2.0 * w.dot(inverse(-sec.d_c * w.x() - sec.d_s * w.y(), -sec.d_s * w.x() + sec.d_c * w.y()));
        }
        st.rate = st.g_section.x() * vx + st.g_section.y() * vy + st.g_s * vs;
        return st;
    }

    double arc(const State &st) const
    {
        return piece.s0 + (bend() ? piece.bend_radius * std::atan2(st.z, st.u) : st.z);
    }

    // Outward gradient of g in the piece's frame. In a bend the section at the angle a has the axes cos a n - sin a z
    // (to the bend's centre) and sin a n + cos a z (tangent), and an arc length of bend_radius / q per metre.
    Eigen::Vector3d gradient(const State &st) const
    {
        if (!bend()) {
            return {st.g_section.x(), st.g_section.y(), st.g_s};
        }
        const double gn = st.g_section.x() * piece.nx + st.g_section.y() * piece.ny;
        const double gw = st.g_section.y() * piece.nx - st.g_section.x() * piece.ny;
        const double gt = st.g_s * piece.bend_radius / st.q, c = st.u / st.q, s = st.z / st.q;
        const double n = gn * c + gt * s;
        return {n * piece.nx - gw * piece.ny, n * piece.ny + gw * piece.nx, gt * c - gn * s};
    }
};

// The ray is marched on g(p) = |A(s)^-1 p|^2 - 1, negative inside. Along the ray g(t + h) <= g + g' h + K h^2 / 2 with
// K a bound of g'' over the piece, so the root h of the right side never passes the first hit and converges to it like
// Newton's method. On a straight piece of constant section K is exact and the first step lands on the wall.
bool Tube::View::cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Hit &hit) const
{
    constexpr int MAX_STEPS = 2000;
    constexpr double NEAR = 1e-12; // of g: half a picometre per metre of radius
    if (start_ < 0) {
        return false;
    }
    const double far = 1000.0 * tube_.radius_;
    const int last = static_cast<int>(tube_.pieces_.size()) - 1;
    int index = start_, steps = 0;
    double t = 0.0;
    while (true) {
        const Local &local = local_[static_cast<size_t>(index)];
        const PieceRay ray(tube_, tube_.pieces_[static_cast<size_t>(index)], local.rotation * origin + local.offset,
                           local.rotation * direction);
        int hop = 0;
        const double t_exit = ray.exit(index<last, index> 0, hop), bound = ray.bound();
        while (true) {
            const PieceRay::State st = ray.at(t);
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
