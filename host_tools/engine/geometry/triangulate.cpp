#include "geometry/triangulate.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace pipefish::geometry
{

namespace
{

// The whitened angular error of one view and its derivative by the point; false: the point is on or behind the eye.
bool whitened(const View &view, const Vector3d &x, Vector2d &error, Matrix23 &slope)
{
    const Vector3d y = *view.pose * x - view.sight->origin;
    const double length = y.norm();
    const Vector3d direction = y / length;
    if (!(length > 0.0) || !(direction.dot(view.sight->ray) > 0.0)) {
        return false;
    }
    // In the tangent plane of the ray: pixels move along b, so b^+ counts standard deviations of the pixel's axes.
    const Eigen::Matrix2d gram = view.sight->b.transpose() * view.sight->b;
    const Matrix23 whiten = gram.inverse() * view.sight->b.transpose();
    error = whiten * direction;
    slope = whiten * (Matrix3d::Identity() - direction * direction.transpose()) * view.pose->r / length;
    return true;
}

} // namespace

std::optional<Vector3d> triangulate(std::span<const View> views, int steps, double *chi2)
{
    Vector3d x = Vector3d::Zero();
    for (int round = 0; round < 2; round++) {
        Matrix3d normal = Matrix3d::Zero();
        Vector3d right = Vector3d::Zero();
        for (const View &view : views) {
            const Vector3d f = view.pose->r.transpose() * view.sight->ray;
            const Vector3d origin = view.pose->r.transpose() * (view.sight->origin - view.pose->t);
            double weight = 1.0 / view.sight->b.squaredNorm();
            if (round > 0) {
                weight /= std::max((x - origin).squaredNorm(), 1e-12);
            }
            const Matrix3d across = weight * (Matrix3d::Identity() - f * f.transpose());
            normal += across;
            right += across * origin;
        }
        const Eigen::LDLT<Matrix3d> factor(normal);
        if (!(factor.vectorD().minCoeff() > 1e-12 * factor.vectorD().maxCoeff())) {
            return std::nullopt;
        }
        x = factor.solve(right);
    }
    for (int step = 0; step <= steps; step++) {
        Matrix3d normal = Matrix3d::Zero();
        Vector3d right = Vector3d::Zero();
        double sum = 0.0;
        for (const View &view : views) {
            Vector2d error;
            Matrix23 slope;
            if (!whitened(view, x, error, slope)) {
                return std::nullopt;
            }
            sum += error.squaredNorm();
            normal += slope.transpose() * slope;
            right -= slope.transpose() * error;
        }
        if (chi2) {
            *chi2 = sum;
        }
        if (step < steps) {
            x += normal.ldlt().solve(right);
        }
    }
    return x.allFinite() ? std::optional(x) : std::nullopt;
}

Vector2d midpoint_depths(const Vector3d &g, const Vector3d &f2, const Vector3d &t)
{
    const double c = g.dot(f2), s = 1.0 - c * c, along1 = g.dot(t), along2 = f2.dot(t);
    return {(c * along2 - along1) / s, (along2 - c * along1) / s};
}

double parallax(std::span<const View> views, const Vector3d &x)
{
    double least = 1.0;
    for (size_t i = 0; i < views.size(); i++) {
        for (size_t j = 0; j < i; j++) {
            const Vector3d a = (views[i].pose->centre() - x).normalized(),
                           b = (views[j].pose->centre() - x).normalized();
            least = std::min(least, a.dot(b));
        }
    }
    return std::acos(std::max(least, -1.0));
}

} // namespace pipefish::geometry
