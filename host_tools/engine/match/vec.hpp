// Small sums and fits: four floats at a time, by the vector extension that gcc and clang share: sums in a fixed order
// on every machine.
#pragma once

#include <cstdint>
#include <cstring>

namespace pipefish::match
{

using Float4 = float __attribute__((vector_size(16)));
using Int4 = int32_t __attribute__((vector_size(16)));

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

inline Int4 truncated(Float4 v)
{
    return __builtin_convertvector(v, Int4);
}

inline Float4 floats(Int4 v)
{
    return __builtin_convertvector(v, Float4);
}

// k, k + 1, k + 2, k + 3
inline Float4 counted(int k)
{
    return floats(Int4{k, k + 1, k + 2, k + 3});
}

// 1 for the first `count` of four, 0 for the others: what is left of a row in its last Float4.
inline Float4 first_of(int count)
{
    Float4 v = {};
    for (int k = 0; k < count; k++)
        v[k] = 1;
    return v;
}

// Rows become columns.
inline void transpose(Float4 (&v)[4])
{
    const Float4 a = __builtin_shufflevector(v[0], v[1], 0, 4, 1, 5),
                 b = __builtin_shufflevector(v[2], v[3], 0, 4, 1, 5);
    const Float4 c = __builtin_shufflevector(v[0], v[1], 2, 6, 3, 7),
                 d = __builtin_shufflevector(v[2], v[3], 2, 6, 3, 7);
    v[0] = __builtin_shufflevector(a, b, 0, 1, 4, 5);
    v[1] = __builtin_shufflevector(a, b, 2, 3, 6, 7);
    v[2] = __builtin_shufflevector(c, d, 0, 1, 4, 5);
    v[3] = __builtin_shufflevector(c, d, 2, 3, 6, 7);
}

// The two values at p, and the two at q.
inline Float4 pairs(const float *p, const float *q)
{
    double two[2];
    std::memcpy(&two[0], p, sizeof two[0]);
    std::memcpy(&two[1], q, sizeof two[1]);
    Float4 v;
    std::memcpy(&v, two, sizeof v);
    return v;
}

// Where the parabola through three values in a row has its maximum, from the middle one; 0 where it has none.
template <typename T> T vertex(T left, T middle, T right)
{
    const T bend = left - 2 * middle + right;
    return bend < 0 ? (left - right) / (2 * bend) : T(0);
}

} // namespace pipefish::match
