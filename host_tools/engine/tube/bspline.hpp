// Uniform cubic B-splines.
#pragma once

#include <algorithm>
#include <array>

namespace pipefish::tube
{

struct Basis {
    int first;                           // control of the first weight
    std::array<double, 4> value, d1, d2; // weights, and their derivatives by u
};

// At u in [0, intervals]; beyond, the end intervals' polynomials go on.
inline Basis basis_at(double u, int intervals)
{
    const int i = std::clamp(static_cast<int>(u), 0, intervals - 1);
    const double t = u - i, t2 = t * t, t3 = t2 * t, q = 1.0 - t;
    return {
        i,
        {q * q * q / 6.0, (3.0 * t3 - 6.0 * t2 + 4.0) / 6.0, (-3.0 * t3 + 3.0 * t2 + 3.0 * t + 1.0) / 6.0, t3 / 6.0},
        {-q * q / 2.0, (3.0 * t2 - 4.0 * t) / 2.0, (-3.0 * t2 + 2.0 * t + 1.0) / 2.0, t2 / 2.0},
        {q, 3.0 * t - 2.0, -3.0 * t + 1.0, t}};
}

} // namespace pipefish::tube
