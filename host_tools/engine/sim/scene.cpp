#include "sim/scene.hpp"

#include "sim/parallel.hpp"
#include "sim/random.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

constexpr double kFarthest = 20; // pipe radii; beyond, less than a tenth of a grey level comes back

// Separable Gaussian of the optics, borders mirrored by clamping (they are black).
void blur(std::vector<float> &image, int width, int height, double sigma, unsigned threads)
{
    const int reach = static_cast<int>(std::ceil(3.5 * sigma));
    if (reach < 1)
        return;
    std::vector<float> kernel;
    float sum = 0;
    for (int i = -reach; i <= reach; i++) {
        kernel.push_back(static_cast<float>(std::exp(-0.5 * i * i / (sigma * sigma))));
        sum += kernel.back();
    }
    for (float &k : kernel)
        k /= sum;
    std::vector<float> other(image.size());
    const auto pass = [&](const std::vector<float> &from, std::vector<float> &to, int step_x, int step_y) {
        parallel_rows(height, threads, [&](int y) {
            for (int x = 0; x < width; x++) {
                float v = 0;
                for (int i = -reach; i <= reach; i++) {
                    const int px = std::clamp(x + i * step_x, 0, width - 1);
                    const int py = std::clamp(y + i * step_y, 0, height - 1);
                    v += kernel[static_cast<size_t>(i + reach)] *
                         from[static_cast<size_t>(py) * static_cast<size_t>(width) + static_cast<size_t>(px)];
                }
                to[static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x)] = v;
            }
        });
    };
    pass(image, other, 1, 0);
    pass(other, image, 0, 1);
}

} // namespace

Scene::Scene(const SceneSpec &spec)
    : spec_(spec), tube_(spec.diameter, spec.pieces, spec.ovals), lens_(spec.lens), motion_(spec.motion, tube_)
{
}

void Scene::prepare(unsigned threads)
{
    texture_ = std::make_unique<Texture>(spec_.texture, spec_.diameter / 2, -0.5, tube_.length() + 3, threads);
    const LensSpec &l = spec_.lens;
    rays_.assign(static_cast<size_t>(l.width) * static_cast<size_t>(l.height), PixelRay{-1, 0, 0, 0, 0, 0, 0});
    for (int y = 0; y < l.height; y++) {
        for (int x = 0; x < l.width; x++) {
            const auto ray = lens_.unproject(Vec2(x, y));
            if (!ray)
                continue;
            PixelRay &p = rays_[static_cast<size_t>(y) * static_cast<size_t>(l.width) + static_cast<size_t>(x)];
            const double theta = std::atan2(std::hypot(ray->direction.x(), ray->direction.y()), ray->direction.z());
            const double share = theta / l.theta_max;
            p = {static_cast<float>(theta),
                 static_cast<float>(ray->direction.x()),
                 static_cast<float>(ray->direction.y()),
                 static_cast<float>(ray->direction.z()),
                 static_cast<float>(ray->origin.z()),
                 static_cast<float>(1 - l.vignetting * share * share),
                 static_cast<float>(1 / l.focal_px)};
        }
    }
}

// Grey level, noise and blur apart: lamp intensity x inverse square x cosine x reflectance (Lambert).
double Scene::shade(const Pose &pose, const PixelRay &ray) const
{
    const Vec3 local(ray.dx, ray.dy, ray.dz);
    const Vec3 direction = (pose.rotation.transpose() * local).normalized();
    const Vec3 origin = pose.centre + pose.rotation.transpose() * Vec3(0, 0, ray.oz);
    const auto hit = tube_.cast(origin, direction, kFarthest * spec_.diameter / 2, pose.piece);
    if (!hit)
        return 0;
    const Vec3 from_lamp = hit->point - pose.centre;
    const double d2 = from_lamp.squaredNorm(), d = std::sqrt(d2);
    const double cosine = std::max(0.0, -hit->normal.dot(from_lamp) / d);
    const double axial = std::max(0.0, pose.rotation.row(2).dot(from_lamp) / d);
    const double intensity = spec_.lamp.side + spec_.lamp.forward * axial * axial;
    const double minor = hit->distance * ray.angle;
    const double major = minor / std::max(0.02, -hit->normal.dot(direction));
    double reflectance = texture_->sample(hit->at.s, hit->at.phi, minor, major);
    for (const Marker &m : spec_.markers)
        if ((hit->point - tube_.wall(m.s, m.phi)).norm() < m.radius)
            reflectance = 1;
    const double r = spec_.diameter / 2;
    return spec_.lamp.exposure * intensity * cosine * r * r / d2 * reflectance * ray.vignette;
}

std::vector<uint8_t> Scene::render(int frame, unsigned threads)
{
    if (!texture_)
        prepare(threads);
    const Pose &pose = motion_.pose(frame);
    const int width = spec_.lens.width, height = spec_.lens.height;
    std::vector<float> light(rays_.size(), 0.0f);
    parallel_rows(height, threads, [&](int y) {
        const size_t row = static_cast<size_t>(y) * static_cast<size_t>(width);
        for (size_t i = row; i < row + static_cast<size_t>(width); i++)
            if (rays_[i].theta >= 0)
                light[i] = static_cast<float>(shade(pose, rays_[i]));
    });
    blur(light, width, height, spec_.sensor.blur_px, threads);
    std::vector<uint8_t> image(light.size());
    const uint64_t seed = hash64(spec_.sensor.seed, static_cast<uint64_t>(frame));
    parallel_rows(height, threads, [&](int y) {
        const size_t row = static_cast<size_t>(y) * static_cast<size_t>(width);
        for (size_t i = row; i < row + static_cast<size_t>(width); i++) {
            const double v = light[i];
            const double sigma =
                std::sqrt(spec_.sensor.read_noise * spec_.sensor.read_noise + spec_.sensor.shot_noise * v);
            image[i] = static_cast<uint8_t>(std::clamp(std::floor(v + sigma * normal(seed, i) + 0.5), 0.0, 255.0));
        }
    });
    return image;
}

std::optional<Hit> Scene::cast(int frame, const Vec2 &px) const
{
    const auto ray = lens_.unproject(px);
    if (!ray)
        return std::nullopt;
    const Pose &pose = motion_.pose(frame);
    const Eigen::Matrix3d world_from_cam = pose.rotation.transpose();
    return tube_.cast(pose.centre + world_from_cam * ray->origin, world_from_cam * ray->direction, 1e3, pose.piece);
}

std::optional<Vec2> Scene::project(int frame, const Vec3 &point) const
{
    const Pose &pose = motion_.pose(frame);
    return lens_.project(pose.rotation * (point - pose.centre));
}

} // namespace pipefish::sim
