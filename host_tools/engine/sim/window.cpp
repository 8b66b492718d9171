#include "sim/window.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::sim
{

namespace
{

constexpr int BLOCK = 8;           // pixels a side of the blurred picture's cells
constexpr double MINIFY = -2.2;    // a drop shows this many times its own radius, upside down
constexpr double SCATTERED = 0.35; // share of the light that dirt takes and gives back as haze
constexpr uint64_t DROPS = STREAM_WINDOW, DIRT = STREAM_WINDOW + 1;

double soft_disc(double q, double edge) // 1 inside, 0 beyond 1
{
    const double t = std::clamp((1.0 - q) / edge, 0.0, 1.0);
    return t * t * (3.0 - 2.0 * t);
}

} // namespace

Window::Window(const WindowSpec &spec, int width, int height, double c_u, double c_v, double circle)
    : width_(width), height_(height)
{
    const auto spots = [&](uint64_t stream, int count, double largest, double edge, const auto &each) {
        for (int n = 0; n < count; n++) {
            const auto draw = [&](uint64_t k) {
                return uniform_of(hash64(spec.seed, stream, static_cast<uint64_t>(n), k));
            };
            const double away = circle * std::sqrt(draw(0)), angle = 2.0 * std::numbers::pi * draw(1);
            const double u = c_u + away * std::cos(angle), v = c_v + away * std::sin(angle);
            const double radius = largest * (1.0 + 2.0 * draw(2)) / 3.0, tone = draw(3), phase = 6.3 * draw(4);
            for (int y = std::max(0, static_cast<int>(v - 1.3 * radius)); y < height && y <= v + 1.3 * radius; y++) {
                for (int x = std::max(0, static_cast<int>(u - 1.3 * radius)); x < width && x <= u + 1.3 * radius; x++) {
                    const double bearing = std::atan2(y - v, x - u), q = std::hypot(x - u, y - v) / radius;
                    // Not quite round: three lobes and two.
                    const double shape =
                        1.0 + 0.12 * std::sin(3.0 * bearing + phase) + 0.1 * std::sin(2.0 * bearing - phase);
                    const double cover = soft_disc(q / shape, edge);
                    if (cover > 0.0 && std::hypot(x - c_u, y - c_v) < circle) {
                        each(static_cast<uint32_t>(y * width + x), cover, tone, x - u, y - v, u, v);
                    }
                }
            }
        }
    };
    spots(DIRT, spec.dirt, spec.dirt_radius, 0.9,
          [&](uint32_t pixel, double cover, double tone, double dx, double dy, double u, double v) {
              const double taken = spec.dirt_density * (0.3 + 0.7 * tone) * cover;
              touched_.push_back({pixel, static_cast<float>(1.0 - taken), static_cast<float>(SCATTERED * taken),
                                  static_cast<float>(u + dx), static_cast<float>(v + dy)});
          });
    spots(DROPS, spec.drops, spec.drop_radius, 0.35,
          [&](uint32_t pixel, double cover, double, double dx, double dy, double u, double v) {
              touched_.push_back({pixel, static_cast<float>(1.0 - cover), static_cast<float>(0.92 * cover),
                                  static_cast<float>(u + MINIFY * dx), static_cast<float>(v + MINIFY * dy)});
          });
}

void Window::apply(std::vector<float> &picture) const
{
    if (touched_.empty()) {
        return;
    }
    const int columns = (width_ + BLOCK - 1) / BLOCK, rows = (height_ + BLOCK - 1) / BLOCK;
    std::vector<float> blurred(static_cast<size_t>(columns) * static_cast<size_t>(rows), 0.0f);
    for (int y = 0; y < height_; y++) {
        const float *const line = picture.data() + static_cast<size_t>(y) * static_cast<size_t>(width_);
        float *const out = blurred.data() + static_cast<size_t>(y / BLOCK) * static_cast<size_t>(columns);
        const int high = std::min(BLOCK, height_ - y / BLOCK * BLOCK);
        for (int x = 0; x < width_; x++) {
            const int wide = std::min(BLOCK, width_ - x / BLOCK * BLOCK);
            out[x / BLOCK] += line[x] / static_cast<float>(wide * high);
        }
    }
    for (const Touched &t : touched_) {
        const float x = std::clamp((t.x + 0.5f) / BLOCK - 0.5f, 0.0f, static_cast<float>(columns - 1));
        const float y = std::clamp((t.y + 0.5f) / BLOCK - 0.5f, 0.0f, static_cast<float>(rows - 1));
        const int x0 = std::min(static_cast<int>(x), columns - 2), y0 = std::min(static_cast<int>(y), rows - 2);
        const float fx = x - static_cast<float>(x0), fy = y - static_cast<float>(y0);
        const float *const a = blurred.data() + static_cast<size_t>(y0) * static_cast<size_t>(columns) + x0;
        const float *const b = a + columns;
        const float top = a[0] + fx * (a[1] - a[0]), bottom = b[0] + fx * (b[1] - b[0]);
        float &own = picture[t.pixel];
        own = t.keep * own + t.take * (top + fy * (bottom - top));
    }
}

} // namespace pipefish::sim
