// The sensor: what becomes of the light that the optics lay on it.
#include "sim/buffers.hpp"
#include "sim/random.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

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
