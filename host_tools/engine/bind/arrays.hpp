// Arrays for Python: made here, owned by NumPy, row-major. And what keeps those that come from there within bounds:
// pipefish's Python checks its arguments and names them; nothing that gets past it may reach the engine's memory.
#pragma once

#include <Eigen/Core>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <initializer_list>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

template <typename T> using Array = nanobind::ndarray<nanobind::numpy, T>;

// A ValueError with this text unless it holds.
inline void require(bool holds, const char *otherwise)
{
    if (!holds)
        throw std::invalid_argument(otherwise);
}

// Whether all values lie within `low` and `high`; NaN does not.
template <typename Given> bool all_within(const Given &given, double low, double high)
{
    return std::all_of(given.data(), given.data() + given.size(), [&](auto value) {
        return static_cast<double>(value) >= low && static_cast<double>(value) <= high;
    });
}

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
