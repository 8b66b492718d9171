// Counter-based random numbers: every number is a pure function of (seed, stream, counter), so no result depends on the
// order of evaluation or on the number of threads.
#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>

namespace pipefish::sim
{

// SplitMix64's output function (Steele, Lea, Flood, OOPSLA 2014): a bijection with full avalanche.
inline uint64_t mix64(uint64_t x)
{
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

inline uint64_t hash64(uint64_t seed, uint64_t stream, uint64_t a, uint64_t b = 0)
{
    return mix64(mix64(mix64(seed ^ mix64(stream)) ^ a) ^ b);
}

// Uniform in [0, 1) from the top 53 bits.
inline double uniform_of(uint64_t bits)
{
    return static_cast<double>(bits >> 11) * 0x1p-53;
}

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
