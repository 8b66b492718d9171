// The simulator's random numbers: normal ones, and the streams in use.
#pragma once

#include "counter_random.hpp"

#include <cmath>
#include <cstdint>
#include <numbers>

namespace pipefish::sim
{

// Standard normal number `counter` of a stream (Box and Muller).
inline double normal(uint64_t seed, uint64_t stream, uint64_t counter)
{
    const double u = 1.0 - uniform_of(hash64(seed, stream, counter, 0));
    const double v = uniform_of(hash64(seed, stream, counter, 1));
    return std::sqrt(-2.0 * std::log(u)) * std::cos(2.0 * std::numbers::pi * v);
}

// Streams in use; a number is never reused for something else, or old scenes would change.
enum Stream : uint64_t {
    STREAM_WOBBLE = 1,
    STREAM_SLIP = 2,
    STREAM_ROLL = 3,
    STREAM_PITCH = 4,
    STREAM_PIXEL = 5,
    STREAM_WALK = 20,
    STREAM_STICK = 21,
    STREAM_ENCODER = 22,
    STREAM_CLOCK = 23,
    STREAM_DROP = 24,
    STREAM_SLIP_EVENT = 25,
    STREAM_PATTERN = 26,
    STREAM_JOINT = 30,
    STREAM_GRAIN = 31,
    STREAM_CRACK = 32,
    STREAM_ROOT = 33,
    STREAM_RIPPLE = 34,
    STREAM_WINDOW = 40, // and 41
    STREAM_ROUNDING = 42,
    STREAM_STUDIO = 60,
    STREAM_PRINT = 100,    // to 163: one an octave of a pattern, and its blots
    STREAM_SURFACE = 1000, // and up: one a layer of the surface
};

} // namespace pipefish::sim
