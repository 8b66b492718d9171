#include "geometry/sight.hpp"

#include "linalg/linalg.hpp"

#include <Eigen/LU>

#include <cmath>

namespace pipefish::geometry
{

Sight make_sight(const pf_camera &camera, const double *uv, const double *covariance, double sigma)
{
    Sight sight;
    sight.uv = {uv[0], uv[1]};
    Eigen::Matrix<double, 3, 2, Eigen::RowMajor> d_ray;
    if (pf_camera_unproject(&camera, uv, sight.ray.data(), sight.origin.data(), d_ray.data()) != PF_OK) {
        return sight;
    }
    sight.root = sigma * Eigen::Matrix2d::Identity();
    if (covariance) {
        const double a = std::sqrt(covariance[0]), b = 0.5 * (covariance[1] + covariance[2]) / a;
        const double c = std::sqrt(covariance[3] - b * b);
        sight.root << a, 0, b, c;
    }
    sight.b = d_ray * sight.root;
    sight.valid = sight.b.allFinite() && sight.root(0, 0) > 0.0 && sight.root(1, 1) > 0.0;
    return sight;
}

std::vector<Sight> make_sights(const pf_camera &camera, size_t n, const double *uv, const double *covariance,
                               double sigma)
{
    std::vector<Sight> sights;
    sights.reserve(n);
    for (size_t i = 0; i < n; i++) {
        sights.push_back(make_sight(camera, uv + 2 * i, covariance ? covariance + 4 * i : nullptr, sigma));
    }
    return sights;
}

Matrix3d rotation_exp(const Vector3d &w)
{
    const double s = w.squaredNorm(), angle = std::sqrt(s);
    const Matrix3d k = cross_matrix(w);
    const double a = s < 1e-8 ? 1.0 - s / 6.0 : std::sin(angle) / angle;
    const double b = s < 1e-8 ? 0.5 - s / 24.0 : (1.0 - std::cos(angle)) / s;
    return Matrix3d::Identity() + a * k + b * k * k;
}

Vector3d rotation_log(const Matrix3d &r)
{
    const Eigen::AngleAxisd turn(r);
    return turn.angle() * turn.axis();
}

Matrix3d nearest_rotation(const Matrix3d &m)
{
    const linalg::Svd svd = linalg::svd(m);
    const double sign = (svd.u * svd.v.transpose()).determinant() < 0.0 ? -1.0 : 1.0;
    return svd.u * Vector3d(1.0, 1.0, sign).asDiagonal() * svd.v.transpose();
}

Matrix32 tangent_basis(const Vector3d &f)
{
    Matrix32 basis;
    basis.col(0) = f.unitOrthogonal();
    basis.col(1) = f.cross(basis.col(0));
    return basis;
}

} // namespace pipefish::geometry
