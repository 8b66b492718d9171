// Forward derivatives: a number with its derivatives by N unknowns.
#pragma once

#include <Eigen/Core>

#include <cmath>

namespace pipefish::selfcal
{

template <int N> struct Dual {
    double v = 0.0;
    Eigen::Matrix<double, N, 1> d = Eigen::Matrix<double, N, 1>::Zero();

    Dual() = default;
    Dual(double value) : v(value) {} // NOLINT: numbers mix with duals
    template <class Derived> Dual(double value, const Eigen::MatrixBase<Derived> &slope) : v(value), d(slope) {}

    friend Dual operator+(const Dual &a, const Dual &b) { return {a.v + b.v, a.d + b.d}; }
    friend Dual operator-(const Dual &a, const Dual &b) { return {a.v - b.v, a.d - b.d}; }
    friend Dual operator*(const Dual &a, const Dual &b) { return {a.v * b.v, a.v * b.d + b.v * a.d}; }
    friend Dual operator/(const Dual &a, const Dual &b)
    {
        const double inverse = 1.0 / b.v, ratio = a.v * inverse;
        return {ratio, inverse * (a.d - ratio * b.d)};
    }
    friend Dual operator-(const Dual &a) { return {-a.v, -a.d}; }
};

template <int N> Dual<N> sqrt(const Dual<N> &a)
{
    const double root = std::sqrt(a.v);
    return {root, 0.5 / root * a.d};
}

template <int N> double value_of(const Dual<N> &a)
{
    return a.v;
}
inline double value_of(double a)
{
    return a;
}

} // namespace pipefish::selfcal
