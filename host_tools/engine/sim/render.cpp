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
        prepare_shading(camera);
        const auto draw = [&](int y, const Tube::View &from) {
            buffers_->hits[static_cast<size_t>(y)] = cast_row(from, y, *buffers_);
        };
        each_row([&](int y) {
            if (spec_.sensor.line_time_s > 0.0) {
                const CameraState then = trajectory_.at(row_time(frame, y) + late);
                draw(y, Tube::View(tube_, then.world_from_cam, then.centre));
            } else {
                draw(y, view);
            }
        });
        each_row([&](int y) { shade_row(frame, y, *buffers_); });
    }
    shading_->window.apply(buffers_->image);
    each_row([&](int y) { blur_along_row(y, *buffers_); });
    each_row([&](int y) { blur_across_row(y, *buffers_); });
    std::swap(buffers_->image, buffers_->spare);
    for (int k = 0; k < spreads_; k++) {
        each_row([&](int y) { spread_across_row(y, *buffers_); });
        std::swap(buffers_->image, buffers_->spare);
    }
    each_row([&](int y) { develop_row(frame, y, *buffers_, out); });
    if (spec_.sensor.jpeg_quality > 0) {
        compress(static_cast<uint8_t *>(out));
    }
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

} // namespace pipefish::sim
