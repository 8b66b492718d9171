// Small sums and fits: four floats at a time, by the vector extension that gcc and clang share: sums in a fixed order
// on every machine.
#pragma once

#include <cstring>

namespace pipefish::match
{

using Float4 = float __attribute__((vector_size(16)));

inline Float4 load(const float *from)
{
    Float4 v;
    std::memcpy(&v, from, sizeof v);
    return v;
}

inline void store(float *to, Float4 v)
{
    std::memcpy(to, &v, sizeof v);
}

inline float total(Float4 v)
{
    return (v[0] + v[1]) + (v[2] + v[3]);
}

// Where the parabola through three values in a row has its maximum, from the middle one; 0 where it has none.
template <typename T> T vertex(T left, T middle, T right)
{
    const T bend = left - 2 * middle + right;
    return bend < 0 ? (left - right) / (2 * bend) : T(0);
}

} // namespace pipefish::match
