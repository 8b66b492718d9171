// Counter-based random numbers: a value depends on its seed and index only, so results do not depend on threads.
#pragma once

#include <cstdint>

namespace pipefish::sim
{

// SplitMix64's finaliser (Steele, Lea & Flood 2014) of seed and index.
inline uint64_t hash64(uint64_t seed, uint64_t index)
{
    uint64_t z = seed * 0xD1342543DE82EF95u + index * 0x9E3779B97F4A7C15u + 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

// Uniform in [0, 1).
inline double uniform(uint64_t seed, uint64_t index)
{
    return static_cast<double>(hash64(seed, index) >> 11) * 0x1p-53;
}

// Normal to the eye and to four sigma: the sum of the four 16-bit parts of one hash, mean 0, variance 1.
inline double normal(uint64_t seed, uint64_t index)
{
    const uint64_t h = hash64(seed, index);
    const auto sum = static_cast<double>((h & 0xFFFF) + (h >> 16 & 0xFFFF) + (h >> 32 & 0xFFFF) + (h >> 48));
    return (sum - 2 * 65535.0) * (1.7320508075688772 / 65536.0);
}

} // namespace pipefish::sim
