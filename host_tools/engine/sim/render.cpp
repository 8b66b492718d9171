// Drawing a frame, in passes over its rows: cast rays; light what they met and read the surface through each pixel's
// footprint (needs the neighbours' rays); both again for every moment of the exposure; then the sensor (sensor.cpp).
#include "parallel.hpp"
#include "sim/scene.hpp"

#include "sim/buffers.hpp"

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
        const Gaze whole = gaze(f.time + late);
        prepare_shading(whole.camera);
        const auto each_view = [&](const auto &body) {
            each_row([&](int y) {
                if (spec_.sensor.line_time_s > 0.0) {
                    body(gaze(row_time(frame, y) + late).view, y);
                } else {
                    body(whole.view, y);
                }
            });
        };
        each_view([&](const Tube::View &view, int y) { cast_row(view, y, *buffers_); });
        each_view([&](const Tube::View &view, int y) { shade_row(frame, view, y, *buffers_); });
    }
    shading_->window.apply(buffers_->image);
    film_->blur(buffers_->image, buffers_->spare, threads);
    film_->develop(frame, buffers_->image, threads, out);
}

// As many as keep the image of the wall from moving more than half a pixel between two of them, wherever it is looked
// at. One, if it moves no more than three quarters in all: that blur has a sigma of 0.22 pixels, beside the optics'
// 0.55.
int Scene::exposures(int frame) const
{
    constexpr int AROUND = 16, MOST = 64;
    constexpr double STEP = 0.5, STILL = 0.75; // pixels
    const double exposure = spec_.sensor.exposure_s;
    if (!(exposure > 0.0)) {
        return 1;
    }
    double most = 0.0;
    std::optional<Gaze> before, after;
    for (int i = 0; i < AROUND; i++) {
        for (const double share : {0.4, 0.7, 0.85, 0.97}) {
            const double phi = 2.0 * std::numbers::pi * i / AROUND;
            const Lens::Image at = lens_.image(share * lens_.theta_max(), phi);
            const double px[2] = {spec_.lens.c_u + at.x, spec_.lens.c_v + at.y};
            if (!before || spec_.sensor.line_time_s > 0.0) {
                before.emplace(gaze(row_time(frame, px[1]) - 0.5 * exposure));
                after.emplace(gaze(row_time(frame, px[1]) + 0.5 * exposure));
            }
            Seen seen{};
            double moved[2];
            if (see_from(*before, px, seen) && project_from(after->camera, seen.point.data(), moved)) {
                most = std::max(most, std::hypot(moved[0] - px[0], moved[1] - px[1]));
            }
        }
    }
    return most <= STILL ? 1 : std::clamp(static_cast<int>(std::ceil(most / STEP)), 1, MOST);
}

} // namespace pipefish::sim
