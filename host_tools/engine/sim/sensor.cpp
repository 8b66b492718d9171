// The sensor: what becomes of the light that the optics lay on it.
#include "sim/sensor.hpp"
#include "parallel.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <string>
#include <turbojpeg.h>

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

Film::Film(const LensSpec &camera, double circle_radius, const SensorSpec &sensor, const ToneSpec &curve)
    : spec_(sensor), tone_(curve), width_(camera.width), height_(camera.height)
{
    make_blur_kernel();
    make_spread(camera, circle_radius);
    make_patterns();
}

void Film::make_blur_kernel()
{
    const double sigma = spec_.blur_px;
    const int reach = static_cast<int>(std::ceil(3.5 * sigma));
    double sum = 0.0;
    for (int k = -reach; k <= reach; k++) {
        sum += sigma > 0.0 ? std::exp(-0.5 * k * k / (sigma * sigma)) : 1.0;
    }
    for (int k = 0; k <= reach; k++) {
        blur_.push_back(static_cast<float>((sigma > 0.0 ? std::exp(-0.5 * k * k / (sigma * sigma)) : 1.0) / sum));
    }
}

// The lens's blur, share^2 rim_blur_px at the share of the field's edge, in variance share^4 rim_blur_px^2: a pass of
// [b, 1 - 2 b, b] adds 2 b, and b stays at most 1/4 where the kernel is near a Gaussian.
void Film::make_spread(const LensSpec &camera, double circle_radius)
{
    const double most = camera.rim_blur_px * camera.rim_blur_px;
    spreads_ = static_cast<int>(std::ceil(most / 0.5));
    for (int y = 0; y < camera.height && spreads_ > 0; y++) {
        for (int x = 0; x < camera.width; x++) {
            const double r = std::hypot(x - camera.c_u, y - camera.c_v) / circle_radius;
            const double share2 = std::min(r * r, 1.0);
            spread_.push_back(static_cast<float>(share2 * share2 * most / (2.0 * spreads_)));
        }
    }
}

void Film::make_patterns()
{
    const SensorSpec &sensor = spec_;
    const size_t n = static_cast<size_t>(width_) * static_cast<size_t>(height_);
    if (sensor.offset_pattern > 0.0 || sensor.gain_pattern > 0.0 || sensor.hot_pixels > 0.0) {
        for (size_t i = 0; i < n; i++) {
            const bool hot = uniform_of(hash64(sensor.seed, STREAM_PATTERN, i, 2)) < sensor.hot_pixels;
            const double heat = 20.0 + 235.0 * uniform_of(hash64(sensor.seed, STREAM_PATTERN, i, 3));
            offset_.push_back(static_cast<float>(sensor.offset_pattern * normal(sensor.seed, STREAM_PATTERN, 2 * i) +
                                                 (hot ? heat : 0.0)));
            gain_.push_back(
                static_cast<float>(1.0 + sensor.gain_pattern * normal(sensor.seed, STREAM_PATTERN, 2 * i + 1)));
        }
    }
}

void Film::blur(std::vector<float> &image, std::vector<float> &spare, int threads) const
{
    parallel_for(height_, threads, [&](int y) { blur_along_row(y, image); });
    parallel_for(height_, threads, [&](int y) { blur_across_row(y, image, spare); });
    std::swap(image, spare);
    for (int k = 0; k < spreads_; k++) {
        parallel_for(height_, threads, [&](int y) { spread_across_row(y, image, spare); });
        std::swap(image, spare);
    }
}

void Film::develop(int frame, const std::vector<float> &image, int threads, void *out) const
{
    parallel_for(height_, threads, [&](int y) { develop_row(frame, y, image, out); });
    if (spec_.jpeg_quality > 0) {
        compress(static_cast<uint8_t *>(out));
    }
}

// The blur that is the same everywhere, then the lens's. Beyond the sensor: dark.
void Film::blur_along_row(int row, std::vector<float> &image) const
{
    const size_t width = static_cast<size_t>(width_), first = static_cast<size_t>(row) * width;
    float *const out = image.data() + first;
    std::vector<float> line(out, out + width);
    for (size_t x = 0; x < width; x++) {
        out[x] = blur_[0] * line[x];
    }
    for (size_t k = 1; k < blur_.size(); k++) {
        const float weight = blur_[k];
        for (size_t x = 0; x + k < width; x++) {
            out[x] += weight * line[x + k];
            out[x + k] += weight * line[x];
        }
    }
    for (int pass = 0; pass < spreads_; pass++) {
        const float *const b = spread_.data() + first;
        std::copy(out, out + width, line.begin());
        out[0] += b[0] * (line[1] - 2.0f * line[0]);
        for (size_t x = 1; x + 1 < width; x++) {
            out[x] += b[x] * ((line[x - 1] - 2.0f * line[x]) + line[x + 1]);
        }
        out[width - 1] += b[width - 1] * (line[width - 2] - 2.0f * line[width - 1]);
    }
}

// From the image to the spare.
void Film::blur_across_row(int row, const std::vector<float> &image, std::vector<float> &spare) const
{
    const int height = height_, reach = static_cast<int>(blur_.size()) - 1;
    const size_t width = static_cast<size_t>(width_);
    float *const out = spare.data() + static_cast<size_t>(row) * width;
    std::fill(out, out + width, 0.0f);
    for (int k = -reach; k <= reach; k++) {
        if (row + k < 0 || row + k >= height) {
            continue;
        }
        const float weight = blur_[static_cast<size_t>(std::abs(k))];
        const float *const in = image.data() + static_cast<size_t>(row + k) * width;
        for (size_t x = 0; x < width; x++) {
            out[x] += weight * in[x];
        }
    }
}

void Film::spread_across_row(int row, const std::vector<float> &image, std::vector<float> &spare) const
{
    const size_t width = static_cast<size_t>(width_), first = static_cast<size_t>(row) * width;
    const std::vector<float> dark(width, 0.0f);
    const float *const in = image.data() + first, *const b = spread_.data() + first;
    const float *const above = row > 0 ? in - width : dark.data();
    const float *const below = row + 1 < height_ ? in + width : dark.data();
    float *const out = spare.data() + first;
    for (size_t x = 0; x < width; x++) {
        out[x] = in[x] + b[x] * ((above[x] - 2.0f * in[x]) + below[x]);
    }
}

void Film::develop_row(int frame, int row, const std::vector<float> &image, void *out) const
{
    const SensorSpec &sensor = spec_;
    const uint64_t key = hash64(sensor.seed, STREAM_PIXEL, static_cast<uint64_t>(frame));
    const uint32_t key_a = static_cast<uint32_t>(key), key_b = static_cast<uint32_t>(key >> 32);
    const float read = static_cast<float>(sensor.read_noise * sensor.read_noise),
                shot = static_cast<float>(sensor.shot_noise);
    const size_t width = static_cast<size_t>(width_), first = static_cast<size_t>(row) * width;
    std::vector<float> line(image.begin() + static_cast<std::ptrdiff_t>(first),
                            image.begin() + static_cast<std::ptrdiff_t>(first + width));
    if (!gain_.empty()) {
        for (size_t x = 0; x < width; x++) {
            line[x] = std::max(gain_[first + x] * line[x], 0.0f);
        }
    }
    for (size_t x = 0; x < width; x++) {
        const float noise = pixel_noise(static_cast<uint32_t>(first + x), key_a, key_b);
        line[x] += std::sqrt(read + shot * line[x]) * noise;
    }
    if (!offset_.empty()) {
        for (size_t x = 0; x < width; x++) {
            line[x] += offset_[first + x];
        }
    }
    for (float &grey : line) {
        grey = tone(tone_, grey);
    }
    if (sensor.bits > 8) {
        uint16_t *const pixels = static_cast<uint16_t *>(out) + first;
        const float most = static_cast<float>((1 << sensor.bits) - 1);
        const float levels = static_cast<float>(1 << (sensor.bits - 8));
        for (size_t x = 0; x < width; x++) {
            pixels[x] = static_cast<uint16_t>(std::min(std::max(levels * line[x] + 0.5f, 0.0f), most));
        }
        return;
    }
    uint8_t *const pixels = static_cast<uint8_t *>(out) + first;
    for (size_t x = 0; x < width; x++) {
        pixels[x] = static_cast<uint8_t>(std::min(std::max(line[x] + 0.5f, 0.0f), 255.0f));
    }
}

// Through a JPEG and back: blocking, ringing, and what the quantisation takes away.
void Film::compress(uint8_t *image) const
{
    const int width = width_, height = height_;
    const std::unique_ptr<void, int (*)(tjhandle)> encoder(tjInitCompress(), tjDestroy);
    const std::unique_ptr<void, int (*)(tjhandle)> decoder(tjInitDecompress(), tjDestroy);
    std::vector<unsigned char> bytes(tjBufSize(width, height, TJSAMP_GRAY));
    unsigned char *begin = bytes.data();
    unsigned long size = bytes.size();
    if (!encoder || !decoder ||
        tjCompress2(encoder.get(), image, width, width, height, TJPF_GRAY, &begin, &size, TJSAMP_GRAY,
                    spec_.jpeg_quality, TJFLAG_NOREALLOC | TJFLAG_ACCURATEDCT) != 0 ||
        tjDecompress2(decoder.get(), begin, size, image, width, width, height, TJPF_GRAY, TJFLAG_ACCURATEDCT) != 0) {
        throw std::runtime_error(std::string("JPEG: ") + tjGetErrorStr2(encoder.get()));
    }
}

} // namespace pipefish::sim
