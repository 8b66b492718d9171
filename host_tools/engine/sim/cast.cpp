// Casting the rays of a frame: what every lit pixel sees; and where its footprint meets several things or something
// thinner than itself, 16 rays instead of one.
#include "sim/scene.hpp"

#include "sim/buffers.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace pipefish::sim
{

namespace
{

constexpr int RAYS = 16; // of a pixel that is divided

// Reflectance in terms of the wall's, by material: what lies in grooves is dirt, behind holes soil.
constexpr std::array<float, 8> SHARE_OF_WALL = {1.0f, 0.7f, 0.75f, 0.5f, 0.6f, 0.9f, 0.0f, 0.0f};
constexpr float ROOT_ALBEDO = 0.34f;

} // namespace

void Scene::place_texel(const Hit &hit, size_t pixel, Buffers &buffers) const
{
    double s = hit.s;
    if (hit.material == Material::LATERAL || hit.material == Material::HOLE) {
        const FeatureSpec &f = spec_.features;
        const size_t part = static_cast<size_t>(hit.part);
        s += hit.material == Material::LATERAL ? f.laterals[part].s : f.holes[part].s;
    }
    buffers.texel_row[pixel] = static_cast<float>((s - surface_->base()) / surface_->texel());
    buffers.texel_column[pixel] = static_cast<float>(hit.clock * surface_->around() / (2.0 * std::numbers::pi));
}

void Scene::cast_row(const Tube::View &view, int row, Buffers &buffers) const
{
    const size_t first = row_offset_[static_cast<size_t>(row)];
    const size_t n = static_cast<size_t>(row_to_[static_cast<size_t>(row)] - row_from_[static_cast<size_t>(row)]);
    const double pixel = lens_.theta_max() / lens_.circle_radius(); // radians
    for (size_t i = first; i < first + n; i++) {
        const PixelRay &r = rays_[i];
        const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.dx, r.dy, r.dz);
        Hit &hit = buffers.hits[i];
        if (!view.cast(origin, direction, hit)) {
            buffers.seen[i] = Buffers::NOTHING;
            buffers.texel_row[i] = -1.0f;
            buffers.texel_column[i] = 0.0f;
            continue;
        }
        buffers.seen[i] = static_cast<uint32_t>(hit.material) << 24 | static_cast<uint32_t>(hit.part);
        buffers.thin[i] = view.thin_near(origin, direction, hit, pixel);
        place_texel(hit, i, buffers);
    }
}

void Scene::add_point(const Tube::View &view, const PixelRay &r, const Hit &hit, float weight, uint32_t pixel,
                      RowPoints &out) const
{
    const auto put = [&](const Eigen::Vector3d &at, const Hit &on, float textured, float plain) {
        out.x.push_back(static_cast<float>(at.x()));
        out.y.push_back(static_cast<float>(at.y()));
        out.z.push_back(static_cast<float>(at.z()));
        out.nx.push_back(static_cast<float>(on.normal.x()));
        out.ny.push_back(static_cast<float>(on.normal.y()));
        out.nz.push_back(static_cast<float>(on.normal.z()));
        out.textured.push_back(textured);
        out.plain.push_back(plain);
        out.pixel.push_back(pixel);
        const bool open =
            on.material == Material::WALL || on.material == Material::DEPOSIT || on.material == Material::WATER;
        out.shadow.push_back(open ? (view.near_roots(at) ? RowPoints::ROOTS : RowPoints::NONE)
                                  : (weight < 1.0f ? RowPoints::QUARTER : RowPoints::ALL));
    };
    const auto put_surface = [&](const Eigen::Vector3d &at, const Hit &on, float share) {
        put(at, on, share * SHARE_OF_WALL[static_cast<size_t>(on.material)],
            on.material == Material::ROOT ? share * ROOT_ALBEDO : 0.0f);
    };
    const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.dx, r.dy, r.dz);
    const Eigen::Vector3d at = origin + hit.t * direction;
    if (hit.material != Material::WATER) {
        put_surface(at, hit, weight);
        return;
    }
    Sight sight{};
    sight.first = hit;
    sight.origin = at;
    view.mirror(direction, sight);
    const float mirrored = static_cast<float>(sight.mirrored);
    const float body = static_cast<float>(spec_.features.water[static_cast<size_t>(hit.part)].body);
    put(at, sight.first, 0.0f, weight * (1.0f - mirrored) * body);
    if (sight.mirrors) {
        put_surface(at + sight.second.t * sight.direction, sight.second, weight * mirrored);
    }
}

RowPoints Scene::gather_row(const Tube::View &view, int row, Buffers &buffers) const
{
    const size_t at = static_cast<size_t>(row), first = row_offset_[at];
    RowPoints out;
    const auto differs = [&](int x, int y, uint32_t from) {
        const size_t line = static_cast<size_t>(y);
        return y >= 0 && y < spec_.lens.height && x >= row_from_[line] && x < row_to_[line] &&
               buffers.seen[row_offset_[line] + static_cast<size_t>(x - row_from_[line])] != from;
    };
    for (int x = row_from_[at]; x < row_to_[at]; x++) {
        const uint32_t index = static_cast<uint32_t>(x - row_from_[at]);
        const size_t own = first + index;
        const uint32_t seen = buffers.seen[own];
        const bool divided =
            seen != Buffers::NOTHING && (buffers.thin[own] || differs(x - 1, row, seen) || differs(x + 1, row, seen) ||
                                         differs(x, row - 1, seen) || differs(x, row + 1, seen));
        Hit hit = buffers.hits[own];
        if (!divided) {
            if (seen != Buffers::NOTHING) {
                add_point(view, rays_[own], hit, 1.0f, index, out);
            }
        } else {
            const size_t before = out.x.size();
            int rays = 0;
            for (int k = 0; k < RAYS; k++) {
                PixelRay r{};
                // Sixteen columns, sixteen rows (the bits reversed): a thin line along either is met by its share.
                const int turned = (k & 1) << 3 | (k & 2) << 1 | (k & 4) >> 1 | (k & 8) >> 3;
                const double px[2] = {x + (k + 0.5) / RAYS - 0.5, row + (turned + 0.5) / RAYS - 0.5};
                if (ray(px, r)) {
                    rays++;
                    if (view.cast({0.0, 0.0, r.pupil}, {r.dx, r.dy, r.dz}, hit)) {
                        add_point(view, r, hit, 1.0f / RAYS, index, out);
                    }
                }
            }
            for (size_t i = before; i < out.x.size(); i++) {
                out.textured[i] *= static_cast<float>(RAYS) / static_cast<float>(rays);
                out.plain[i] *= static_cast<float>(RAYS) / static_cast<float>(rays);
            }
        }
        if (seen >> 24 == static_cast<uint32_t>(Material::WATER)) { // the texture is that of what it mirrors
            const PixelRay &r = rays_[own];
            Sight sight{};
            sight.first = buffers.hits[own];
            sight.origin = Eigen::Vector3d(0.0, 0.0, r.pupil) + sight.first.t * Eigen::Vector3d(r.dx, r.dy, r.dz);
            view.mirror({r.dx, r.dy, r.dz}, sight);
            if (sight.mirrors) {
                place_texel(sight.second, own, buffers);
            }
        }
    }
    return out;
}

} // namespace pipefish::sim
