// Arrays for Python: made here, owned by NumPy, row-major.
#pragma once

#include <Eigen/Core>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <initializer_list>
#include <memory>
#include <utility>
#include <vector>

template <typename T> using Array = nanobind::ndarray<nanobind::numpy, T>;

// Takes over what `data` holds.
template <typename T> Array<T> to_numpy(std::unique_ptr<T[]> data, std::initializer_list<size_t> shape)
{
    T *raw = data.get();
    const nanobind::capsule owner(data.release(), [](void *p) noexcept { delete[] static_cast<T *>(p); });
    return Array<T>(raw, shape, owner);
}

template <typename T> Array<T> to_numpy(std::vector<T> &&values, std::initializer_list<size_t> shape)
{
    auto kept = std::make_unique<std::vector<T>>(std::move(values));
    T *raw = kept->data();
    const nanobind::capsule owner(kept.release(), [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return Array<T>(raw, shape, owner);
}

// A copy.
template <typename T, typename In> Array<T> to_numpy(const In *data, std::initializer_list<size_t> shape)
{
    size_t n = 1;
    for (const size_t s : shape) {
        n *= s;
    }
    auto kept = std::make_unique<T[]>(std::max<size_t>(n, 1));
    std::copy(data, data + n, kept.get());
    return to_numpy(std::move(kept), shape);
}

template <typename Derived> Array<double> matrix_to_numpy(const Eigen::MatrixBase<Derived> &m)
{
    const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> rows = m;
    return to_numpy<double>(rows.data(), {static_cast<size_t>(rows.rows()), static_cast<size_t>(rows.cols())});
}
