// What the crawler's sensors say: wheel or cable encoder, inclinometer, clock, and which frames arrive.
#pragma once

#include "sim/motion.hpp"

#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct EncoderSlip {
    double at = 0.0, metres = 0.0; // once so much is driven since frame 0, the encoder has counted `metres` too many
};

struct TelemetrySpec {
    uint64_t seed = 1;
    double metres_per_count = 0.0005;
    double encoder_bias = 0.004;    // it counts (1 + bias) times the distance
    double encoder_noise = 0.0;     // counts, standard deviation of a reading
    double encoder_slip = 0.00224;  // its random walk, metres per square root of a metre (0.5 mm in 50 mm)
    double slip_rate = 0.0;         // sudden slips a metre driven, at random places
    double slip_m = 0.005;          // mean size of these, metres: uniform within half and one and a half of it
    std::vector<EncoderSlip> slips; // and some at stated places
    bool cable = false;             // it counts the cable that is pushed, not the camera's own way
    double attitude_sigma = 0.0035; // radians, of the inclinometer's roll and pitch
    double roll_bias = 0.0, pitch_bias = 0.0;
    double time_jitter_s = 0.0; // standard deviation of a time stamp
    double drop_rate = 0.0;     // chance that frames are lost from here on,
    int drop_longest = 1;       // as many as 1 to this, equally likely
};

struct Reading {
    bool dropped;    // the frame never arrives; the rest says what it would have come with
    int64_t time_ns; // since frame 0; increasing
    int64_t encoder_count;
    double roll, pitch; // radians
};

// One for each frame. Frame 0 always arrives.
std::vector<Reading> measure(const std::vector<FrameState> &frames, const TelemetrySpec &spec);

} // namespace pipefish::sim
