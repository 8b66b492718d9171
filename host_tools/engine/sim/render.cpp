// Drawing a frame, in three passes over its rows: cast rays and light the wall; read the surface through each pixel's
// footprint (needs the neighbours' rays) and blur along the rows; blur across them, add noise and encode.
#include "sim/scene.hpp"

#include "sim/buffers.hpp"
#include "sim/parallel.hpp"
#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::sim
{

namespace
{

constexpr int BAND = 8; // rows a work item

// Adds a small lamp at (lx, ly, 0): its intensity towards the wall point, Lambert's cosine, over the squared distance.
void add_lamp(const RowPoints &row, const std::vector<float> &lit, std::vector<float> &light, float lx, float ly,
              float side, float forward)
{
    const size_t n = light.size();
    const float *const x = row.x.data(), *const y = row.y.data(), *const z = row.z.data();
    const float *const nx = row.nx.data(), *const ny = row.ny.data(), *const nz = row.nz.data();
    const float *const share = lit.data();
    float *const sum = light.data();
    for (size_t i = 0; i < n; i++) {
        const float dx = lx - x[i], dy = ly - y[i], dz = -z[i];
        const float d2 = dx * dx + dy * dy + dz * dz, ahead = std::max(z[i], 0.0f);
        const float along = dx * nx[i] + dy * ny[i] + dz * nz[i];
        sum[i] += share[i] * (side + forward * ahead * ahead / d2) * std::max(along, 0.0f) / (d2 * std::sqrt(d2));
    }
}

uint32_t hash32(uint32_t x) // "lowbias32" of C. Wellons's search for 32-bit bijections with low bias
{
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    return x ^ (x >> 16);
}

// Standard normal number to a good approximation: the sum of 8 bytes (excess kurtosis -0.15, ends at 4.9 sigma).
float pixel_noise(uint32_t pixel, uint32_t key_a, uint32_t key_b)
{
    const uint32_t a = hash32(pixel ^ key_a), b = hash32(a + key_b);
    const uint32_t pairs = (a & 0x00ff00ffu) + ((a >> 8) & 0x00ff00ffu) + (b & 0x00ff00ffu) + ((b >> 8) & 0x00ff00ffu);
    const int sum = static_cast<int>((pairs & 0xffffu) + (pairs >> 16));
    return static_cast<float>(sum - 1020) * (1.0f / 209.02153f); // mean 8 * 127.5, variance 8 (256^2 - 1) / 12
}

} // namespace

void Scene::render(int frame, int threads, uint8_t *out)
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
    const Tube::View view = this->view(frame);
    each_row([&](int y) { cast_row(view, y, *buffers_); });
    each_row([&](int y) { light_row(view, y, *buffers_); });
    each_row([&](int y) { shade_row(y, *buffers_); });
    each_row([&](int y) { develop_row(frame, y, *buffers_, out); });
}

// Light on a row's wall points, from a white wall, and the grey levels of what has no texture.
void Scene::light_row(const Tube::View &view, int row, Buffers &buffers) const
{
    const RowPoints points = gather_row(view, row, buffers);
    const size_t first = row_offset_[static_cast<size_t>(row)], n = points.x.size();
    const LampSpec &lamp = spec_.lamp;
    std::vector<float> sum(n, 0.0f), lit(n, 1.0f);
    for (int k = 0; k < lamp.lamps; k++) {
        const double angle = 2.0 * std::numbers::pi * k / lamp.lamps;
        const float x = static_cast<float>(lamp.ring_radius * std::sin(angle));
        const float y = static_cast<float>(-lamp.ring_radius * std::cos(angle));
        for (size_t i = 0; i < n; i++) {
            const RowPoints::Shadow shadow = points.shadow[i];
            // Of a divided pixel's points each asks a quarter of the lamps, for all of them.
            const bool asked = shadow != RowPoints::QUARTER || (i + static_cast<size_t>(k)) % 4 == 0;
            if (shadow != RowPoints::NONE) {
                const bool dark = !asked || view.blocked({x, y, 0.0}, {points.x[i], points.y[i], points.z[i]},
                                                         shadow == RowPoints::ROOTS);
                lit[i] = dark ? 0.0f : shadow == RowPoints::QUARTER ? 4.0f : 1.0f;
            }
        }
        add_lamp(points, lit, sum, x, y, static_cast<float>(lamp.side), static_cast<float>(lamp.forward));
    }
    const double radius = 0.5 * spec_.diameter;
    const float exposure = static_cast<float>(lamp.exposure * radius * radius / lamp.lamps);
    const size_t width = static_cast<size_t>(row_to_[static_cast<size_t>(row)] - row_from_[static_cast<size_t>(row)]);
    std::fill_n(buffers.light.begin() + static_cast<std::ptrdiff_t>(first), width, 0.0f);
    std::fill_n(buffers.plain.begin() + static_cast<std::ptrdiff_t>(first), width, 0.0f);
    for (size_t i = 0; i < n; i++) {
        const size_t at = first + points.pixel[i];
        buffers.light[at] += exposure * sum[i] * vignette_[at] * points.textured[i];
        buffers.plain[at] += exposure * sum[i] * vignette_[at] * points.plain[i];
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
            buffers.plain[own] + buffers.light[own] * surface_->sample(buffers.texel_row[own],
                                                                       buffers.texel_column[own], std::sqrt(along),
                                                                       std::sqrt(across));
    }
    const int reach = static_cast<int>(blur_.size()) - 1;
    float *const out = buffers.image.data() + at * static_cast<size_t>(width);
    for (int x = 0; x < width; x++) {
        out[x] = blur_[0] * line[static_cast<size_t>(x)];
    }
    for (int k = 1; k <= reach; k++) { // beyond the sensor: dark
        const float weight = blur_[static_cast<size_t>(k)];
        for (int x = 0; x + k < width; x++) {
            out[x] += weight * line[static_cast<size_t>(x + k)];
            out[x + k] += weight * line[static_cast<size_t>(x)];
        }
    }
}

void Scene::develop_row(int frame, int row, const Buffers &buffers, uint8_t *out) const
{
    const SensorSpec &sensor = spec_.sensor;
    const int width = spec_.lens.width, height = spec_.lens.height, reach = static_cast<int>(blur_.size()) - 1;
    std::vector<float> line(static_cast<size_t>(width), 0.0f);
    for (int k = -reach; k <= reach; k++) {
        if (row + k < 0 || row + k >= height) {
            continue;
        }
        const float weight = blur_[static_cast<size_t>(std::abs(k))];
        const float *const in = buffers.image.data() + static_cast<size_t>(row + k) * static_cast<size_t>(width);
        for (int x = 0; x < width; x++) {
            line[static_cast<size_t>(x)] += weight * in[x];
        }
    }
    const uint64_t key = hash64(sensor.seed, STREAM_PIXEL, static_cast<uint64_t>(frame));
    const uint32_t key_a = static_cast<uint32_t>(key), key_b = static_cast<uint32_t>(key >> 32);
    const float read = static_cast<float>(sensor.read_noise * sensor.read_noise),
                shot = static_cast<float>(sensor.shot_noise);
    const uint32_t first = static_cast<uint32_t>(row) * static_cast<uint32_t>(width);
    uint8_t *const pixels = out + first;
    for (int x = 0; x < width; x++) {
        const float signal = line[static_cast<size_t>(x)];
        const float noise = pixel_noise(first + static_cast<uint32_t>(x), key_a, key_b);
        const float grey = signal + std::sqrt(read + shot * signal) * noise + 0.5f;
        pixels[x] = static_cast<uint8_t>(std::min(std::max(grey, 0.0f), 255.0f));
    }
}

} // namespace pipefish::sim
