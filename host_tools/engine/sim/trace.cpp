// Rays in the tube. Its free space is the union of the main pipe, which is marched segment by segment, and of what
// opens from it: a ray that meets the main wall inside an opening goes on to the opening's own end, and from there, if
// that lies in the main pipe, on in it.
#include "sim/tube.hpp"

#include "sim/random.hpp"
#include "sim/segmentray.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

constexpr double LEAST_DEPOSIT = 2e-4; // metres: less is wall with dirt on it

} // namespace

struct Tube::View::Walk {
    Eigen::Vector3d o, d;
    double t = 0.0;
    int index = 0;
    bool with_water = true;
    int steps = 0;
    int branch = -1, crack = -1; // the opening that the ray is in
    Hit hit{};
};

Tube::View::View(const Tube &tube, const Eigen::Matrix3d &world_from_cam, const Eigen::Vector3d &centre, double seconds)
    : tube_(tube), seconds_(seconds), start_(-1)
{
    WallPoint at{};
    start_ = tube.find(centre, at);
    for (const Segment &segment : tube.segments_) {
        const Eigen::Matrix3d segment_from_world = segment.frame.world_from_frame.transpose();
        local_.push_back({segment_from_world * world_from_cam, segment_from_world * (centre - segment.frame.origin)});
    }
    const Eigen::Matrix3d cam_from_world = world_from_cam.transpose();
    for (Branch branch : tube.branches_) {
        branch.origin = cam_from_world * (branch.origin - centre);
        branch.axis = cam_from_world * branch.axis;
        branch.across = cam_from_world * branch.across;
        branches_.push_back(branch);
    }
    for (const Bundle &bundle : tube.bundles_) {
        bundles_.push_back(moved(bundle, cam_from_world, centre));
    }
    for (WaterPlane plane : tube.planes_) {
        plane.level -= plane.normal.dot(centre);
        plane.right_0 = plane.right.dot(centre);
        plane.along_0 = plane.along.dot(centre);
        plane.normal = cam_from_world * plane.normal;
        plane.right = cam_from_world * plane.right;
        plane.along = cam_from_world * plane.along;
        water_.push_back(plane);
    }
}

Tube::SegmentRay Tube::View::ray_in(const Walk &walk) const
{
    const Local &local = local_[static_cast<size_t>(walk.index)];
    return {tube_, tube_.segments_[static_cast<size_t>(walk.index)], local.rotation * walk.o + local.offset,
            local.rotation * walk.d};
}

// The segment in which the ray is at t, near to the one it is taken for.
void Tube::View::settle(Walk &walk) const
{
    const int last = static_cast<int>(tube_.segments_.size()) - 1;
    for (int direction = 0; true;) {
        const Segment &segment = tube_.segments_[static_cast<size_t>(walk.index)];
        const Local &local = local_[static_cast<size_t>(walk.index)];
        const Eigen::Vector3d p = local.rotation * (walk.o + walk.t * walk.d) + local.offset;
        if (walk.index < last && direction >= 0 && segment.end_normal.dot(p) > segment.end_offset) {
            direction = 1;
        } else if (walk.index > 0 && direction <= 0 && segment.start_normal.dot(p) < 0.0) {
            direction = -1;
        } else {
            return;
        }
        walk.index += direction;
    }
}

// walk.hit is the main pipe's wall at walk.t, where `st` is.
void Tube::View::set_wall_hit(Walk &walk, const SegmentRay &ray, const RayState &st) const
{
    const Segment &segment = ray.segment;
    const Local &local = local_[static_cast<size_t>(walk.index)];
    walk.hit = {walk.t,
                ray.arc(st),
                wrap_clock(std::atan2(st.x, -st.y)),
                -(local.rotation.transpose() * ray.gradient(st, st.g_section, st.g_s)).normalized(),
                segment.joint >= 0 ? Material::JOINT : Material::WALL,
                segment.joint >= 0 ? segment.joint : segment.pipe,
                walk.index};
    for (const Relief *relief : segment.reliefs) {
        Height height;
        if (relief->deposit >= 0) {
            relief->add(walk.hit.s, walk.hit.clock, height);
        }
        if (height.h < -LEAST_DEPOSIT) {
            walk.hit.material = Material::DEPOSIT;
            walk.hit.part = relief->deposit;
        }
    }
}

double Tube::View::water_ahead(const Walk &walk, const Segment &segment) const
{
    if (!walk.with_water || segment.water < 0) {
        return INFINITE;
    }
    const WaterPlane &plane = water_[static_cast<size_t>(segment.water)];
    const double fall = -plane.normal.dot(walk.d), t = (plane.normal.dot(walk.o) - plane.level) / fall;
    return fall > 0.0 && t >= walk.t ? t : INFINITE;
}

bool Tube::View::under(const Walk &walk, int water) const
{
    const WaterPlane &plane = water_[static_cast<size_t>(water)];
    return plane.normal.dot(walk.o + walk.t * walk.d) < plane.level;
}

// From walk.t on in the main pipe to walk.hit. False: lost.
bool Tube::View::march(Walk &walk) const
{
    const double far = 1000.0 * tube_.radius_;
    const int last = static_cast<int>(tube_.segments_.size()) - 1;
    while (walk.steps < MAX_STEPS && walk.t < far) {
        const SegmentRay ray = ray_in(walk);
        const Segment &segment = ray.segment;
        int hop = 0;
        const double t_exit = ray.exit(walk.index<last, walk.index> 0, hop), t_water = water_ahead(walk, segment);
        RayState st{};
        if (ray.to_wall(walk.t, std::min(t_exit, t_water), walk.steps, st)) {
            set_wall_hit(walk, ray, st);
            return true;
        }
        if (walk.steps >= MAX_STEPS || walk.t >= far) {
            return false;
        }
        if (t_water < t_exit) {
            ray.place(walk.t, st);
            walk.hit = {walk.t,
                        ray.arc(st),
                        wrap_clock(std::atan2(st.x, -st.y)),
                        water_[static_cast<size_t>(segment.water)].normal,
                        Material::WATER,
                        segment.water,
                        walk.index};
            return true;
        }
        walk.index += hop;
        const Segment &next = tube_.segments_[static_cast<size_t>(walk.index)];
        const bool face = hop > 0 ? next.face : segment.face;
        const bool shore = walk.with_water && next.water >= 0 && next.water != segment.water;
        if (!face && !shore) {
            continue;
        }
        const SegmentRay beyond = ray_in(walk);
        const Local &local = local_[static_cast<size_t>(walk.index - hop)];
        const Eigen::Vector3d plane = hop > 0 ? segment.end_normal : Eigen::Vector3d(-segment.start_normal);
        st = beyond.at(walk.t);
        const bool solid = face && !st.inner && st.g > -NEAR;
        if (!solid && !(shore && under(walk, next.water))) {
            continue;
        }
        set_wall_hit(walk, beyond, st);
        walk.hit.normal = -(local.rotation.transpose() * plane);
        if (solid) {
            const int groove = next.joint >= 0 ? next.joint : segment.joint;
            walk.hit.material = Material::JOINT;
            walk.hit.part = groove >= 0 ? groove : std::min(segment.pipe, next.pipe);
        } else { // the end of a stretch of water, from its side
            walk.hit.material = Material::WATER;
            walk.hit.part = next.water;
        }
        return true;
    }
    return false;
}

// Is the hit on the main wall, or on an opening's, inside another opening? walk.branch or walk.crack says in which.
bool Tube::View::in_opening(Walk &walk) const
{
    if (walk.hit.material == Material::WATER) {
        return false;
    }
    const Segment &segment = tube_.segments_[static_cast<size_t>(walk.index)];
    for (const int i : segment.branches) {
        const Branch &b = branches_[static_cast<size_t>(i)];
        const Eigen::Vector3d p = walk.o + walk.t * walk.d - b.origin;
        const double along = p.dot(b.axis);
        if (along > 0.0 && along < b.length * (1.0 - 1e-9) &&
            (p - along * b.axis).squaredNorm() < b.radius * b.radius * (1.0 - 1e-9)) {
            walk.branch = i;
            return true;
        }
    }
    if (segment.cracks.empty()) {
        return false;
    }
    const SegmentRay ray = ray_in(walk);
    RayState st{};
    ray.place(walk.t, st);
    const double s = ray.arc(st), clock = wrap_clock(std::atan2(st.x, -st.y)), tiny = 1e-9 * tube_.radius_;
    const double rho = std::hypot(st.x, st.y);
    Height wall;
    const double behind = rho - tube_.radius_at(segment, s, clock, st.x / rho, st.y / rho, wall);
    for (const int i : segment.cracks) {
        const CrackPath &crack = tube_.cracks_[static_cast<size_t>(i)];
        if (behind > -tiny && behind < crack.depth() - tiny &&
            crack.distance(s, clock, crack.half_width()) < crack.half_width() - tiny) {
            walk.crack = i;
            return true;
        }
    }
    return false;
}

// At the end of an opening: solid, or in the main pipe again.
Tube::View::After Tube::View::after(Walk &walk) const
{
    settle(walk);
    const RayState st = ray_in(walk).at(walk.t);
    return st.inner || st.g < -1e-9 ? After::MAIN : After::SOLID;
}

Tube::View::After Tube::View::leave_branch(Walk &walk) const
{
    const Branch &b = branches_[static_cast<size_t>(walk.branch)];
    walk.branch = -1;
    const Eigen::Vector3d p = walk.o - b.origin;
    const double y = p.dot(b.axis), dy = walk.d.dot(b.axis);
    const Eigen::Vector3d q = p - y * b.axis, dq = walk.d - dy * b.axis;
    const double a = dq.squaredNorm(), half = q.dot(dq);
    const double side =
        (-half + std::sqrt(std::max(0.0, half * half - a * (q.squaredNorm() - b.radius * b.radius)))) / a;
    const double cap = dy > 0.0 ? (b.length - y) / dy : dy < 0.0 ? -y / dy : INFINITE;
    const bool capped = !(side < cap);
    walk.t = std::max(walk.t, capped ? cap : side);
    const Eigen::Vector3d r = (q + walk.t * dq).normalized();
    walk.hit.t = walk.t;
    walk.hit.s = y + walk.t * dy;
    walk.hit.clock = wrap_clock(std::atan2(r.dot(b.axis.cross(b.across)), r.dot(b.across)));
    walk.hit.normal = capped ? Eigen::Vector3d(-b.axis) : Eigen::Vector3d(-r);
    walk.hit.material = b.material;
    walk.hit.part = b.part;
    const After then = after(walk);
    walk.hit.segment = walk.index;
    return then;
}

// Inside a crack: to its side, its floor, or back into the main pipe. The distance d from the path of a ray's place
// grows at most by its speed; above a quarter of the half width w its second derivative stays below 4 speed^2 / w and
// the place's own acceleration.
Tube::View::After Tube::View::leave_crack(Walk &walk) const
{
    const CrackPath &crack = tube_.cracks_[static_cast<size_t>(walk.crack)];
    const int last = static_cast<int>(tube_.segments_.size()) - 1;
    const double w = crack.half_width(), radius = tube_.radius_, tiny = 1e-10 * radius;
    const int part = walk.crack;
    walk.crack = -1;
    for (int steps = 0; true; steps++) {
        const SegmentRay ray = ray_in(walk);
        const Local &local = local_[static_cast<size_t>(walk.index)];
        RayState st{};
        ray.place(walk.t, st);
        ray.wall_with_reliefs(st, crack.depth());
        if (st.inner || st.g < -(crack.depth() + 1e-9 * radius) * 2.0 / radius) {
            return After::MAIN;
        }
        const double floor_rate = st.g_section.x() * st.vx + st.g_section.y() * st.vy + st.g_s * st.vs;
        const double s = ray.arc(st), rho2 = st.rho * st.rho;
        const double turn = (st.vy * st.x - st.vx * st.y) / rho2 * radius;
        double by_s = 0.0, by_arc = 0.0;
        const double d = crack.distance(s, st.clock, 4.0 * w, &by_s, &by_arc);
        const bool side = d > w - tiny || steps > 1000, ground = st.g * 0.5 * radius > -tiny;
        if (side || ground) {
            const Eigen::Vector2d clockwise(-st.y / rho2 * radius, st.x / rho2 * radius);
            const Eigen::Vector3d normal =
                ground ? ray.gradient(st, st.g_section, st.g_s) : ray.gradient(st, by_arc * clockwise, by_s);
            walk.hit = {walk.t,          s,    st.clock,  -(local.rotation.transpose() * normal).normalized(),
                        Material::CRACK, part, walk.index};
            return After::SOLID;
        }
        const double bent = ray.bend() ? 4.0 / ray.segment.curvature_radius * (1.0 + radius / st.rho) : 0.0;
        const double speed = std::hypot(st.vs, turn), pull = 4.0 * radius / rho2 + bent;
        double h = safe_step(d - w, speed, pull);
        if (d > 0.25 * w) {
            h = std::max(h, safe_step(d - w, by_s * st.vs + by_arc * turn, pull + 4.0 * speed * speed / w));
        }
        h = std::min({h, safe_step(st.g, floor_rate, ray.relief_bound(ray.segment.bounds)), 0.3 * ray.segment.inner});
        int hop = 0;
        const double t_exit = ray.exit(walk.index<last, walk.index> 0, hop);
        if (walk.t + h < t_exit) {
            walk.t += h;
            continue;
        }
        walk.t = std::max(walk.t, t_exit);
        walk.index += hop;
        const SegmentRay next = ray_in(walk);
        RayState beyond{};
        next.place(walk.t, beyond);
        next.wall_with_reliefs(beyond, crack.depth());
        if (!beyond.inner && beyond.g * 0.5 * radius > -tiny) { // the next pipe's solid face
            const Eigen::Vector3d plane = hop > 0 ? ray.segment.end_normal : Eigen::Vector3d(-ray.segment.start_normal);
            walk.hit = {walk.t, s, st.clock, -(local.rotation.transpose() * plane), Material::CRACK, part, walk.index};
            return After::SOLID;
        }
    }
}

bool Tube::View::roots_before(const Eigen::Vector3d &o, const Eigen::Vector3d &d, bool any, Hit &hit) const
{
    bool found = false;
    for (size_t i = 0; i < bundles_.size() && !(any && found); i++) {
        double t = 0.0;
        Eigen::Vector3d normal;
        if (hit_bundle(bundles_[i], o, d, hit.t, 0.0, any, t, normal)) {
            const Root &root = tube_.roots_[i];
            hit = {t, root.s, root.clock, normal, Material::ROOT, static_cast<int>(i), hit.segment};
            found = true;
        }
    }
    return found;
}

bool Tube::View::trace(const Eigen::Vector3d &o, const Eigen::Vector3d &d, int start, bool with_water, Hit &hit) const
{
    constexpr int MAX_OPENINGS = 32;
    if (start < 0) {
        return false;
    }
    Walk walk;
    walk.o = o;
    walk.d = d;
    walk.index = start;
    walk.with_water = with_water;
    settle(walk);
    if (!march(walk) || !(walk.t > 0.0)) { // a hit at once: the origin is not inside
        return false;
    }
    for (int i = 0; i < MAX_OPENINGS && in_opening(walk); i++) {
        const After then = walk.branch >= 0 ? leave_branch(walk) : leave_crack(walk);
        if (then == After::MAIN && !march(walk)) {
            return false;
        }
    }
    hit = walk.hit;
    roots_before(o, d, false, hit);
    return true;
}

bool Tube::View::cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Hit &hit) const
{
    return trace(origin, direction, start_, true, hit);
}

bool Tube::View::see(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Sight &sight) const
{
    if (!trace(origin, direction, start_, true, sight.first)) {
        return false;
    }
    sight.mirrors = false;
    if (sight.first.material == Material::WATER) {
        sight.origin = origin + sight.first.t * direction;
        mirror(direction, sight);
    }
    return true;
}

// Ripples: four waves that run along the flow, a little across each other, as slopes of the surface. Fresnel's
// equations, the mean of both polarisations.
void Tube::View::mirror(const Eigen::Vector3d &d, Sight &sight) const
{
    constexpr int WAVES = 4;
    const size_t i = static_cast<size_t>(sight.first.part);
    const Water &water = tube_.water_[i];
    const WaterPlane &plane = water_[i];
    const double right = plane.right.dot(sight.origin) + plane.right_0;
    const double along = plane.along.dot(sight.origin) + plane.along_0;
    Eigen::Vector3d normal = sight.first.normal;
    for (int k = 0; k < WAVES; k++) {
        const auto random = [&](uint64_t what) {
            return uniform_of(hash64(water.seed, STREAM_RIPPLE, static_cast<uint64_t>(k), what));
        };
        const double length = water.ripple_length * std::pow(0.62, k), angle = 1.6 * (random(0) - 0.5);
        const double phase =
            TWO_PI *
            ((along * std::cos(angle) + right * std::sin(angle) - water.velocity * seconds_) / length + random(1));
        const double slope = water.ripple / WAVES * std::cos(phase);
        normal += slope * (std::cos(angle) * plane.along + std::sin(angle) * plane.right);
    }
    normal.normalize();
    if (d.dot(normal) > -1e-3 || (d - 2.0 * d.dot(normal) * normal).dot(sight.first.normal) < 1e-3) {
        normal = sight.first.normal; // so flat that the ripple would hide itself
    }
    sight.first.normal = normal;
    const double c = -d.dot(normal), n = water.refraction, inside = std::sqrt(1.0 - (1.0 - c * c) / (n * n));
    const double across = (c - n * inside) / (c + n * inside), within = (n * c - inside) / (n * c + inside);
    sight.mirrored = 0.5 * (across * across + within * within);
    sight.direction = d + 2.0 * c * normal;
    sight.mirrors = trace(sight.origin, sight.direction, sight.first.segment, false, sight.second);
}

bool Tube::View::blocked(const Eigen::Vector3d &from, const Eigen::Vector3d &to, bool roots_only) const
{
    const double distance = (to - from).norm(), most = distance * (1.0 - 1e-6);
    const Eigen::Vector3d direction = (to - from) / distance;
    Hit hit{};
    hit.t = most;
    return roots_only ? roots_before(from, direction, true, hit)
                      : !trace(from, direction, start_, true, hit) || hit.t < most;
}

const Eigen::Vector3d &Tube::View::branch_axis(Material material, int part) const
{
    return std::ranges::find_if(branches_, [&](const Branch &b) { return b.material == material && b.part == part; })
        ->axis;
}

bool Tube::View::near_roots(const Eigen::Vector3d &point) const
{
    return std::ranges::any_of(bundles_, [&](const Bundle &bundle) {
        const Ball &all = bundle.tree.front().around;
        return (point - all.centre).squaredNorm() < 4.0 * all.radius * all.radius;
    });
}

bool Tube::View::thin_near(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, const Hit &hit,
                           double pixel) const
{
    for (const Bundle &bundle : bundles_) {
        double t = 0.0;
        Eigen::Vector3d normal;
        if (hit_bundle(bundle, origin, direction, hit.t, 0.75 * pixel, true, t, normal)) {
            return true;
        }
    }
    if (hit.material > Material::DEPOSIT) {
        return false;
    }
    const size_t index = static_cast<size_t>(hit.segment);
    const Segment &segment = tube_.segments_[index];
    const double reach = 0.75 * pixel * hit.t / std::max(0.02, -hit.normal.dot(direction));
    const bool next = index + 1 < tube_.segments_.size() && tube_.segments_[index + 1].face;
    if ((segment.face && hit.s - segment.s0 < reach) || (next && segment.s0 + segment.length - hit.s < reach)) {
        return true;
    }
    for (const int i : segment.branches) {
        const Branch &b = branches_[static_cast<size_t>(i)];
        const Eigen::Vector3d p = origin + hit.t * direction - b.origin;
        if (p.dot(b.axis) > 0.0 && (p - p.dot(b.axis) * b.axis).norm() < b.radius + reach) {
            return true;
        }
    }
    return std::ranges::any_of(segment.cracks, [&](int i) { // across the footprint, which is long along the pipe
        const CrackPath &crack = tube_.cracks_[static_cast<size_t>(i)];
        double by_s = 0.0, by_arc = 0.0;
        const double d = crack.distance(hit.s, hit.clock, crack.half_width() + reach, &by_s, &by_arc);
        return d < crack.half_width() + std::hypot(by_s * reach, by_arc * 0.75 * pixel * hit.t);
    });
}

} // namespace pipefish::sim
