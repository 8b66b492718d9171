// The sensor: shutter, blur, noise, fixed patterns, bits.
#pragma once

#include "sim/lens.hpp"
#include "sim/tone.hpp"

#include <cstdint>
#include <vector>

namespace pipefish::sim
{

// Grey levels are those of 8 bits, whatever `bits` says.
struct SensorSpec {
    uint64_t seed = 1;
    double blur_px = 0.55;       // pixels, standard deviation of the blur everywhere (optics and pixel)
    double exposure_s = 0.0;     // seconds; the picture is blurred by the camera's motion in that time
    double line_time_s = 0.0;    // seconds from a row's exposure to the next one's; 0 = global shutter
    double read_noise = 1.2;     // grey levels, standard deviation
    double shot_noise = 0.025;   // variance a grey level of signal
    double offset_pattern = 0.0; // grey levels, standard deviation over the pixels: the same in every frame
    double gain_pattern = 0.0;   // share of the signal, likewise
    double hot_pixels = 0.0;     // share of the pixels; each adds 20 to 255 grey levels of its own
    int bits = 8;                // of the output: 8 or 10
    int jpeg_quality = 0;        // of a JPEG that the frame goes through; 0 = none
};

// What becomes of the light that an ideal lens would lay on the sensor. Images are linear grey levels, height x width.
class Film
{
public:
    Film(const LensSpec &camera, double circle_radius, const SensorSpec &sensor, const ToneSpec &curve);

    // The sensor's blur and the lens's, in place; `spare` is of the same size.
    void blur(std::vector<float> &image, std::vector<float> &spare, int threads) const;
    // Noise, fixed pattern, tone, rounding, JPEG: out[height * width] uint8_t or, of more than 8 bits, uint16_t.
    void develop(int frame, const std::vector<float> &image, int threads, void *out) const;

private:
    void make_blur_kernel();
    void make_spread(const LensSpec &camera, double circle_radius);
    void make_patterns();
    void blur_along_row(int row, std::vector<float> &image) const;
    void blur_across_row(int row, const std::vector<float> &image, std::vector<float> &spare) const;
    void spread_across_row(int row, const std::vector<float> &image, std::vector<float> &spare) const;
    void develop_row(int frame, int row, const std::vector<float> &image, void *out) const;
    void compress(uint8_t *image) const;

    SensorSpec spec_;
    ToneSpec tone_;
    int width_, height_;
    std::vector<float> blur_;          // half kernel: weights of 0, 1, 2, ... pixels
    int spreads_ = 0;                  // passes of the kernel [b, 1 - 2 b, b] that add the lens's blur at the rim,
    std::vector<float> spread_;        // with this b, of every pixel
    std::vector<float> offset_, gain_; // fixed pattern, of every pixel; empty = none
};

} // namespace pipefish::sim
