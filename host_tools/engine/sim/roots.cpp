#include "sim/roots.hpp"

#include "sim/random.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

constexpr int NODES = 10;                                     // cones a strand
constexpr double THINNEST = 0.2;                              // of a strand's diameter, at its end
constexpr double GRAVITY = 0.12;                              // pull on the direction, a cone
constexpr double RESTLESS = 0.28;                             // random change of direction, a cone
constexpr double BRANCH_LENGTH = 0.45, BRANCH_DIAMETER = 0.5; // of its strand's

Ball ball_around(const std::vector<RoundCone> &cones, size_t from, size_t to)
{
    Eigen::Vector3d low = cones[from].a, high = low;
    double thickest = 0.0;
    for (size_t i = from; i < to; i++) {
        low = low.cwiseMin(cones[i].a).cwiseMin(cones[i].b);
        high = high.cwiseMax(cones[i].a).cwiseMax(cones[i].b);
        thickest = std::max({thickest, cones[i].radius_a, cones[i].radius_b});
    }
    return {0.5 * (low + high), 0.5 * (high - low).norm() + thickest};
}

// May the ray touch what is in the ball, all radii being `grow` metres larger a metre of the way?
bool near_ball(const Ball &ball, const Eigen::Vector3d &o, const Eigen::Vector3d &d, double t_max, double grow)
{
    const Eigen::Vector3d to = ball.centre - o;
    const double along = to.dot(d), reach = ball.radius + grow * std::max(0.0, along + ball.radius);
    return along > -reach && along < t_max + reach && (to - along * d).squaredNorm() < reach * reach;
}

// The tree over the cones from `from` to `to`, halved where a limb (a first strand and its branches), a strand or a
// cone ends.
void plant(Bundle &bundle, size_t from, size_t to, size_t limb)
{
    const size_t self = bundle.tree.size(), count = to - from;
    bundle.tree.push_back({ball_around(bundle.cones, from, to), 0, count == 1 ? static_cast<int>(from) : -1});
    if (count > 1) {
        const size_t unit = count > limb ? limb : count > NODES ? static_cast<size_t>(NODES) : 1;
        const size_t middle = from + (count / unit + 1) / 2 * unit;
        plant(bundle, from, middle, limb);
        plant(bundle, middle, to, limb);
    }
    bundle.tree[self].skip = bundle.tree.size();
}

struct Grower {
    const Root &spec;
    const Eigen::Vector3d &down;
    std::vector<RoundCone> &out;
    uint64_t count = 0;

    double random() { return 2.0 * uniform_of(hash64(spec.seed, STREAM_ROOT, count++)) - 1.0; }

    Eigen::Vector3d random_vector()
    {
        const double x = random(), y = random(), z = random();
        return {x, y, z};
    }

    void strand(Eigen::Vector3d at, Eigen::Vector3d direction, double length, double diameter, int branches)
    {
        struct Fork {
            Eigen::Vector3d at, direction;
            double diameter;
        };
        std::vector<Fork> forks;
        int done = 0;
        for (int i = 0; i < NODES; i++) {
            const auto radius_at = [&](int k) { return 0.5 * diameter * (1.0 - (1.0 - THINNEST) * k / NODES); };
            direction = (direction + GRAVITY * down + RESTLESS * random_vector()).normalized();
            const Eigen::Vector3d next = at + length / NODES * direction;
            out.push_back({at, next, radius_at(i), radius_at(i + 1)});
            at = next;
            // Branches leave at the cones between a fifth and nine tenths of the strand, spread evenly.
            const int due = branches * std::max(0, i - 1) / (NODES - 2);
            for (; done < due; done++) {
                forks.push_back({at, (direction + 0.9 * random_vector()).normalized(), 2.0 * radius_at(i)});
            }
        }
        for (const Fork &fork : forks) {
            strand(fork.at, fork.direction, length * BRANCH_LENGTH, fork.diameter * BRANCH_DIAMETER, 0);
        }
    }
};

// The nearest t of the ray on one rounded cone, if it is in (0, best).
void hit_cone(const RoundCone &cone, const Eigen::Vector3d &o, const Eigen::Vector3d &d, double &best,
              Eigen::Vector3d &normal, bool &found)
{
    const auto sphere = [&](const Eigen::Vector3d &centre, double radius) {
        const Eigen::Vector3d p = o - centre;
        const double b = p.dot(d), c = (p - b * d).squaredNorm(), room = radius * radius - c;
        const double t = -b - std::sqrt(std::max(room, 0.0));
        if (room > 0.0 && t > 0.0 && t < best) {
            best = t;
            normal = (p + t * d) / radius;
            found = true;
        }
    };
    sphere(cone.a, cone.radius_a);
    sphere(cone.b, cone.radius_b);
    // Between them the common tangent cone: at y along the axis from a, its radius is k0 - k1 y.
    const Eigen::Vector3d axis = cone.b - cone.a, p = o - cone.a;
    const double length = axis.norm(), sine = (cone.radius_a - cone.radius_b) / length;
    if (!(std::abs(sine) < 1.0)) {
        return;
    }
    const Eigen::Vector3d w = axis / length;
    const double cosine = std::sqrt(1.0 - sine * sine), k0 = cone.radius_a / cosine, k1 = sine / cosine;
    const double y0 = p.dot(w), dy = d.dot(w), r0 = k0 - k1 * y0, dr = -k1 * dy;
    const Eigen::Vector3d q0 = p - y0 * w, dq = d - dy * w;
    const double a = dq.squaredNorm() - dr * dr, b = q0.dot(dq) - r0 * dr, c = q0.squaredNorm() - r0 * r0;
    const double root = b * b - a * c;
    if (root < 0.0 || a == 0.0) {
        return;
    }
    for (const double t : {(-b - std::sqrt(root)) / a, (-b + std::sqrt(root)) / a}) {
        const double y = y0 + t * dy;
        if (t > 0.0 && t < best && y >= cone.radius_a * sine && y <= length + cone.radius_b * sine) {
            best = t;
            normal = ((q0 + t * dq).normalized() * cosine + w * sine).normalized();
            found = true;
        }
    }
}

} // namespace

Bundle grow_roots(const Root &spec, const Eigen::Vector3d &base, const Eigen::Vector3d &inward,
                  const Eigen::Vector3d &down)
{
    Bundle bundle;
    Grower grower{spec, down, bundle.cones};
    for (int i = 0; i < spec.strands; i++) {
        const Eigen::Vector3d aside = spec.spread * grower.random_vector();
        const double share = 1.0 - 0.5 * i / spec.strands; // the first is the longest and thickest
        const Eigen::Vector3d start = base - spec.diameter * inward + 2.0 * spec.diameter * aside;
        grower.strand(start, (inward + aside).normalized(), spec.length * share, spec.diameter * share, spec.branches);
    }
    plant(bundle, 0, bundle.cones.size(), static_cast<size_t>(NODES * (1 + spec.branches)));
    return bundle;
}

Bundle moved(const Bundle &bundle, const Eigen::Matrix3d &rotation, const Eigen::Vector3d &origin)
{
    Bundle out = bundle;
    for (Twig &twig : out.tree) {
        twig.around.centre = rotation * (twig.around.centre - origin);
    }
    for (RoundCone &c : out.cones) {
        c.a = rotation * (c.a - origin);
        c.b = rotation * (c.b - origin);
    }
    return out;
}

bool hit_bundle(const Bundle &bundle, const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, double t_max,
                double grow, bool any, double &t, Eigen::Vector3d &normal)
{
    bool found = false;
    double best = t_max;
    for (size_t i = 0; i < bundle.tree.size() && !(any && found);) {
        const Twig &twig = bundle.tree[i];
        if (!near_ball(twig.around, origin, direction, best, grow)) {
            i = twig.skip;
            continue;
        }
        i++;
        if (twig.cone >= 0) {
            const RoundCone &cone = bundle.cones[static_cast<size_t>(twig.cone)];
            const double more = grow * std::max((twig.around.centre - origin).dot(direction), 0.0);
            hit_cone({cone.a, cone.b, cone.radius_a + more, cone.radius_b + more}, origin, direction, best, normal,
                     found);
        }
    }
    t = best;
    return found;
}

} // namespace pipefish::sim
