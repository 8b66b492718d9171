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

double length_of(const Piece &piece)
{
    return piece.angle != 0.0 ? piece.angle * piece.radius : piece.length;
}

double wrap_clock(double clock)
{
    const double c = std::fmod(clock, TWO_PI);
    return c < 0.0 ? c + TWO_PI : c;
}

} // namespace

Tube::Tube(double radius, const std::vector<Piece> &pieces, const std::vector<OvalStretch> &ovals,
           const FeatureSpec &features)
    : radius_(radius), length_(0.0), largest_radius_(radius), ovals_(ovals), water_(features.water),
      roots_(features.roots)
{
    double ovality = 0.0;
    for (const OvalStretch &o : ovals_) {
        ovality += std::abs(o.ovality);
        const double e = 0.5 * o.ovality * radius_;
        largest_.emplace_back(e * std::cos(2.0 * o.clock), e * std::sin(2.0 * o.clock));
        if (!(o.ramp > 0.0) || !(o.start + 2.0 * o.ramp <= o.end)) {
            throw SpecError("ovals: a stretch must be at least two ramps long");
        }
    }
    if (ovality > 0.5) {
        throw SpecError("ovals: the ovality of all stretches together must be at most 0.5");
    }
    for (const Piece &piece : pieces) {
        length_ += length_of(piece);
    }
    reliefs_ = make_reliefs(features, radius_);
    joints_ = all_joints(features, radius_, length_);
    for (const Crack &crack : features.cracks) {
        cracks_.emplace_back(crack, radius_);
    }
    largest_radius_ *= 1.0 + 0.5 * ovality;
    for (const auto &relief : reliefs_) {
        largest_radius_ += relief->bounds(relief->from, relief->to).most;
    }
    // Straight segments before the start and after the end; their outer ends are never reached.
    Growth growth{-END_RUN, {Eigen::Matrix3d::Identity(), {0.0, 0.0, -END_RUN}}, Eigen::Vector3d::UnitZ(), false, 0};
    add_segments(Piece{END_RUN, 0.0, 0.0, 0.0}, growth);
    for (const Piece &piece : pieces) {
        if (piece.angle != 0.0 && !(piece.radius > 1.25 * largest_radius_)) {
            throw SpecError("pieces: a bend's radius must be above 1.25 times the pipe's largest radius");
        }
        add_segments(piece, growth);
    }
    add_segments(Piece{END_RUN, 0.0, 0.0, 0.0}, growth);
    add_openings(features);
}

void Tube::add_segments(const Piece &piece, Growth &growth)
{
    // Cuts where the section starts or stops changing, so that most segments have a constant one; bends into at most 60
    // degrees, so that a segment's end planes meet only far outside the wall.
    const double length = length_of(piece), s = growth.s, s_end = s + length;
    std::vector<double> cuts{s, s_end};
    const auto cut = [&](double c) {
        if (c > s + 1e-9 && c < s_end - 1e-9) {
            cuts.push_back(c);
        }
    };
    for (const OvalStretch &o : ovals_) {
        for (const double c : {o.start, o.start + o.ramp, o.end - o.ramp, o.end}) {
            cut(c);
        }
    }
    for (const auto &relief : reliefs_) {
        std::ranges::for_each(relief->cuts(), cut);
    }
    for (const Water &w : water_) {
        cut(w.start);
        cut(w.end);
    }
    const int parts = std::max(1, static_cast<int>(std::ceil(piece.angle / MAX_SEGMENT_ANGLE)));
    for (int i = 1; i < parts; i++) {
        cuts.push_back(s + length * i / parts);
    }
    // A joint begins where the pipe before it ends; nothing else cuts so near to it that planes tilted by its angle
    // could meet inside the pipe.
    for (const JointSpec &joint : joints_) {
        const double from = joint.s, to = from + joint.gap;
        const double tilt = 1.2 * largest_radius_ * std::tan(std::hypot(joint.yaw, joint.pitch));
        if (to <= s || from >= s_end) {
            continue;
        }
        if (piece.angle != 0.0 || from - tilt < s || to + tilt > s_end) {
            throw SpecError("joints at " + std::to_string(from) + " m: must lie in a straight run");
        }
        std::erase_if(cuts,
                      [&](double c) { return c > s && c < s_end && c > from - 1e-9 - tilt && c < to + tilt + 1e-9; });
        cuts.push_back(from);
        if (to > from) {
            cuts.push_back(to);
        }
    }
    std::sort(cuts.begin(), cuts.end());
    for (size_t i = 0; i + 1 < cuts.size(); i++) {
        if (cuts[i + 1] - cuts[i] > 1e-9) {
            add_segment(piece, cuts[i], cuts[i + 1], growth);
        }
    }
    growth.s = s_end;
}

void Tube::add_segment(const Piece &piece, double from, double to, Growth &growth)
{
    Segment segment{};
    segment.s0 = from;
    segment.length = to - from;
    segment.bend_radius = piece.angle != 0.0 ? piece.radius : 0.0;
    segment.bend_angle = piece.angle != 0.0 ? segment.length / piece.radius : 0.0;
    segment.nx = std::sin(piece.clock);
    segment.ny = -std::cos(piece.clock);
    segment.frame = growth.frame;
    segment.start_normal = growth.start_normal;
    segment.face = growth.face;
    segment.pipe = growth.pipe;
    segment.joint = -1;
    const double c = std::cos(segment.bend_angle), si = std::sin(segment.bend_angle);
    segment.end_normal = {si * segment.nx, si * segment.ny, c};
    segment.end_offset = segment.bend_radius > 0.0 ? segment.bend_radius * si : segment.length;
    growth.frame = advance(growth.frame, segment, segment.length);
    growth.start_normal = Eigen::Vector3d::UnitZ();
    growth.face = false;
    for (size_t j = 0; j < joints_.size(); j++) {
        const JointSpec &joint = joints_[j];
        const double end = joint.s + joint.gap;
        if (from > joint.s - 1e-9 && to < end + 1e-9) {
            segment.joint = static_cast<int>(j);
            segment.groove = joint.depth;
        }
        if (std::abs(to - end) < 1e-9) { // the next pipe begins
            before_.push_back(growth.frame);
            before_.back().origin -= joint.gap * growth.frame.world_from_frame.col(2);
            const double angle = std::hypot(joint.yaw, joint.pitch);
            const Eigen::Vector3d z = Eigen::Vector3d::UnitZ(), step(joint.step_right, joint.step_down, 0.0);
            Eigen::Matrix3d turn = Eigen::Matrix3d::Identity();
            if (angle > 0.0) {
                const Eigen::Vector3d towards(joint.yaw / angle, joint.pitch / angle, 0.0);
                turn = Eigen::AngleAxisd(angle, z.cross(towards)).toRotationMatrix();
            }
            growth.frame.origin += growth.frame.world_from_frame * step;
            growth.frame.world_from_frame = growth.frame.world_from_frame * turn;
            if (joint.gap > 0.0) { // the groove ends at the next pipe's face, else the pipes meet at this one's
                segment.end_normal = turn * z;
                segment.end_offset = segment.end_normal.dot(segment.length * z + step);
            } else {
                growth.start_normal = turn.transpose() * z;
            }
            after_.push_back(growth.frame);
            growth.face = true;
            growth.pipe = static_cast<int>(j) + 1;
        } else if (std::abs(to - joint.s) < 1e-9) {
            growth.face = true;
        }
    }
    set_bounds(segment);
    segments_.push_back(segment);
}

void Tube::set_bounds(Segment &segment) const
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
    segment.inverse_axis = 1.0 / (radius_ + segment.groove - largest);
    segment.constant = section(segment.s0 + 0.5 * segment.length);
    segment.constant.rho += segment.groove;
    // Planes that are tilted let the segment's points lie a little before and behind it.
    const double tilt = std::max(segment.start_normal.head<2>().norm(),
                                 segment.bend_radius > 0.0 ? 0.0 : segment.end_normal.head<2>().norm());
    const double slack = 1e-9 + 1.3 * tilt * (largest_radius_ + segment.groove);
    const double from = segment.s0 - slack, to = segment.s0 + segment.length + slack;
    for (const auto &relief : reliefs_) {
        if (relief->from < to - 2e-9 && relief->to > from + 2e-9) {
            segment.reliefs.push_back(relief.get());
        }
    }
    set_radius_bounds(segment, radius_ + largest, from, to);
    segment.curvature_radius =
        segment.bend_radius - (radius_ + largest + segment.groove + std::max(0.0, segment.bounds.most));
    segment.water = -1;
    for (size_t i = 0; i < water_.size(); i++) {
        const double mid = segment.s0 + 0.5 * segment.length;
        if (mid > water_[i].start && mid < water_[i].end) {
            segment.water = static_cast<int>(i);
        }
    }
}

// Bounds of the ellipse's radius r = f^(-1/2), f = |A^-1 u|^2 = m + k cos(2 clock), from |A^-1| <= l, r <= a and, along
// the pipe, |A'| <= slope and |A''| <= curvature; and of the reliefs on it.
void Tube::set_radius_bounds(Segment &segment, double largest, double from, double to) const
{
    const double l = segment.inverse_axis, a = largest + segment.groove;
    const double k = 0.5 * (l * l - 1.0 / (a * a)), f_s = 2.0 * l * l * l * segment.slope;
    const double f_ss = 2.0 * std::pow(l * l * segment.slope, 2) +
                        2.0 * l * (2.0 * l * l * l * segment.slope * segment.slope + l * l * segment.curvature);
    HeightBounds &b = segment.bounds;
    b.by_s = 0.5 * a * a * a * f_s;
    b.by_phi = a * a * a * k;
    b.by_ss = 0.75 * std::pow(a, 5) * f_s * f_s + 0.5 * a * a * a * f_ss;
    b.by_phiphi = 3.0 * std::pow(a, 5) * k * k + 2.0 * a * a * a * k;
    b.by_sphi = 0.75 * std::pow(a, 5) * f_s * 2.0 * k + 0.5 * a * a * a * 4.0 * l * l * l * segment.slope;
    segment.calm = segment.cover = b;
    for (const Relief *relief : segment.reliefs) {
        const HeightBounds more = relief->bounds(from, to);
        b.add(more);
        segment.cover.add(relief->cover_bounds(from, to));
        segment.cover_depth = std::max(segment.cover_depth, relief->cover_depth());
        if (relief->deposit < 0) {
            segment.calm.add(more);
        }
    }
    segment.inner = 1.0 / l + b.least;
    if (!(segment.inner > 0.25 * radius_)) {
        throw SpecError("wall: deposits, corrugations and the like leave less than a quarter of the radius at " +
                        std::to_string(segment.s0) + " m");
    }
}

void Tube::add_openings(const FeatureSpec &features)
{
    const auto cylinder = [&](double s, double clock, double angle, double diameter, Material material, size_t part) {
        const Frame3 f = frame(s);
        const Eigen::Vector3d out(std::sin(clock), -std::cos(clock), 0.0), along = Eigen::Vector3d::UnitZ();
        const Eigen::Vector3d axis = std::sin(angle) * out + std::cos(angle) * along;
        const Eigen::Vector3d across = std::sin(angle) * along - std::cos(angle) * out;
        branches_.push_back({f.origin, f.world_from_frame * axis, f.world_from_frame * across, 0.5 * diameter, 0.0,
                             material, static_cast<int>(part)});
        // The mouth is where the cylinder leaves the pipe: between axis and largest radius.
        const double far = largest_radius_ / std::tan(angle), side = diameter / std::sin(angle);
        for (Segment &segment : segments_) {
            if (segment.s0 < s + std::max(0.0, far) + side &&
                segment.s0 + segment.length > s + std::min(0.0, far) - side) {
                segment.branches.push_back(static_cast<int>(branches_.size()) - 1);
            }
        }
    };
    for (size_t i = 0; i < features.laterals.size(); i++) {
        const Lateral &b = features.laterals[i];
        if (b.diameter > 1.9 * radius_) {
            throw SpecError("laterals[" + std::to_string(i) + "].diameter: must be at most 0.95 of the pipe's");
        }
        cylinder(b.s, b.clock, b.angle, b.diameter, Material::LATERAL, i);
        branches_.back().length = b.length;
    }
    for (size_t i = 0; i < features.holes.size(); i++) {
        const Hole &h = features.holes[i];
        if (h.diameter > radius_) {
            throw SpecError("holes[" + std::to_string(i) + "].diameter: must be at most half of the pipe's");
        }
        cylinder(h.s, h.clock, 0.5 * std::numbers::pi, h.diameter, Material::HOLE, i);
        branches_.back().length = wall_radius(h.s, h.clock) + h.depth;
    }
    for (size_t i = 0; i < cracks_.size(); i++) {
        for (Segment &segment : segments_) {
            if (segment.s0 < cracks_[i].to() + radius_ && segment.s0 + segment.length > cracks_[i].from() - radius_) {
                segment.cracks.push_back(static_cast<int>(i));
            }
        }
    }
    for (const Root &root : features.roots) {
        const Frame3 f = frame(root.s);
        const Eigen::Vector3d base = wall(root.s, root.clock);
        bundles_.push_back(grow_roots(root, base, (f.origin - base).normalized(), Eigen::Vector3d::UnitY()));
    }
    for (const Water &w : water_) {
        const Frame3 f = frame(w.s);
        const Eigen::Vector3d floor = wall(w.s, std::numbers::pi);
        WaterPlane plane;
        plane.normal = w.sloped != 0 ? Eigen::Vector3d(-f.world_from_frame.col(1)) : Eigen::Vector3d(0.0, -1.0, 0.0);
        plane.level = plane.normal.dot(floor) + w.depth;
        plane.right = f.world_from_frame.col(0);
        plane.right = (plane.right - plane.normal * plane.normal.dot(plane.right)).normalized();
        plane.along = plane.right.cross(-plane.normal);
        plane.right_0 = plane.along_0 = 0.0;
        planes_.push_back(plane);
    }
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
    const auto after = std::upper_bound(segments_.begin() + 1, segments_.end(), s,
                                        [](double at, const Segment &segment) { return at < segment.s0; });
    return static_cast<int>(after - segments_.begin()) - 1;
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

Frame3 Tube::ride(double s) const
{
    for (size_t j = 0; j < joints_.size(); j++) {
        const double from = joints_[j].s, to = from + joints_[j].gap, middle = 0.5 * (from + to);
        const double to_last = j > 0 ? from - joints_[j - 1].s - joints_[j - 1].gap : INFINITE;
        const double to_next = j + 1 < joints_.size() ? joints_[j + 1].s - to : INFINITE;
        const double reach = 0.5 * joints_[j].gap + std::min({radius_, 0.45 * to_last, 0.45 * to_next});
        if (std::abs(s - middle) >= reach) {
            continue;
        }
        const auto along = [](const Frame3 &f, double way) {
            return Frame3{f.world_from_frame, f.origin + way * f.world_from_frame.col(2)};
        };
        const Frame3 first = s < from ? frame(s) : along(before_[j], s - from);
        const Frame3 second = s >= to ? frame(s) : along(after_[j], s - to);
        double slope = 0.0;
        const double share = smooth_step(0.5 + 0.5 * (s - middle) / reach, slope);
        const Eigen::AngleAxisd turn(first.world_from_frame.transpose() * second.world_from_frame);
        return {first.world_from_frame * Eigen::AngleAxisd(share * turn.angle(), turn.axis()).toRotationMatrix(),
                (1.0 - share) * first.origin + share * second.origin};
    }
    return frame(s);
}

double Tube::radius_at(const Segment &segment, double s, double clock, double ux, double uy, Height &sum,
                       bool cover) const
{
    Section sec = segment.constant;
    if (segment.varying) {
        sec = section(s);
        sec.rho += segment.groove;
    }
    if (!segment.varying && sec.e_c == 0.0 && sec.e_s == 0.0) {
        sum = {sec.rho, 0.0, 0.0};
    } else {
        const double inv_det = 1.0 / (sec.rho * sec.rho - sec.e_c * sec.e_c - sec.e_s * sec.e_s);
        const auto inverse = [&](double px, double py) {
            return Eigen::Vector2d(((sec.rho + sec.e_c) * px + sec.e_s * py) * inv_det,
                                   (sec.e_s * px + (sec.rho - sec.e_c) * py) * inv_det);
        };
        const Eigen::Vector2d w = inverse(ux, uy);
        sum.h = 1.0 / w.norm();
        const double cube = sum.h * sum.h * sum.h;
        sum.by_phi = -cube * w.dot(inverse(-uy, ux));
        sum.by_s = cube * w.dot(inverse(-sec.d_c * w.x() - sec.d_s * w.y(), -sec.d_s * w.x() + sec.d_c * w.y()));
    }
    for (const Relief *relief : segment.reliefs) {
        if (s > relief->from && s < relief->to) {
            cover ? relief->add_cover(s, clock, sum) : relief->add(s, clock, sum);
        }
    }
    return sum.h;
}

double Tube::wall_radius(double s, double clock) const
{
    const Segment &segment = segments_[static_cast<size_t>(segment_at(s))];
    double deepest = 0.0;
    for (const int i : segment.cracks) {
        const CrackPath &crack = cracks_[static_cast<size_t>(i)];
        if (crack.distance(s, wrap_clock(clock), crack.half_width()) < crack.half_width()) {
            deepest = std::max(deepest, crack.depth());
        }
    }
    Height wall;
    return radius_at(segment, s, wrap_clock(clock), std::sin(clock), -std::cos(clock), wall) + deepest;
}

Eigen::Vector3d Tube::wall(double s, double clock) const
{
    const double r = wall_radius(s, clock);
    const Frame3 f = frame(s);
    return f.origin + f.world_from_frame * Eigen::Vector3d(r * std::sin(clock), -r * std::cos(clock), 0.0);
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

int Tube::water_over(const Eigen::Vector3d &world) const
{
    WallPoint at{};
    const int index = find(world, at);
    const int water = index >= 0 ? segments_[static_cast<size_t>(index)].water : -1;
    if (water < 0) {
        return -1;
    }
    const WaterPlane &plane = planes_[static_cast<size_t>(water)];
    return plane.normal.dot(world) < plane.level ? water : -1;
}

int Tube::find(const Eigen::Vector3d &world, WallPoint &out) const
{
    double best = std::max(1.5 * radius_, 1.2 * largest_radius_);
    int found = -1;
    for (size_t i = 0; i < segments_.size(); i++) {
        const Segment &segment = segments_[i];
        const Eigen::Vector3d p = segment.frame.world_from_frame.transpose() * (world - segment.frame.origin);
        const bool started = i == 0 || segment.start_normal.dot(p) >= -1e-9;
        const bool ended = i + 1 < segments_.size() && segment.end_normal.dot(p) > segment.end_offset + 1e-9;
        if (!started || ended) {
            continue;
        }
        const WallPoint q = to_section(segment, p);
        if (q.distance < best) {
            best = q.distance;
            out = q;
            found = static_cast<int>(i);
        }
    }
    return found;
}

bool Tube::locate(const Eigen::Vector3d &world, WallPoint &out) const
{
    return find(world, out) >= 0;
}

} // namespace pipefish::sim
