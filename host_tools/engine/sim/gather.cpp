// From what the rays of a row met to the points that are lit: one a pixel; 16 where a pixel's footprint meets several
// things or something thinner than itself; with water, what it mirrors too.
#include "sim/scene.hpp"

#include "sim/buffers.hpp"
#include "sim/wide.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

constexpr int RAYS = 16; // of a pixel that is divided

// A wall's normal tilted by its relief: along the pipe's axis and clockwise.
inline Eigen::Vector3f tilted(const Texel &texel, const Eigen::Vector3f &normal, const Eigen::Vector3f &axis)
{
    const Eigen::Vector3f across = normal.cross(axis);
    const Eigen::Vector3f clockwise = across * (1.0f / std::sqrt(std::max(across.squaredNorm(), 1e-12f)));
    const Eigen::Vector3f along = clockwise.cross(normal);
    const Eigen::Vector3f n = normal - texel.slope_s * along - texel.slope_clock * clockwise;
    return n * (1.0f / std::sqrt(n.squaredNorm()));
}

} // namespace

// Dirt lies in joints and on what grew or settled, soil behind holes; a branch is of the pipe's material. Little of the
// light in the pipe gets into narrow openings.
void Scene::set_looks()
{
    const float mean = wall_look(spec_.texture).albedo;
    std::array<Shading::Look, 8> &looks = shading_->looks;
    const auto set = [&](Material material, const Shading::Look &look) { looks[static_cast<size_t>(material)] = look; };
    set(Material::WALL, {1.0f, 0.0f, 0.0f, 1.0f, true});
    set(Material::JOINT, {0.3f, 0.0f, 0.09f, 0.5f, false});
    set(Material::DEPOSIT, {0.22f / mean, 0.0f, 0.12f, 1.0f, true});
    set(Material::HOLE, {0.12f / mean, 0.0f, 0.25f, 1.0f, false});
    set(Material::CRACK, {0.5f, 0.0f, 0.25f, 0.2f, false});
    set(Material::LATERAL, {0.9f, 0.0f, 0.0f, 1.0f, true});
    set(Material::ROOT, {0.0f, 0.35f, 0.25f, 0.8f, false});
    // What light its surface mirrors is traced, but for the lamps' own; its body is murky.
    set(Material::WATER, {0.0f, 0.0f, 0.0009f, 0.0f, false});
}

PIPEFISH_WIDE void Scene::put(const Tube::View &view, const Met &met, const Texel &wall, size_t slot,
                              RowPoints &out) const
{
    const Shading::Look &look = shading_->looks[static_cast<size_t>(met.material)];
    Samples &to = out.samples;
    const bool branch = met.material == Material::LATERAL || met.material == Material::HOLE;
    double s = met.s; // the arc length
    float sky = look.sky;
    if (branch) {
        const bool lateral = met.material == Material::LATERAL;
        const size_t part = static_cast<size_t>(met.part);
        s = lateral ? spec_.features.laterals[part].s : spec_.features.holes[part].s;
        const double width = lateral ? spec_.features.laterals[part].diameter : spec_.features.holes[part].diameter;
        const double deep = std::max(met.s - 0.5 * spec_.diameter, 0.0) / (0.5 * width);
        sky /= static_cast<float>(1.0 + deep * deep); // what the opening's end takes of the view
    }
    to.x[slot] = met.at.x();
    to.y[slot] = met.at.y();
    to.z[slot] = met.at.z();
    to.vx[slot] = met.to_eye.x();
    to.vy[slot] = met.to_eye.y();
    to.vz[slot] = met.to_eye.z();
    if (look.relief && (wall.slope_s != 0.0f || wall.slope_clock != 0.0f)) {
        const Shading &now = *shading_;
        const double node =
            std::clamp((s - now.start) * now.per_metre, 0.0, static_cast<double>(now.axis.size()) - 1.0);
        to.set_normal(slot, tilted(wall, met.normal,
                                   branch ? view.branch_axis(met.material, met.part).cast<float>()
                                          : now.axis[static_cast<size_t>(node)]));
    } else {
        to.set_normal(slot, met.normal);
    }
    to.albedo[slot] = look.textured * wall.albedo + look.plain;
    to.alpha2[slot] = look.alpha2 > 0.0f ? look.alpha2 : wall.alpha2;
    to.along[slot] = static_cast<float>(s - out.camera_s);
    to.sky[slot] = sky;
    if (met.material == Material::WATER) {
        const double body = spec_.features.water[static_cast<size_t>(met.part)].body;
        to.albedo[slot] = (1.0f - met.mirrored) * static_cast<float>(body);
    }
    out.weight[slot] = met.weight;
    out.pixel[slot] = met.pixel;
    const bool open =
        met.material == Material::WALL || met.material == Material::DEPOSIT || met.material == Material::WATER;
    out.shadow[slot] = open ? (view.near_roots(met.at.cast<double>()) ? RowPoints::ROOTS : RowPoints::NONE)
                            : (met.weight < 1.0f ? RowPoints::QUARTER : RowPoints::ALL);
}

// The points of a ray: what it met, and what that mirrors. Without a footprint: on the plain wall.
void Scene::put_sight(const Tube::View &view, const PixelRay &r, const Sight &sight, const Footprint *size,
                      float weight, uint32_t pixel, RowPoints &out) const
{
    const WallLook plain = wall_look(spec_.texture);
    const auto add = [&](const Eigen::Vector3d &at, const Eigen::Vector3d &direction, const Hit &hit, float mirrored,
                         float share) {
        Texel wall{plain.albedo, plain.alpha * plain.alpha, 0.0f, 0.0f};
        if (size != nullptr && hit.material != Material::WATER) {
            const Place on = place(hit);
            wall = surface_->sample(on.row, on.column, size->along, size->across);
        }
        const Met met{at.cast<float>(),
                      hit.normal.cast<float>(),
                      (-direction).cast<float>(),
                      hit.material,
                      hit.part,
                      hit.s,
                      mirrored,
                      share,
                      pixel};
        put(view, met, wall, out.grow(), out);
    };
    const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.dx, r.dy, r.dz);
    const float mirrored = sight.first.material == Material::WATER ? static_cast<float>(sight.mirrored) : 0.0f;
    add(origin + sight.first.t * direction, direction, sight.first, mirrored, weight);
    if (sight.first.material == Material::WATER && sight.mirrors) {
        const Eigen::Vector3d at = sight.origin + sight.second.t * sight.direction;
        const double detour = sight.first.t + sight.second.t - at.norm(); // the fog's on the straight way comes later
        add(at, sight.direction, sight.second, 0.0f,
            weight * mirrored * static_cast<float>(std::exp(-spec_.fog.density * std::max(detour, 0.0))));
    }
}

void Scene::divide(const Tube::View &view, int x, int row, const Footprint &size, RowPoints &out) const
{
    const size_t before = out.weight.size();
    const uint32_t pixel = static_cast<uint32_t>(x - row_from_[static_cast<size_t>(row)]);
    int rays = 0;
    for (int k = 0; k < RAYS; k++) {
        PixelRay r{};
        // Sixteen columns, sixteen rows (the bits reversed): a thin line along either is met by its share.
        const int turned = (k & 1) << 3 | (k & 2) << 1 | (k & 4) >> 1 | (k & 8) >> 3;
        const double px[2] = {x + (k + 0.5) / RAYS - 0.5, row + (turned + 0.5) / RAYS - 0.5};
        Sight sight{};
        if (ray(px, r)) {
            rays++;
            if (view.see({0.0, 0.0, r.pupil}, {r.dx, r.dy, r.dz}, sight)) {
                put_sight(view, r, sight, &size, 1.0f / RAYS, pixel, out);
            }
        }
    }
    for (size_t i = before; i < out.weight.size(); i++) {
        out.weight[i] *= static_cast<float>(RAYS) / static_cast<float>(rays);
    }
}

// How many texels a pixel covers along and around, from its neighbours' places. Where one neighbour lies far away (an
// edge stands between), the other one counts.
PIPEFISH_WIDE Scene::Footprint Scene::footprint(int row, int x, size_t own, const Buffers &buffers) const
{
    const int height = spec_.lens.height;
    const float around = static_cast<float>(surface_->around());
    const auto step = [&](int at_x, int at_y, float &along, float &across) {
        const size_t at = static_cast<size_t>(at_y);
        if (at_y < 0 || at_y >= height || at_x < row_from_[at] || at_x >= row_to_[at]) {
            return -1.0f;
        }
        const size_t other = row_offset_[at] + static_cast<size_t>(at_x - row_from_[at]);
        along = buffers.place[other].row - buffers.place[own].row;
        across = buffers.place[other].column - buffers.place[own].column;
        across -= around * std::nearbyint(across / around);
        return along * along + across * across;
    };
    Footprint sum{0.0f, 0.0f};
    const auto direction = [&](int dx, int dy) {
        float along_a = 0.0f, across_a = 0.0f, along_b = 0.0f, across_b = 0.0f;
        const float a = step(x + dx, row + dy, along_a, across_a), b = step(x - dx, row - dy, along_b, across_b);
        if (a < 0.0f && b < 0.0f) {
            return;
        }
        constexpr float FAR = 16.0f; // four times the other's distance, squared
        float along, across;
        if (b < 0.0f || (a >= 0.0f && b > FAR * a)) {
            along = along_a, across = across_a;
        } else if (a < 0.0f || a > FAR * b) {
            along = along_b, across = across_b;
        } else {
            along = 0.5f * (along_a - along_b), across = 0.5f * (across_a - across_b);
        }
        sum.along += along * along;
        sum.across += across * across;
    };
    direction(1, 0);
    direction(0, 1);
    return {std::sqrt(sum.along), std::sqrt(sum.across)};
}

RowPoints Scene::gather_row(const Tube::View &view, int row, Buffers &buffers) const
{
    const size_t at = static_cast<size_t>(row), first = row_offset_[at];
    const size_t n = static_cast<size_t>(row_to_[at] - row_from_[at]);
    const RowHits &hits = buffers.hits[at];
    const double texel = surface_->texel(), base = surface_->base();
    RowPoints out(n, shading_->camera_s);
    const auto differs = [&](int x, int y, uint32_t from) {
        const size_t line = static_cast<size_t>(y);
        return y >= 0 && y < spec_.lens.height && x >= row_from_[line] && x < row_to_[line] &&
               buffers.seen[row_offset_[line] + static_cast<size_t>(x - row_from_[line])] != from;
    };
    size_t water = 0;
    for (size_t i = 0; i < n; i++) {
        const int x = row_from_[at] + static_cast<int>(i);
        const size_t own = first + i;
        const PixelRay &r = rays_[own];
        const uint32_t seen = buffers.seen[own];
        out.pixel[i] = static_cast<uint32_t>(i);
        if (seen == Buffers::NOTHING) {
            continue;
        }
        const Material material = static_cast<Material>(seen >> 24);
        const Footprint size = footprint(row, x, own, buffers);
        if (material == Material::WATER) {
            water++;
        }
        if (buffers.thin[own] || differs(x - 1, row, seen) || differs(x + 1, row, seen) || differs(x, row - 1, seen) ||
            differs(x, row + 1, seen)) {
            divide(view, x, row, size, out);
        } else if (material == Material::WATER) {
            put_sight(view, r, hits.water[water - 1], &size, 1.0f, out.pixel[i], out);
        } else {
            const Place on = buffers.place[own];
            const int part = static_cast<int>(seen & 0xffffffu);
            double s = base + static_cast<double>(on.row) * texel;
            if (material == Material::LATERAL || material == Material::HOLE) {
                const size_t k = static_cast<size_t>(part);
                s -= material == Material::LATERAL ? spec_.features.laterals[k].s : spec_.features.holes[k].s;
            }
            const Met met{{hits.x[i], hits.y[i], hits.z[i]},
                          {hits.nx[i], hits.ny[i], hits.nz[i]},
                          {static_cast<float>(-r.dx), static_cast<float>(-r.dy), static_cast<float>(-r.dz)},
                          material,
                          part,
                          s,
                          0.0f,
                          1.0f,
                          out.pixel[i]};
            put(view, met, surface_->sample(on.row, on.column, size.along, size.across), i, out);
        }
    }
    return out;
}

// Which lamps shine on the points that something may shade.
void Scene::find_shadows(const Tube::View &view, RowPoints &points) const
{
    const size_t n = points.shadow.size();
    if (std::ranges::all_of(points.shadow, [](RowPoints::Shadow s) { return s == RowPoints::NONE; })) {
        return;
    }
    Samples &p = points.samples;
    const std::vector<Lamp> &lamps = shading_->lighting.lamps;
    p.lit.assign(lamps.size() * n, 1.0f);
    for (size_t k = 0; k < lamps.size(); k++) {
        const Eigen::Vector3f lamp(lamps[k].x, lamps[k].y, lamps[k].z);
        for (size_t i = 0; i < n; i++) {
            const RowPoints::Shadow shadow = points.shadow[i];
            if (shadow == RowPoints::NONE) {
                continue;
            }
            // Of a divided pixel's points each asks a quarter of the lamps, for all of them.
            const bool asked = shadow != RowPoints::QUARTER || (i + k) % 4 == 0;
            const Eigen::Vector3f at(p.x[i], p.y[i], p.z[i]);
            const bool dark =
                !asked || view.blocked(lamp.cast<double>(), at.cast<double>(), shadow == RowPoints::ROOTS);
            p.lit[k * n + i] = dark ? 0.0f : shadow == RowPoints::QUARTER ? 4.0f : 1.0f;
        }
    }
}

} // namespace pipefish::sim
