#include "geometry/degenerate.hpp"

#include "counter_random.hpp"
#include "geometry/minimal.hpp"
#include "geometry/two_view.hpp"
#include "linalg/linalg.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace pipefish::geometry
{

namespace
{

constexpr uint64_t STREAM_ROTATION = 2;

// Squared whitened distance, chi^2 with 2 degrees of freedom, between b's ray and a's ray mapped by m (a rotation, or a
// homography with the sign that maps visible points forward).
double transfer_squared(const Matrix3d &m, const Sight &a, const Sight &b, Matrix32 *slope = nullptr)
{
    const Vector3d mapped = m * a.ray;
    const double length = mapped.norm();
    const Vector3d g = mapped / length;
    if (!(g.dot(b.ray) > 0.0)) {
        return 1e12;
    }
    const Matrix32 basis = tangent_basis(b.ray);
    const Vector2d error = basis.transpose() * g;
    const Matrix32 moved = (Matrix3d::Identity() - g * g.transpose()) * m * a.b / length;
    const Eigen::Matrix2d n1 = basis.transpose() * moved, n2 = basis.transpose() * b.b;
    const Eigen::Matrix2d variance = n1 * n1.transpose() + n2 * n2.transpose();
    if (slope) { // (variance^-1 basis^T) in columns
        *slope = basis * variance.inverse();
    }
    return error.dot(variance.inverse() * error);
}

// GRIC of a model with manifold dimension d and k parameters in the four coordinates of n pairs.
struct Gric {
    double n;
    int d, k;

    double operator()(double truncated_sum) const
    {
        return truncated_sum + n * d * std::log(4.0) + k * std::log(4.0 * n);
    }
    double limit() const { return 2.0 * (4 - d); }
};

double truncated_transfer(const Matrix3d &m, std::span<const Sight> a, std::span<const Sight> b,
                          std::span<const int> pairs, double limit)
{
    double sum = 0.0;
    for (const int i : pairs) {
        sum += std::min(transfer_squared(m, a[static_cast<size_t>(i)], b[static_cast<size_t>(i)]), limit);
    }
    return sum;
}

// Robust rotation: two-point samples, then weighted least squares.
Matrix3d find_rotation(std::span<const Sight> a, std::span<const Sight> b, std::span<const int> used, double limit,
                       uint64_t seed)
{
    Matrix3d best = Matrix3d::Identity();
    double least = truncated_transfer(best, a, b, used, limit);
    for (uint64_t k = 0; k < 12; k++) {
        const auto pick = [&](uint64_t which) {
            const double u = uniform_of(hash64(seed, STREAM_ROTATION, k, which));
            return static_cast<size_t>(used[static_cast<size_t>(u * static_cast<double>(used.size()))]);
        };
        const size_t i = pick(0), j = pick(1);
        if (a[i].ray.cross(a[j].ray).norm() < 0.1 || b[i].ray.cross(b[j].ray).norm() < 0.1) {
            continue;
        }
        const Matrix3d r = two_point_rotation({a[i].ray, a[j].ray}, {b[i].ray, b[j].ray});
        const double sum = truncated_transfer(r, a, b, used, limit);
        if (sum < least) {
            least = sum;
            best = r;
        }
    }
    for (int step = 0; step < 5; step++) {
        Matrix3d h = Matrix3d::Zero();
        Vector3d right = Vector3d::Zero();
        for (const int i : used) {
            const Sight &s1 = a[static_cast<size_t>(i)], &s2 = b[static_cast<size_t>(i)];
            Matrix32 slope;
            const double squared = transfer_squared(best, s1, s2, &slope);
            if (squared < 25.0) {
                const Vector3d g = best * s1.ray;
                const Matrix32 basis = tangent_basis(s2.ray);
                const Eigen::Matrix<double, 2, 3> j = -basis.transpose() * cross_matrix(g);
                const Matrix23 weighted = slope.transpose() * -cross_matrix(g);
                h += j.transpose() * weighted;
                right -= weighted.transpose() * (basis.transpose() * g);
            }
        }
        const Vector3d delta = h.ldlt().solve(right);
        if (!delta.allFinite()) {
            break;
        }
        best = rotation_exp(delta) * best;
        if (delta.squaredNorm() < 1e-20) {
            break;
        }
    }
    return best;
}

// Linear homography of the pairs, weighted by 1 / noise; its sign maps most of them forward.
Matrix3d find_homography(std::span<const Sight> a, std::span<const Sight> b, std::span<const int> pairs)
{
    using Matrix9 = Eigen::Matrix<double, 9, 9>;
    Matrix9 normal = Matrix9::Zero();
    for (const int i : pairs) {
        const Sight &s1 = a[static_cast<size_t>(i)], &s2 = b[static_cast<size_t>(i)];
        const Matrix32 basis = tangent_basis(s2.ray);
        const double weight = 1.0 / (s1.b.squaredNorm() + s2.b.squaredNorm());
        const Matrix3d across = weight * basis * basis.transpose(), along = s1.ray * s1.ray.transpose();
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++) {
                normal.block<3, 3>(3 * r, 3 * c) += across(r, c) * along;
            }
        }
    }
    const Eigen::Matrix<double, 9, 1> flat = linalg::symmetric_eigen<9>(normal).vectors.col(0);
    Matrix3d h = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(flat.data());
    int forward = 0;
    for (const int i : pairs) {
        forward += b[static_cast<size_t>(i)].ray.dot(h * a[static_cast<size_t>(i)].ray) > 0.0 ? 1 : -1;
    }
    return forward < 0 ? Matrix3d(-h) : h;
}

double essential_gric(const Pose &pose, std::span<const Sight> a, std::span<const Sight> b, std::span<const int> pairs)
{
    const Gric gric{static_cast<double>(pairs.size()), 3, 5};
    double sum = 0.0;
    for (const int i : pairs) {
        sum += std::min(sampson_squared(pose, a[static_cast<size_t>(i)], b[static_cast<size_t>(i)]), gric.limit());
    }
    return gric(sum);
}

} // namespace

std::optional<Matrix3d> explaining_rotation(const Pose &pose, std::span<const Sight> a, std::span<const Sight> b,
                                            std::span<const int> inliers, uint64_t seed)
{
    if (inliers.size() < 8) {
        return std::nullopt;
    }
    const Gric gric{static_cast<double>(inliers.size()), 2, 3};
    const Matrix3d rotation = find_rotation(a, b, inliers, gric.limit(), seed);
    const double value = gric(truncated_transfer(rotation, a, b, inliers, gric.limit()));
    return value < essential_gric(pose, a, b, inliers) ? std::optional(rotation) : std::nullopt;
}

bool explained_by_plane(const Pose &pose, std::span<const Sight> a, std::span<const Sight> b,
                        std::span<const int> inliers)
{
    const Gric gric{static_cast<double>(inliers.size()), 2, 8};
    const Matrix3d h = find_homography(a, b, inliers);
    return gric(truncated_transfer(h, a, b, inliers, gric.limit())) < essential_gric(pose, a, b, inliers);
}

} // namespace pipefish::geometry
