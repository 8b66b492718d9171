// Algebra of small blocks, column by column: the compiler finds vectors in Eigen's expressions of one column, which it
// does not in loops over its elements, and they are fewer types to read than those of whole products.
#pragma once

#include <Eigen/Core>

#include <cmath>

namespace pipefish::optim
{

// A column of a matrix shaped like C.
template <class C> using ColumnOf = Eigen::Matrix<double, C::RowsAtCompileTime, 1>;

// c += s a b, a with one column at least. Sums of products are made before they are added, here and below.
template <class C, class A, class B> void add_product(C &c, double s, const A &a, const B &b)
{
    for (Eigen::Index j = 0; j < c.cols(); j++) {
        ColumnOf<C> sum = a.col(0) * b(0, j);
        for (Eigen::Index k = 1; k < a.cols(); k++) {
            sum += a.col(k) * b(k, j);
        }
        c.col(j) += s * sum;
    }
}

// c += s a b^T, likewise
template <class C, class A, class B> void add_product_transposed(C &c, double s, const A &a, const B &b)
{
    for (Eigen::Index j = 0; j < c.cols(); j++) {
        ColumnOf<C> sum = a.col(0) * b(j, 0);
        for (Eigen::Index k = 1; k < a.cols(); k++) {
            sum += a.col(k) * b(j, k);
        }
        c.col(j) += s * sum;
    }
}

// c += s a^T b: products of columns, whose length is fixed.
template <class C, class A, class B> void add_transposed_product(C &c, double s, const A &a, const B &b)
{
    for (Eigen::Index j = 0; j < c.cols(); j++) {
        for (Eigen::Index i = 0; i < c.rows(); i++) {
            double sum = 0.0;
            for (int k = 0; k < A::RowsAtCompileTime; k++) {
                sum += a(k, i) * b(k, j);
            }
            c(i, j) += s * sum;
        }
    }
}

// c += s a^T b of `rows` rows, row-major: a has as many columns as c has rows, b as many as c. `rows`: int, or a
// constant of the type, which unrolls the loop.
template <class C, class Count> void add_rows(C &c, double s, Count rows, const double *a, const double *b)
{
    using Row = Eigen::Map<const ColumnOf<C>>;
    for (Eigen::Index j = 0; j < c.cols(); j++) {
        ColumnOf<C> sum = Row(a) * (s * b[j]);
        for (int k = 1; k < rows; k++) {
            sum += Row(a + k * C::RowsAtCompileTime) * (s * b[k * c.cols() + j]);
        }
        c.col(j) += sum;
    }
}

// The lower factor L of a = L L^T, in place; above the diagonal zero. False: a is not positive definite.
template <int N> bool cholesky(Eigen::Matrix<double, N, N> &a)
{
    for (int k = 0; k < N; k++) {
        double pivot = a(k, k);
        for (int j = 0; j < k; j++) {
            pivot -= a(k, j) * a(k, j);
            a(j, k) = 0.0;
        }
        if (!(pivot > 0.0)) {
            return false;
        }
        a(k, k) = std::sqrt(pivot);
        for (int i = k + 1; i < N; i++) {
            double rest = a(i, k);
            for (int j = 0; j < k; j++) {
                rest -= a(i, j) * a(k, j);
            }
            a(i, k) = rest / a(k, k);
        }
    }
    return true;
}

// x := L^-1 x
template <int N, class Columns> void solve_lower(const Eigen::Matrix<double, N, N> &l, Columns &x)
{
    for (Eigen::Index c = 0; c < x.cols(); c++) {
        for (int i = 0; i < N; i++) {
            double rest = x(i, c);
            for (int k = 0; k < i; k++) {
                rest -= l(i, k) * x(k, c);
            }
            x(i, c) = rest / l(i, i);
        }
    }
}

// x := L^-T x
template <int N, class Columns> void solve_lower_transposed(const Eigen::Matrix<double, N, N> &l, Columns &x)
{
    for (Eigen::Index c = 0; c < x.cols(); c++) {
        for (int i = N; i-- > 0;) {
            double rest = x(i, c);
            for (int k = i + 1; k < N; k++) {
                rest -= l(k, i) * x(k, c);
            }
            x(i, c) = rest / l(i, i);
        }
    }
}

// x := x L^-T
template <int N> void solve_from_right(const Eigen::Matrix<double, N, N> &l, Eigen::Matrix<double, N, N> &x)
{
    for (int j = 0; j < N; j++) {
        for (int i = 0; i < N; i++) {
            double rest = x(i, j);
            for (int k = 0; k < j; k++) {
                rest -= x(i, k) * l(j, k);
            }
            x(i, j) = rest / l(j, j);
        }
    }
}

} // namespace pipefish::optim
