// The angular error of a pair of rays (Oliensis, PAMI 2002, eq. 11), weighted: the least sum of squares, in standard
// deviations of the pixels, by which the two rays must turn to lie in one plane with the baseline.
#pragma once

#include "selfcal/lens.hpp"

namespace pipefish::selfcal
{

template <class T> Vec<T> cross(const Vec<T> &a, const Vec<T> &b)
{
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

template <class T> T dot(const Vec<T> &a, const Vec<T> &b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// sin_t, cos_t: of the angle from the axis; cos_p, sin_p: around it; rho: radius over f; rise = r'.
template <class T>
void fill_beam(const T &sin_t, const T &cos_t, const T &cos_p, const T &sin_p, const T &rho, const T &rise, const T &f,
               Beam<T> &beam)
{
    const T away = T(1.0) / (f * rise), around = sin_t / (f * rho), inward = cos_t * away;
    beam.ray = {sin_t * cos_p, sin_t * sin_p, cos_t};
    beam.away = {inward * cos_p, inward * sin_p, -sin_t * away};
    beam.around = {-around * sin_p, around * cos_p, T(0.0)};
}

// Signed error of a pair in pixels. one, two: beams of the two views, the first turned into the second's axes; t: unit
// baseline. With A, B of that paper for rays scaled by their spreads across the epipolar plane, the error's square is
// B / (A / 2 + sqrt(A^2 / 4 - B)), which keeps its digits where A / 2 - sqrt(A^2 / 4 - B) loses them all, and its root
// with the sign of e = t . (one x two) passes smoothly through zero. False: a ray along the baseline, which fits any
// plane.
template <class T> bool angular_error(const Beam<T> &one, const Beam<T> &two, const Vec<T> &t, T &error)
{
    constexpr double AT_EPIPOLE = 1e-6; // sin^2
    const Vec<T> q = cross(t, one.ray), p = cross(two.ray, t);
    const T qq = dot(q, q), pp = dot(p, p);
    if (value_of(qq) < AT_EPIPOLE || value_of(pp) < AT_EPIPOLE) {
        return false;
    }
    const T e = dot(p, one.ray);
    const T away1 = dot(one.away, p), around1 = dot(one.around, p), away2 = dot(two.away, q),
            around2 = dot(two.around, q);
    const T spread1 = away1 * away1 + around1 * around1, spread2 = away2 * away2 + around2 * around2;
    const T half = T(0.5) * (spread1 + spread2);
    const T rest = half * half - e * e * (spread1 * spread2 / (pp * qq));
    using std::sqrt;
    const T below = value_of(rest) > 1e-12 * value_of(half) * value_of(half) ? half + sqrt(rest) : half;
    error = e / sqrt(below);
    return true;
}

} // namespace pipefish::selfcal
