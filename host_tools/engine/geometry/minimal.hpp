// Minimal solvers on unit rays, anywhere on the sphere.
#pragma once

#include "geometry/sight.hpp"

#include <array>

namespace pipefish::geometry
{

template <typename T, size_t Capacity> struct Few { // a short list without a heap
    std::array<T, Capacity> item;
    size_t count = 0;

    void add(const T &value)
    {
        if (count < Capacity) {
            item[count++] = value;
        }
    }
    const T *begin() const { return item.data(); }
    const T *end() const { return item.data() + count; }
};

// Real roots within [-1, 1] of p[0] + p[1] x + .. + p[degree] x^degree, degree <= 10, ascending.
Few<double, 10> roots_in_unit(const double *p, int degree);

// Essential matrices E, f2^T E f1 = 0 for five pairs of rays (Nister, PAMI 2004).
Few<Matrix3d, 10> five_point(const std::array<Vector3d, 5> &f1, const std::array<Vector3d, 5> &f2);

// The two rotations and the direction +-t (unit) of E.
struct Decomposition {
    Matrix3d r[2];
    Vector3d t;
};
Decomposition decompose_essential(const Matrix3d &e);

// Poses from three rays f[i] (from the camera's centre) to points x[i] (Persson and Nordberg, ECCV 2018).
Few<Pose, 4> three_point(const std::array<Vector3d, 3> &f, const std::array<Vector3d, 3> &x);

// The rotation r that takes f1[i] to f2[i], i = 0, 1, as nearly as it can.
Matrix3d two_point_rotation(const std::array<Vector3d, 2> &f1, const std::array<Vector3d, 2> &f2);

} // namespace pipefish::geometry
