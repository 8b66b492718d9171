// Casting the rays of a frame: what every lit pixel sees, and where on the surface.
#include "sim/scene.hpp"

#include "sim/buffers.hpp"

#include <numbers>

namespace pipefish::sim
{

Scene::Place Scene::place(const Hit &hit) const
{
    double s = hit.s;
    if (hit.material == Material::LATERAL || hit.material == Material::HOLE) {
        const FeatureSpec &f = spec_.features;
        const size_t part = static_cast<size_t>(hit.part);
        s += hit.material == Material::LATERAL ? f.laterals[part].s : f.holes[part].s;
    }
    return {static_cast<float>((s - surface_->base()) / surface_->texel()),
            static_cast<float>(hit.clock * surface_->around() / (2.0 * std::numbers::pi))};
}

void Scene::cast_row(const Tube::View &view, int row, Buffers &buffers) const
{
    const size_t at = static_cast<size_t>(row), first = row_offset_[at];
    const size_t n = static_cast<size_t>(row_to_[at] - row_from_[at]);
    const double pixel = lens_.theta_max() / lens_.circle_radius(); // radians
    RowHits &out = buffers.hits[at];
    out = RowHits(n);
    for (size_t i = 0; i < n; i++) {
        const PixelRay &r = rays_[first + i];
        const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.dx, r.dy, r.dz);
        Sight sight{};
        if (!view.see(origin, direction, sight)) {
            buffers.seen[first + i] = Buffers::NOTHING;
            buffers.place[first + i] = {-1.0f, 0.0f};
            out.z[i] = 1.0f; // with a zero normal: black
            continue;
        }
        const Hit &hit = sight.first;
        buffers.seen[first + i] = Buffers::key(hit);
        buffers.thin[first + i] = view.thin_near(origin, direction, hit, pixel);
        buffers.place[first + i] = place(sight.mirrors ? sight.second : hit);
        out.x[i] = static_cast<float>(hit.t * r.dx);
        out.y[i] = static_cast<float>(hit.t * r.dy);
        out.z[i] = static_cast<float>(r.pupil + hit.t * r.dz);
        out.nx[i] = static_cast<float>(hit.normal.x());
        out.ny[i] = static_cast<float>(hit.normal.y());
        out.nz[i] = static_cast<float>(hit.normal.z());
        if (hit.material == Material::WATER) {
            out.water.push_back(sight);
        }
    }
}

} // namespace pipefish::sim
