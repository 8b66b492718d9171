// Drawing a frame, in passes over its rows: cast rays and light the wall; read the surface through each pixel's
// footprint (needs the neighbours' rays); both again for every moment of the exposure; then the sensor (sensor.cpp).
#include "sim/scene.hpp"

#include "sim/buffers.hpp"
#include "sim/parallel.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::sim
{

namespace
{

constexpr int BAND = 8; // rows a work item

// Adds a small lamp at (lx, ly, 0): its intensity towards the wall point, Lambert's cosine, over the squared distance.
void add_lamp(const RowHits &row, std::vector<float> &light, float lx, float ly, float side, float forward)
{
    const size_t n = light.size();
    const float *const x = row.x.data(), *const y = row.y.data(), *const z = row.z.data();
    const float *const nx = row.nx.data(), *const ny = row.ny.data(), *const nz = row.nz.data();
    float *const sum = light.data();
    for (size_t i = 0; i < n; i++) {
        const float dx = lx - x[i], dy = ly - y[i], dz = -z[i];
        const float d2 = dx * dx + dy * dy + dz * dz, ahead = std::max(z[i], 0.0f);
        const float along = dx * nx[i] + dy * ny[i] + dz * nz[i];
        sum[i] += (side + forward * ahead * ahead / d2) * std::max(along, 0.0f) / (d2 * std::sqrt(d2));
    }
}

} // namespace

void Scene::render(int frame, int threads, void *out)
{
    const std::lock_guard<std::mutex> guard(rendering_);
    if (!buffers_) {
        prepare();
    }
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    const int bands = (spec_.lens.height + BAND - 1) / BAND;
    const auto each_row = [&](const auto &body) {
        parallel_for(bands, threads, [&](int band) {
            for (int y = band * BAND; y < std::min(spec_.lens.height, (band + 1) * BAND); y++) {
                body(y);
            }
        });
    };
    surface_->prepare(f.s - reach_.behind, f.s + reach_.ahead, threads);
    std::fill(buffers_->image.begin(), buffers_->image.end(), 0.0f);
    const int passes = exposures(frame);
    buffers_->share = 1.0f / static_cast<float>(passes);
    for (int k = 0; k < passes; k++) {
        const double late = spec_.sensor.exposure_s * ((k + 0.5) / passes - 0.5); // seconds after mid-exposure
        const CameraState camera = passes > 1 ? trajectory_.at(f.time + late) : static_cast<const CameraState &>(f);
        const Tube::View view(tube_, camera.world_from_cam, camera.centre);
        const auto draw = [&](int y, const Tube::View &from) {
            const RowHits hits = cast_row(from, y, *buffers_);
            light_row(y, hits, *buffers_);
        };
        each_row([&](int y) {
            if (spec_.sensor.line_time_s > 0.0) {
                const CameraState then = trajectory_.at(row_time(frame, y) + late);
                draw(y, Tube::View(tube_, then.world_from_cam, then.centre));
            } else {
                draw(y, view);
            }
        });
        each_row([&](int y) { shade_row(y, *buffers_); });
    }
    film_->blur(buffers_->image, buffers_->spare, threads);
    film_->develop(frame, buffers_->image, threads, out);
}

// As many as keep the image of the wall from moving more than half a pixel between two of them, wherever it is looked
// at.
int Scene::exposures(int frame) const
{
    constexpr int AROUND = 16, MOST = 64;
    constexpr double STEP = 0.5; // pixels
    const double exposure = spec_.sensor.exposure_s;
    if (!(exposure > 0.0)) {
        return 1;
    }
    double most = 0.0;
    for (int i = 0; i < AROUND; i++) {
        for (const double share : {0.4, 0.7, 0.85, 0.97}) {
            const double phi = 2.0 * std::numbers::pi * i / AROUND;
            const Lens::Image at = lens_.image(share * lens_.theta_max(), phi);
            const double px[2] = {spec_.lens.c_u + at.x, spec_.lens.c_v + at.y};
            const double time = row_time(frame, px[1]);
            double world[3], moved[2];
            if (cast_from(trajectory_.at(time - 0.5 * exposure), px, world) &&
                project_from(trajectory_.at(time + 0.5 * exposure), world, moved)) {
                most = std::max(most, std::hypot(moved[0] - px[0], moved[1] - px[1]));
            }
        }
    }
    return std::clamp(static_cast<int>(std::ceil(most / STEP)), 1, MOST);
}

// Light on a row's wall points, from a white wall.
void Scene::light_row(int row, const RowHits &hits, Buffers &buffers) const
{
    const size_t first = row_offset_[static_cast<size_t>(row)], n = hits.x.size();
    const LampSpec &lamp = spec_.lamp;
    std::vector<float> sum(n, 0.0f);
    for (int k = 0; k < lamp.lamps; k++) {
        const double angle = 2.0 * std::numbers::pi * k / lamp.lamps;
        add_lamp(hits, sum, static_cast<float>(lamp.ring_radius * std::sin(angle)),
                 static_cast<float>(-lamp.ring_radius * std::cos(angle)), static_cast<float>(lamp.side),
                 static_cast<float>(lamp.forward));
    }
    const double radius = 0.5 * spec_.diameter;
    const float exposure = static_cast<float>(lamp.exposure * radius * radius / lamp.lamps);
    for (size_t i = 0; i < n; i++) {
        buffers.light[first + i] = exposure * sum[i] * vignette_[first + i];
    }
}

void Scene::shade_row(int row, Buffers &buffers) const
{
    const int width = spec_.lens.width, height = spec_.lens.height;
    const float around = static_cast<float>(surface_->around());
    std::vector<float> line(static_cast<size_t>(width), 0.0f);
    // Index of the lit pixel (x, y), or of (x, row) itself where (x, y) is dark.
    const auto lit_or = [&](int x, int y, size_t own) {
        const size_t at = static_cast<size_t>(y);
        const bool lit = y >= 0 && y < height && x >= row_from_[at] && x < row_to_[at];
        return lit ? row_offset_[at] + static_cast<size_t>(x - row_from_[at]) : own;
    };
    const auto spread = [&](size_t a, size_t b, float steps, float &along, float &across) {
        if (steps == 0.0f) {
            return;
        }
        const float d_row = (buffers.texel_row[a] - buffers.texel_row[b]) / steps;
        float d_column = buffers.texel_column[a] - buffers.texel_column[b];
        d_column = (d_column - around * std::nearbyint(d_column / around)) / steps;
        along += d_row * d_row;
        across += d_column * d_column;
    };
    const size_t at = static_cast<size_t>(row);
    for (int x = row_from_[at]; x < row_to_[at]; x++) {
        const size_t own = row_offset_[at] + static_cast<size_t>(x - row_from_[at]);
        const size_t left = lit_or(x - 1, row, own), right = lit_or(x + 1, row, own);
        const size_t above = lit_or(x, row - 1, own), below = lit_or(x, row + 1, own);
        float along = 0.0f, across = 0.0f;
        spread(right, left, static_cast<float>((right != own) + (left != own)), along, across);
        spread(below, above, static_cast<float>((below != own) + (above != own)), along, across);
        line[static_cast<size_t>(x)] =
            buffers.light[own] *
            surface_->sample(buffers.texel_row[own], buffers.texel_column[own], std::sqrt(along), std::sqrt(across));
    }
    float *const out = buffers.image.data() + at * static_cast<size_t>(width);
    for (int x = 0; x < width; x++) {
        out[x] += buffers.share * line[static_cast<size_t>(x)];
    }
}

} // namespace pipefish::sim
