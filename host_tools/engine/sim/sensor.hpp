// The sensor: shutter, noise, fixed patterns, bits.
#pragma once

#include <cstdint>

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

} // namespace pipefish::sim
