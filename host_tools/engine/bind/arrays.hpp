// Arrays for Python.
#pragma once

#include <Eigen/Core>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <initializer_list>
#include <memory>

// A copy that NumPy owns, row-major.
template <typename T, typename In> nanobind::object to_numpy(const In *data, std::initializer_list<size_t> shape)
{
    size_t n = 1;
    for (const size_t s : shape) {
        n *= s;
    }
    auto kept = std::make_unique<T[]>(std::max<size_t>(n, 1));
    std::copy(data, data + n, kept.get());
    T *raw = kept.get();
    const nanobind::capsule owner(kept.release(), [](void *p) noexcept { delete[] static_cast<T *>(p); });
    return nanobind::cast(nanobind::ndarray<nanobind::numpy, T>(raw, shape, owner));
}

template <typename Derived> nanobind::object matrix_to_numpy(const Eigen::MatrixBase<Derived> &m)
{
    const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> rows = m;
    return to_numpy<double>(rows.data(), {static_cast<size_t>(rows.rows()), static_cast<size_t>(rows.cols())});
}
