#include "conics.hpp"

#include "linalg/linalg.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace pipefish::conics
{
namespace
{

using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector3d;

// A rotation that turns a direction to +z.
Matrix3d turned_to_z(const Vector3d &direction)
{
    return linalg::turn_between(direction, Vector3d::UnitZ()).toRotationMatrix();
}

} // namespace

Matrix3d fit_cone(const std::vector<Vector3d> &rays)
{
    Vector3d mean = Vector3d::Zero();
    for (const Vector3d &r : rays)
        mean += r;
    if (rays.size() < 5 || !(mean.norm() > 1e-9))
        throw std::invalid_argument("a cone needs at least 5 rays around a direction");
    // In the tangent plane at the mean ray the cone is an ellipse, wherever in the field it lies.
    const Matrix3d turn = turned_to_z(mean.normalized());
    std::vector<Vector2d> points;
    for (const Vector3d &r : rays) {
        const Vector3d x = turn * r;
        if (!(x.z() > 0.17))
            throw std::invalid_argument("the rays of a cone must lie within 80 degrees of their mean");
        points.emplace_back(x.hnormalized());
    }
    const Matrix3d q = turn.transpose() * fit_ellipse(points) * turn;
    return q / q.norm();
}

std::vector<DiscPose> disc_poses(const Matrix3d &cone, const Vector3d &inside, double radius)
{
    const linalg::SymmetricEigen<3> eigen =
        linalg::symmetric_eigen<3>(inside.dot(cone * inside) > 0 ? Matrix3d(-cone) : cone);
    // Ascending: the negative one along the cone's axis, then two positive ones.
    const Vector3d l(eigen.values[2], eigen.values[1], eigen.values[0]);
    if (!(l[2] < 0 && l[1] > 0) || !(radius > 0))
        throw std::invalid_argument("not a cone around a disc");
    Matrix3d axes;
    axes << eigen.vectors.col(2), eigen.vectors.col(1), eigen.vectors.col(0);
    // Planes that cut the cone in circles contain its middle axis (of l[1]); two of them, mirror images.
    const double across = std::sqrt(std::max((l[0] - l[1]) / (l[0] - l[2]), 0.0));
    const double along = std::sqrt(std::max((l[1] - l[2]) / (l[0] - l[2]), 0.0));
    std::vector<DiscPose> poses;
    for (const double side : {1.0, -1.0}) {
        DiscPose p;
        p.normal = axes * Vector3d(side * across, 0.0, along);
        // The circle of the plane normal . x = 1: its middle and size, to scale.
        const Matrix3d basis = turned_to_z(p.normal).transpose(); // columns: two in the plane, the normal
        const Matrix3d cut = basis.transpose() * cone * basis;    // of (x, y, 1) in the plane
        const Vector2d middle = -cut.topRightCorner<2, 1>() / (0.5 * (cut(0, 0) + cut(1, 1)));
        const double square = middle.squaredNorm() - cut(2, 2) / (0.5 * (cut(0, 0) + cut(1, 1)));
        p.middle = basis * Vector3d(middle.x(), middle.y(), 1.0) * (radius / std::sqrt(std::max(square, 1e-300)));
        if (p.middle.dot(inside) < 0)
            p.middle = -p.middle;
        if (p.normal.dot(p.middle) > 0)
            p.normal = -p.normal;
        poses.push_back(p);
    }
    return poses;
}

namespace
{

struct Motion {
    Matrix3d r;
    Vector3d t;
};

// The angles, to first order, between rays and the rims of their discs under a pose. Rays that miss the plane: 1.
Eigen::VectorXd angles(const Motion &m, const Discs &discs)
{
    Eigen::Index count = 0;
    for (const auto &rays : discs.rays)
        count += static_cast<Eigen::Index>(rays.size());
    Eigen::VectorXd e(count);
    Eigen::Index row = 0;
    const Vector3d n = m.r.col(2);
    const double far = n.dot(m.t);
    for (size_t k = 0; k < discs.rays.size(); k++)
        for (const Vector3d &d : discs.rays[k]) {
            const double s = far / n.dot(d);
            const Vector2d off = (m.r.transpose() * (s * d - m.t)).head<2>() - discs.middles[k];
            if (!(s > 0)) {
                e[row++] = 1.0;
                continue;
            }
            const Vector3d out = m.r.leftCols<2>() * off.normalized(); // in the camera's frame, away from the middle
            // How the distance from the middle grows as the ray turns.
            Vector3d slope = s * out - (s * out.dot(d) / n.dot(d)) * n;
            slope -= slope.dot(d) * d;
            e[row++] = (off.norm() - discs.radius) / std::max(slope.norm(), 1e-12);
        }
    return e;
}

Motion moved(const Motion &m, const Eigen::Matrix<double, 6, 1> &by)
{
    const double angle = by.head<3>().norm();
    Motion out = m;
    if (angle > 0)
        out.r = Eigen::AngleAxisd(angle, by.head<3>() / angle).toRotationMatrix() * m.r;
    out.t += by.tail<3>();
    return out;
}

} // namespace

Pose pose_of_discs(const Discs &discs)
{
    const size_t n = discs.middles.size();
    if (n < 3 || discs.rays.size() != n || !(discs.radius > 0))
        throw std::invalid_argument("the outlines of at least three discs of a known radius are needed");
    Conics circles, cones;
    Vector3d middle = Vector3d::Zero();
    double size = discs.radius;
    for (size_t k = 0; k < n; k++) {
        for (const Vector3d &r : discs.rays[k])
            middle += r;
        size = std::max(size, discs.middles[k].norm());
    }
    // Turned to face the target and scaled to it, so that the cones are ellipses near the axis.
    const Matrix3d turn = turned_to_z(middle.normalized());
    for (size_t k = 0; k < n; k++) {
        const Vector2d c = discs.middles[k] / size;
        Matrix3d circle = Matrix3d::Identity();
        circle.topRightCorner<2, 1>() = -c;
        circle.bottomLeftCorner<1, 2>() = -c.transpose();
        circle(2, 2) = c.squaredNorm() - std::pow(discs.radius / size, 2);
        circles.push_back(circle);
        cones.push_back(turn * fit_cone(discs.rays[k]) * turn.transpose());
    }
    Matrix3d h = turn.transpose() * homography(circles, cones)[0];
    h.leftCols<2>() /= size;
    double ahead = 0.0;
    for (size_t k = 0; k < n; k++)
        ahead += discs.rays[k][0].dot(h * discs.middles[k].homogeneous());
    h *= (ahead < 0 ? -2.0 : 2.0) / (h.col(0).norm() + h.col(1).norm());
    Matrix3d r;
    r << h.col(0), h.col(1), h.col(0).cross(h.col(1));
    const linalg::Svd svd = linalg::svd(r);
    Motion m{svd.u * svd.v.transpose(), h.col(2)};
    if (m.r.determinant() < 0)
        throw std::invalid_argument("the discs' outlines determine no pose");
    Eigen::VectorXd e = angles(m, discs);
    double damping = 1e-3;
    for (int round = 0; round < 50; round++) {
        Eigen::MatrixXd j(e.size(), 6);
        for (int k = 0; k < 6; k++) {
            Eigen::Matrix<double, 6, 1> step = Eigen::Matrix<double, 6, 1>::Zero();
            step[k] = k < 3 ? 1e-6 : 1e-6 * m.t.norm();
            j.col(k) = (angles(moved(m, step), discs) - angles(moved(m, -step), discs)) / (2 * step[k]);
        }
        Eigen::Matrix<double, 6, 6> normal = j.transpose() * j;
        normal.diagonal() *= 1 + damping;
        const Eigen::Matrix<double, 6, 1> change = -normal.ldlt().solve(j.transpose() * e);
        const Motion next = moved(m, change);
        const Eigen::VectorXd then = angles(next, discs);
        if (!(then.squaredNorm() <= e.squaredNorm())) {
            damping *= 10;
            if (damping > 1e8)
                break;
            continue;
        }
        damping *= 0.1;
        m = next;
        e = then;
        if (change.norm() < 1e-12 * (1 + m.t.norm()))
            break;
    }
    Pose p;
    p.cam_from_target << m.r, m.t;
    p.rms = std::sqrt(e.squaredNorm() / static_cast<double>(e.size()));
    return p;
}

} // namespace pipefish::conics
