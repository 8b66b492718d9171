// Counter-based random numbers: every number is a pure function of (seed, stream, counter), so no result depends on the
// order of evaluation or on the number of threads.
#pragma once

#include <cstdint>

namespace pipefish
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

} // namespace pipefish
