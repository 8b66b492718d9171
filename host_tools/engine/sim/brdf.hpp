// How a wall throws light back: a matt part under a mirror-like one.
//
//   f pi = albedo (1 - R(n.l)) (1 - R(n.v)) + gloss pi D V F
//
// D: GGX (Walter et al., EGSR 2007); V: Smith's masking over 4 (n.l)(n.v), in the form
// 0.5 / lerp(2 (n.l)(n.v), n.l + n.v, alpha) (Hammon, GDC 2017); F: Fresnel by Schlick (1994), 4 % at normal incidence
// (index 1.5); R, what the mirror-like part takes from the matt one, is gloss times Schlick's law with the rise to
// grazing of a rough surface, 1 - alpha.
#pragma once

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

inline constexpr float F0 = 0.04f;

inline float power5(float x)
{
    const float x2 = x * x;
    return x2 * x2 * x;
}

// max(x, 0) without a branch, so that loops over it become vectors.
inline float positive(float x)
{
    return 0.5f * (x + std::fabs(x));
}

// What R gains from normal incidence to grazing: R(cos) = F0 + rise (1 - cos)^5.
inline float rise_of(float alpha)
{
    return std::max(1.0f - alpha, F0) - F0;
}

// pi D V F at the cosines n.l, n.v, l.v, all but the last at least 0; alpha2 = alpha^2 of D, alpha that of V.
inline float mirrored(float nl, float nv, float lv, float alpha2, float alpha)
{
    const float h2 = 2.000001f + 2.0f * lv, inverse = 1.0f / std::sqrt(h2); // h2 = |l + v|^2
    const float nh = (nl + nv) * inverse, vh = 0.5f * h2 * inverse;
    const float q = nh * nh * (alpha2 - 1.0f) + 1.0f;
    const float lambda = 2.0f * nl * nv + alpha * (nl + nv - 2.0f * nl * nv);
    return 0.5f * alpha2 / (q * q * lambda + 1e-12f) * (F0 + (1.0f - F0) * power5(1.0f - vh));
}

} // namespace pipefish::sim
