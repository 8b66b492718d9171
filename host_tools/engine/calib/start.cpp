#include "calib/start.hpp"

#include "linalg/linalg.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace pipefish::calib
{

namespace
{

// Null vector of the rows [x]_x H p, D columns of H: the Kronecker form of sum p p' (x) (I - x x').
template <int D>
std::optional<Eigen::Matrix<double, 3, D>> direct_linear(const std::vector<Eigen::Matrix<double, D, 1>> &points,
                                                         std::span<const Eigen::Vector3d> rays,
                                                         std::span<const double> weights)
{
    constexpr int n = 3 * D;
    Eigen::Matrix<double, n, n> normal = Eigen::Matrix<double, n, n>::Zero();
    for (size_t i = 0; i < points.size(); i++) {
        const double w = weights.empty() ? 1.0 : weights[i];
        const Eigen::Matrix3d across = w * (Eigen::Matrix3d::Identity() - rays[i] * rays[i].transpose());
        for (int a = 0; a < D; a++) {
            for (int b = 0; b <= a; b++) {
                normal.template block<3, 3>(3 * a, 3 * b) += points[i][a] * points[i][b] * across;
            }
        }
    }
    const linalg::SymmetricEigen<n> eigen = linalg::symmetric_eigen<n>(normal);
    const auto &values = eigen.values;
    if (!eigen.converged || !(values[1] > 1e-12 * values[n - 1])) {
        return std::nullopt; // more than one null vector
    }
    const Eigen::Matrix<double, n, 1> vector = eigen.vectors.col(0);
    Eigen::Matrix<double, 3, D> h;
    for (int a = 0; a < D; a++) {
        h.col(a) = vector.template segment<3>(3 * a);
    }
    double sign = 0.0;
    for (size_t i = 0; i < points.size(); i++) {
        sign += (weights.empty() ? 1.0 : weights[i]) * rays[i].dot((h * points[i]).normalized());
    }
    return sign >= 0.0 ? h : Eigen::Matrix<double, 3, D>(-h);
}

std::optional<Pose> planar_pose(std::span<const Eigen::Vector3d> points, std::span<const Eigen::Vector3d> rays,
                                std::span<const double> weights, const Eigen::Vector3d &centre, double scale)
{
    std::vector<Eigen::Vector3d> normalised;
    normalised.reserve(points.size());
    for (const Eigen::Vector3d &p : points) {
        normalised.push_back({(p.x() - centre.x()) / scale, (p.y() - centre.y()) / scale, 1.0});
    }
    const auto h = direct_linear<3>(normalised, rays, weights);
    if (!h) {
        return std::nullopt;
    }
    const double lambda = 2.0 / (h->col(0).norm() + h->col(1).norm());
    Eigen::Matrix3d axes;
    axes.col(0) = lambda * h->col(0);
    axes.col(1) = lambda * h->col(1);
    axes.col(2) = axes.col(0).cross(axes.col(1));
    Pose pose;
    pose.rotation = nearest_rotation(axes);
    pose.translation = scale * lambda * h->col(2) - pose.rotation * Eigen::Vector3d(centre.x(), centre.y(), 0.0);
    return pose;
}

std::optional<Pose> spatial_pose(std::span<const Eigen::Vector3d> points, std::span<const Eigen::Vector3d> rays,
                                 std::span<const double> weights, const Eigen::Vector3d &centre, double scale)
{
    std::vector<Eigen::Vector4d> normalised;
    normalised.reserve(points.size());
    for (const Eigen::Vector3d &p : points) {
        normalised.push_back(((p - centre) / scale).homogeneous());
    }
    const auto h = direct_linear<4>(normalised, rays, weights);
    if (!h) {
        return std::nullopt;
    }
    const Eigen::Matrix3d a = h->leftCols<3>();
    const double size = std::cbrt(a.determinant());
    if (!(size > 0.0)) {
        return std::nullopt;
    }
    Pose pose;
    pose.rotation = nearest_rotation(a / size);
    pose.translation = scale / size * h->col(3) - pose.rotation * centre;
    return pose;
}

double median(std::vector<double> &values)
{
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

double nominal_end(uint32_t radial)
{
    return radial == PF_RADIAL_PERSPECTIVE ? 1.5 : radial == PF_RADIAL_ORTHOGRAPHIC ? 1.56 : 3.1;
}

// The generic radius (f, k2) next to f r(theta) up to theta_end, in the least squares sense.
pf_camera as_p6(const pf_camera &nominal, double theta_end)
{
    Eigen::Matrix2d normal = Eigen::Matrix2d::Zero();
    Eigen::Vector2d right = Eigen::Vector2d::Zero();
    for (int i = 1; i <= 100; i++) {
        const double theta = theta_end * i / 100.0;
        const Eigen::Vector2d basis(theta, theta * theta * theta);
        normal += basis * basis.transpose();
        right += basis * pf_camera_radius(&nominal, theta, nullptr);
    }
    const Eigen::Vector2d k = normal.ldlt().solve(right);
    pf_camera camera = nominal;
    camera.radial = PF_RADIAL_GENERIC;
    camera.f_u = camera.f_v = nominal.f_u * k[0];
    camera.k2 = k[1] / k[0];
    camera.theta_max = PF_CAMERA_THETA_MAX;
    return camera;
}

struct Score {
    double median_px = std::numeric_limits<double>::infinity();
    double theta = 0.0;
};

Score score(const pf_camera &camera, std::span<const View *const> views, size_t points_wanted)
{
    Score out;
    std::vector<double> errors;
    size_t asked = 0;
    for (const View *view : views) {
        const size_t every = std::max<size_t>(1, view->points.size() / points_wanted);
        const std::optional<Pose> pose = view_pose(camera, *view, Shape{}, every);
        for (size_t i = 0; i < view->points.size(); i += every) {
            asked++;
            Eigen::Vector2d at;
            if (!pose) {
                continue;
            }
            const Eigen::Vector3d x = *pose * view->points[i].drawn;
            if (pf_camera_project(&camera, x.data(), at.data(), nullptr, nullptr) == PF_OK) {
                errors.push_back((at - view->points[i].pixel).norm());
                out.theta = std::max(out.theta, std::atan2(std::hypot(x.x(), x.y()), x.z()));
            }
        }
    }
    if (static_cast<double>(errors.size()) > 0.8 * static_cast<double>(asked)) {
        errors.resize(asked, std::numeric_limits<double>::infinity()); // what has no ray is a large error
        out.median_px = median(errors);
    }
    return out;
}

// Those that span the most of the image: the others say little about the focal length.
std::vector<const View *> widest(std::span<const View> views, size_t count)
{
    std::vector<std::pair<double, const View *>> spans;
    for (const View &view : views) {
        Eigen::AlignedBox2d box;
        for (const Observation &point : view.points) {
            box.extend(point.pixel);
        }
        if (view.points.size() >= 6) {
            spans.push_back({-box.sizes().prod(), &view});
        }
    }
    std::stable_sort(spans.begin(), spans.end(), [](const auto &a, const auto &b) { return a.first < b.first; });
    std::vector<const View *> chosen;
    for (size_t i = 0; i < spans.size() && i < count; i++) {
        chosen.push_back(spans[i].second);
    }
    return chosen;
}

} // namespace

std::optional<Pose> pose_from_rays(std::span<const Eigen::Vector3d> points, std::span<const Eigen::Vector3d> rays,
                                   std::span<const double> weights)
{
    Eigen::Vector3d centre = Eigen::Vector3d::Zero();
    for (const Eigen::Vector3d &p : points) {
        centre += p / static_cast<double>(points.size());
    }
    double spread = 0.0, height = 0.0;
    for (const Eigen::Vector3d &p : points) {
        spread += (p - centre).squaredNorm() / static_cast<double>(points.size());
        height = std::max(height, std::abs(p.z()));
    }
    const double scale = std::sqrt(spread);
    if (points.size() < 4 || !(scale > 0.0)) {
        return std::nullopt;
    }
    // A bent board is flat enough for a start.
    if (height <= 0.05 * scale) {
        return planar_pose(points, rays, weights, centre, scale);
    }
    return points.size() < 6 ? std::nullopt : spatial_pose(points, rays, weights, centre, scale);
}

std::optional<Pose> view_pose(const pf_camera &camera, const View &view, const Shape &shape, size_t every)
{
    std::vector<Eigen::Vector3d> points, rays;
    for (size_t i = 0; i < view.points.size(); i += every) {
        Eigen::Vector3d ray;
        if (view.points[i].used &&
            pf_camera_unproject(&camera, view.points[i].pixel.data(), ray.data(), nullptr, nullptr) == PF_OK) {
            points.push_back(shape.at(view.points[i].drawn, nullptr));
            rays.push_back(ray);
        }
    }
    std::optional<Pose> pose = pose_from_rays(points, rays, {});
    std::vector<double> weights(points.size()), errors(points.size());
    for (int round = 0; round < (every > 1 ? 1 : 3) && pose; round++) {
        for (size_t i = 0; i < points.size(); i++) {
            errors[i] = weights[i] = ((*pose * points[i]).normalized() - rays[i]).norm();
        }
        const double typical = 2.5 * median(errors) + 1e-12;
        for (double &w : weights) {
            const double ratio = w / typical;
            w = 1.0 / (1.0 + ratio * ratio * ratio * ratio);
        }
        const std::optional<Pose> better = pose_from_rays(points, rays, weights);
        if (!better) {
            break;
        }
        pose = better;
    }
    return pose;
}

std::vector<Start> sweep(std::span<const View> views, uint32_t width, uint32_t height, double c_u, double c_v,
                         bool classical)
{
    constexpr size_t kViews = 12, kPoints = 30;
    constexpr double kFirst = 0.08, kRatio = 1.18; // of the width: 220 degrees in a third of it, to 20 across it
    constexpr int kSteps = 23;
    const std::vector<const View *> chosen = widest(views, kViews);
    const auto nominal = [&](uint32_t radial, int step) {
        pf_camera camera{};
        camera.width = width;
        camera.height = height;
        camera.radial = radial;
        camera.f_u = camera.f_v = kFirst * std::pow(kRatio, step) * std::max(width, height);
        camera.c_u = c_u;
        camera.c_v = c_v;
        camera.theta_max = nominal_end(radial);
        return camera;
    };
    std::vector<Start> starts;
    const auto best_of = [&](uint32_t radial, int from, int to) {
        Score best;
        int best_step = from;
        for (int step = from; step <= to; step++) {
            const Score tried = score(nominal(radial, step), chosen, kPoints);
            if (tried.median_px < best.median_px) {
                best = tried;
                best_step = step;
            }
        }
        if (std::isfinite(best.median_px)) {
            starts.push_back({as_p6(nominal(radial, best_step), best.theta), best.median_px, radial});
        }
        return best_step;
    };
    const int middle = best_of(PF_RADIAL_EQUIDISTANT, 0, kSteps - 1);
    if (!classical) {
        return starts;
    }
    starts.clear();
    for (const uint32_t radial :
         {PF_RADIAL_EQUISOLID, PF_RADIAL_STEREOGRAPHIC, PF_RADIAL_PERSPECTIVE, PF_RADIAL_ORTHOGRAPHIC}) {
        best_of(radial, std::max(0, middle - 3), std::min(kSteps - 1, middle + 2));
    }
    std::stable_sort(starts.begin(), starts.end(),
                     [](const Start &a, const Start &b) { return a.median_px < b.median_px; });
    return starts;
}

} // namespace pipefish::calib
