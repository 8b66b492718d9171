// Casting the rays of a frame: where every lit pixel sees the wall.
#include "sim/scene.hpp"

#include "sim/buffers.hpp"

#include <numbers>

namespace pipefish::sim
{

RowHits Scene::cast_row(const Tube::View &view, int row, Buffers &buffers) const
{
    const size_t first = row_offset_[static_cast<size_t>(row)];
    const size_t n = static_cast<size_t>(row_to_[static_cast<size_t>(row)] - row_from_[static_cast<size_t>(row)]);
    const double texels_a_metre = 1.0 / surface_->texel(), base = surface_->base();
    const double texels_a_radian = surface_->around() / (2.0 * std::numbers::pi);
    RowHits out(n);
    for (size_t i = 0; i < n; i++) {
        const PixelRay &r = rays_[first + i];
        Hit hit{};
        if (!view.cast({0.0, 0.0, r.pupil}, {r.dx, r.dy, r.dz}, hit)) {
            buffers.texel_row[first + i] = -1.0f; // with a zero normal: black
            buffers.texel_column[first + i] = 0.0f;
            out.z[i] = 1.0f;
            continue;
        }
        buffers.texel_row[first + i] = static_cast<float>((hit.s - base) * texels_a_metre);
        buffers.texel_column[first + i] = static_cast<float>(hit.clock * texels_a_radian);
        out.x[i] = static_cast<float>(hit.t * r.dx);
        out.y[i] = static_cast<float>(hit.t * r.dy);
        out.z[i] = static_cast<float>(r.pupil + hit.t * r.dz);
        out.nx[i] = static_cast<float>(hit.normal.x());
        out.ny[i] = static_cast<float>(hit.normal.y());
        out.nz[i] = static_cast<float>(hit.normal.z());
    }
    return out;
}

} // namespace pipefish::sim
