#include "geometry/minimal.hpp"

#include "linalg/linalg.hpp"

#include <Eigen/LU>
#include <Eigen/QR>

#include <cmath>

namespace pipefish::geometry
{

namespace
{

double evaluate(const double *p, int degree, double x)
{
    double value = p[degree];
    for (int i = degree; i-- > 0;) {
        value = value * x + p[i];
    }
    return value;
}

// The root of p, with derivative d, between lo and hi, where p changes its sign.
double bracketed_root(const double *p, const double *d, int degree, double lo, double hi, double at_lo)
{
    double x = 0.5 * (lo + hi);
    for (int i = 0; i < 60; i++) {
        const double value = evaluate(p, degree, x);
        ((value > 0.0) == (at_lo > 0.0) ? lo : hi) = x;
        double next = x - value / evaluate(d, degree - 1, x);
        if (!(next > lo && next < hi)) {
            next = 0.5 * (lo + hi);
        }
        if (std::abs(next - x) <= 1e-15) {
            return next;
        }
        x = next;
    }
    return x;
}

// Polynomials in x, y, z: of degree 1 (x y z 1), 2 (10 terms), 3 (20 terms, in Nister's order of elimination).
using Linear = std::array<double, 4>;
using Quadratic = std::array<double, 10>;
using Cubic = std::array<double, 20>;

// Quadratic terms: x2 xy xz x y2 yz y z2 z 1.
constexpr int PRODUCT2[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
// Cubic terms: x3 y3 x2y xy2 x2z x2 y2z y2 xyz xy | xz2 xz x yz2 yz y z3 z2 z 1.
constexpr int PRODUCT3[10][4] = {
    {0, 2, 4, 5},   {2, 3, 8, 9},   {4, 8, 10, 11},   {5, 9, 11, 12},   {3, 1, 6, 7},
    {8, 6, 13, 14}, {9, 7, 14, 15}, {10, 13, 16, 17}, {11, 14, 17, 18}, {12, 15, 18, 19},
};

void add_product(Quadratic &sum, const Linear &a, const Linear &b, double factor = 1.0)
{
    for (size_t i = 0; i < 4; i++) {
        for (size_t j = 0; j < 4; j++) {
            sum[static_cast<size_t>(PRODUCT2[i][j])] += factor * a[i] * b[j];
        }
    }
}

void add_product(Cubic &sum, const Quadratic &a, const Linear &b)
{
    for (size_t i = 0; i < 10; i++) {
        for (size_t j = 0; j < 4; j++) {
            sum[static_cast<size_t>(PRODUCT3[i][j])] += a[i] * b[j];
        }
    }
}

using Constraints = Eigen::Matrix<double, 10, 20, Eigen::RowMajor>;

// det E = 0 and 2 E E^T E - tr(E E^T) E = 0 for E = x X + y Y + z Z + W.
Constraints essential_constraints(const Linear (&e)[3][3])
{
    Quadratic gram[3][3] = {};
    for (int i = 0; i < 3; i++) {
        for (int j = i; j < 3; j++) {
            for (int k = 0; k < 3; k++) {
                add_product(gram[i][j], e[i][k], e[j][k]);
            }
            gram[j][i] = gram[i][j];
        }
    }
    for (size_t q = 0; q < 10; q++) {
        const double half_trace = 0.5 * (gram[0][0][q] + gram[1][1][q] + gram[2][2][q]);
        for (int i = 0; i < 3; i++) {
            gram[i][i][q] -= half_trace;
        }
    }
    Constraints m;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            Cubic sum{};
            for (int k = 0; k < 3; k++) {
                add_product(sum, gram[i][k], e[k][j]);
            }
            m.row(3 * i + j) = Eigen::Map<const Eigen::RowVectorXd>(sum.data(), 20);
        }
    }
    Cubic determinant{};
    for (int k = 0; k < 3; k++) {
        Quadratic minor{};
        add_product(minor, e[1][(k + 1) % 3], e[2][(k + 2) % 3]);
        add_product(minor, e[1][(k + 2) % 3], e[2][(k + 1) % 3], -1.0);
        add_product(determinant, minor, e[0][k]);
    }
    m.row(9) = Eigen::Map<const Eigen::RowVectorXd>(determinant.data(), 20);
    return m;
}

// Rows 4 to 9 of the reduced system; false where it has no pivot.
bool eliminate(Constraints &m)
{
    for (int column = 0; column < 10; column++) {
        int pivot = column;
        for (int row = column + 1; row < 10; row++) {
            if (std::abs(m(row, column)) > std::abs(m(pivot, column))) {
                pivot = row;
            }
        }
        if (!(std::abs(m(pivot, column)) > 1e-14)) {
            return false;
        }
        m.row(column).swap(m.row(pivot));
        const double inverse = 1.0 / m(column, column);
        for (int c = column; c < 20; c++) {
            m(column, c) *= inverse;
        }
        // Rows 0 to 3 are not needed in reduced form.
        for (int row = 4; row < 10; row++) {
            const double factor = m(row, column);
            if (row != column && factor != 0.0 && (row > column || column >= 4)) {
                for (int c = column; c < 20; c++) {
                    m(row, c) -= factor * m(column, c);
                }
            }
        }
        for (int row = column + 1; row < 4; row++) {
            const double factor = m(row, column);
            for (int c = column; c < 20; c++) {
                m(row, c) -= factor * m(column, c);
            }
        }
    }
    return true;
}

using Poly = std::array<double, 11>;

void add_poly_product(Poly &sum, const Poly &a, int degree_a, const Poly &b, int degree_b, double sign)
{
    for (int i = 0; i <= degree_a; i++) {
        for (int j = 0; j <= degree_b; j++) {
            sum[static_cast<size_t>(i + j)] += sign * a[static_cast<size_t>(i)] * b[static_cast<size_t>(j)];
        }
    }
}

} // namespace

// Between neighbouring roots of the derivative a polynomial has at most one: from the linear derivative upwards.
Few<double, 10> roots_in_unit(const double *p, int degree)
{
    double derivative[11][11];
    std::copy(p, p + degree + 1, derivative[degree]);
    for (int d = degree; d-- > 0;) {
        for (int i = 0; i <= d; i++) {
            derivative[d][i] = (i + 1) * derivative[d + 1][i + 1];
        }
    }
    Few<double, 10> roots;
    for (int d = 1; d <= degree; d++) {
        Few<double, 10> found;
        double lo = -1.0, at_lo = evaluate(derivative[d], d, lo);
        for (size_t i = 0; i <= roots.count; i++) {
            const double hi = i < roots.count ? roots.item[i] : 1.0;
            const double at_hi = evaluate(derivative[d], d, hi);
            if ((at_lo > 0.0) != (at_hi > 0.0)) {
                found.add(bracketed_root(derivative[d], derivative[d - 1], d, lo, hi, at_lo));
            }
            lo = hi;
            at_lo = at_hi;
        }
        roots = found;
    }
    return roots;
}

Few<Matrix3d, 10> five_point(const std::array<Vector3d, 5> &f1, const std::array<Vector3d, 5> &f2)
{
    Few<Matrix3d, 10> solutions;
    Eigen::Matrix<double, 9, 5> equations;
    for (int k = 0; k < 5; k++) {
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) {
                equations(3 * i + j, k) = f2[static_cast<size_t>(k)][i] * f1[static_cast<size_t>(k)][j];
            }
        }
    }
    const Eigen::HouseholderQR<Eigen::Matrix<double, 9, 5>> qr(equations);
    const Eigen::Matrix<double, 9, 4> null = qr.householderQ() * Eigen::Matrix<double, 9, 9>::Identity().rightCols<4>();
    Linear e[3][3];
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            e[i][j] = {null(3 * i + j, 0), null(3 * i + j, 1), null(3 * i + j, 2), null(3 * i + j, 3)};
        }
    }
    Constraints m = essential_constraints(e);
    if (!eliminate(m)) {
        return solutions;
    }
    // Three equations b[r][0](z) x + b[r][1](z) y + b[r][2](z) = 0.
    Poly b[3][3] = {};
    for (int r = 0; r < 3; r++) {
        const auto upper = m.row(4 + 2 * r), lower = m.row(5 + 2 * r);
        for (int part = 0; part < 3; part++) {
            const int first = 10 + 3 * part, terms = part < 2 ? 3 : 4;
            for (int i = 0; i < terms; i++) { // from the highest power of z down
                const size_t power = static_cast<size_t>(terms - 1 - i);
                b[r][part][power] += upper[first + i];
                b[r][part][power + 1] -= lower[first + i];
            }
        }
    }
    Poly determinant{};
    Poly cross[3] = {}; // b[0] x b[1], degrees 7, 7, 6
    for (int k = 0; k < 3; k++) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const int degree_i = i < 2 ? 3 : 4, degree_j = j < 2 ? 3 : 4;
        add_poly_product(cross[k], b[0][i], degree_i, b[1][j], degree_j, 1.0);
        add_poly_product(cross[k], b[0][j], degree_j, b[1][i], degree_i, -1.0);
        add_poly_product(determinant, cross[k], degree_i + degree_j, b[2][k], k < 2 ? 3 : 4, 1.0);
    }
    const auto take = [&](double z) {
        Vector3d row[3];
        for (int r = 0; r < 3; r++) {
            for (int part = 0; part < 3; part++) {
                row[r][part] = evaluate(b[r][part].data(), part < 2 ? 3 : 4, z);
            }
        }
        Vector3d xy = row[0].cross(row[1]);
        for (const Vector3d &other : {Vector3d(row[0].cross(row[2])), Vector3d(row[1].cross(row[2]))}) {
            if (other.squaredNorm() > xy.squaredNorm()) {
                xy = other;
            }
        }
        if (xy[2] == 0.0) {
            return;
        }
        const Eigen::Vector4d weights(xy[0] / xy[2], xy[1] / xy[2], z, 1.0);
        const Eigen::Matrix<double, 9, 1> flat = (null * weights).normalized();
        if (flat.allFinite()) {
            solutions.add(Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(flat.data()));
        }
    };
    for (const double z : roots_in_unit(determinant.data(), 10)) {
        take(z);
    }
    std::reverse(determinant.begin(), determinant.end()); // roots beyond [-1, 1] are those of 1 / z
    for (const double inverse : roots_in_unit(determinant.data(), 10)) {
        if (inverse != 0.0) {
            take(1.0 / inverse);
        }
    }
    return solutions;
}

Decomposition decompose_essential(const Matrix3d &e)
{
    // Horn: from the cofactors of E = [t]x R, |t| = 1: R = (cofactor(E) -+ [t]x E), t from the largest of E's column
    // products.
    Matrix3d cofactor;
    for (int i = 0; i < 3; i++) {
        cofactor.col(i) = e.col((i + 1) % 3).cross(e.col((i + 2) % 3));
    }
    Decomposition out;
    Eigen::Index best = 0;
    cofactor.colwise().squaredNorm().maxCoeff(&best);
    out.t = cofactor.col(best).normalized();
    const double scale = std::sqrt(0.5 * e.squaredNorm());
    const Matrix3d tx = cross_matrix(out.t);
    out.r[0] = nearest_rotation(cofactor / (scale * scale) - tx * e / scale);
    out.r[1] = nearest_rotation(cofactor / (scale * scale) + tx * e / scale);
    return out;
}

Few<Pose, 4> three_point(const std::array<Vector3d, 3> &f, const std::array<Vector3d, 3> &x)
{
    Few<Pose, 4> solutions;
    const Vector3d d12 = x[0] - x[1], d13 = x[0] - x[2], d23 = x[1] - x[2];
    const double a12 = d12.squaredNorm(), a13 = d13.squaredNorm(), a23 = d23.squaredNorm();
    const double b12 = -2.0 * f[0].dot(f[1]), b13 = -2.0 * f[0].dot(f[2]), b23 = -2.0 * f[1].dot(f[2]);
    // Depths l: l^T M12 l = a12, .. ; D1 and D2 are the combinations whose right-hand side is zero.
    Matrix3d m12 = Matrix3d::Zero(), m13 = m12, m23 = m12;
    m12 << 1, b12 / 2, 0, b12 / 2, 1, 0, 0, 0, 0;
    m13 << 1, 0, b13 / 2, 0, 0, 0, b13 / 2, 0, 1;
    m23 << 0, 0, 0, 0, 1, b23 / 2, 0, b23 / 2, 1;
    const double size = a12 + a13 + a23;
    const Matrix3d d1 = (a23 * m12 - a12 * m23) / size, d2 = (a23 * m13 - a13 * m23) / size;
    const auto adjugate = [](const Matrix3d &m) {
        Matrix3d rows;
        for (int i = 0; i < 3; i++) {
            rows.row(i) = m.col((i + 1) % 3).cross(m.col((i + 2) % 3)).transpose();
        }
        return rows;
    };
    // det(D1 - g D2) = 0 makes the form a pair of planes; g may be large, then 1 / g is found.
    const double cubic[4] = {d1.determinant(), -(adjugate(d1) * d2).trace(), (adjugate(d2) * d1).trace(),
                             -d2.determinant()};
    const double reversed[4] = {cubic[3], cubic[2], cubic[1], cubic[0]};
    Few<double, 10> roots = roots_in_unit(cubic, 3);
    Matrix3d form;
    if (roots.count > 0) {
        form = d1 - roots.item[0] * d2;
    } else {
        roots = roots_in_unit(reversed, 3);
        if (roots.count == 0) {
            return solutions;
        }
        form = roots.item[0] * d1 - d2;
    }
    const linalg::SymmetricEigen<3> eigen = linalg::symmetric_eigen<3>(form);
    const Vector3d &values = eigen.values;
    if (!(values[0] < 0.0 && values[2] > 0.0)) {
        return solutions;
    }
    for (const double sign : {1.0, -1.0}) {
        const Vector3d plane =
            std::sqrt(values[2]) * eigen.vectors.col(2) + sign * std::sqrt(-values[0]) * eigen.vectors.col(0);
        if (std::abs(plane[0]) < 1e-12) {
            continue;
        }
        const double w0 = -plane[1] / plane[0], w1 = -plane[2] / plane[0];
        const double qa = (a12 - a13) * w1 * w1 + a12 * b13 * w1 + a12;
        const double qb = 2.0 * (a12 - a13) * w0 * w1 + a12 * b13 * w0 - a13 * b12 * w1;
        const double qc = (a12 - a13) * w0 * w0 - a13 * b12 * w0 - a13;
        const double discriminant = qb * qb - 4.0 * qa * qc;
        if (discriminant < 0.0) {
            continue;
        }
        const double q = -0.5 * (qb + std::copysign(std::sqrt(discriminant), qb));
        for (const double tau : {q / qa, qc / q}) {
            const double d = a23 / (tau * (b23 + tau) + 1.0);
            if (!(tau > 0.0 && d > 0.0)) {
                continue;
            }
            Vector3d depth(0.0, std::sqrt(d), tau * std::sqrt(d));
            depth[0] = w0 * depth[1] + w1 * depth[2];
            if (!(depth[0] > 0.0)) {
                continue;
            }
            for (int i = 0; i < 2; i++) { // two steps of Newton on the three distances
                const Vector3d error(depth.dot(m12 * depth) - a12, depth.dot(m13 * depth) - a13,
                                     depth.dot(m23 * depth) - a23);
                Matrix3d slope;
                slope << 2.0 * (m12 * depth).transpose(), 2.0 * (m13 * depth).transpose(),
                    2.0 * (m23 * depth).transpose();
                depth -= slope.inverse() * error;
            }
            const Vector3d y12 = depth[0] * f[0] - depth[1] * f[1], y13 = depth[0] * f[0] - depth[2] * f[2];
            Matrix3d from, to;
            from << d12, d13, d12.cross(d13);
            to << y12, y13, y12.cross(y13);
            Pose pose;
            pose.r = to * from.inverse();
            pose.t = depth[0] * f[0] - pose.r * x[0];
            if (pose.r.allFinite() && pose.t.allFinite()) {
                pose.r = nearest_rotation(pose.r);
                solutions.add(pose);
            }
        }
    }
    return solutions;
}

Matrix3d two_point_rotation(const std::array<Vector3d, 2> &f1, const std::array<Vector3d, 2> &f2)
{
    const auto frame = [](const std::array<Vector3d, 2> &f) {
        const Vector3d x = (f[0] + f[1]).normalized(), z = f[0].cross(f[1]).normalized();
        Matrix3d m;
        m << x, z.cross(x), z;
        return m;
    };
    return frame(f2) * frame(f1).transpose();
}

} // namespace pipefish::geometry
