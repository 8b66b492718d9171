#include "sim/scene.hpp"

#include "sim/buffers.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::sim
{

namespace
{

// A power of two that gives the pixels at the rim, where the wall is sharpest, 0.6 to 1.2 texels each.
int texels_around(const Lens &lens)
{
    const double theta = std::min(lens.theta_max(), 0.5 * std::numbers::pi), step = 1e-3;
    const double pixels = 2.0 * std::numbers::pi * (lens.radius(theta) - lens.radius(theta - step)) / step;
    int around = 64;
    while (around < 1.2 * pixels && around < 16384) {
        around *= 2;
    }
    return around;
}

const SceneConfig &checked(const SceneConfig &c)
{
    const auto require = [](bool holds, const char *what) {
        if (!holds) {
            throw std::invalid_argument(what);
        }
    };
    require(c.radius > 0.0 && c.radius <= 10.0, "the pipe's radius must be above 0 and at most 10 metres");
    require(c.camera.width >= 16 && c.camera.width <= 16384 && c.camera.height >= 16 && c.camera.height <= 16384,
            "the image must be 16 to 16384 pixels wide and high");
    require(c.camera.blur >= 0.0 && c.camera.blur <= 10.0, "the blur must be 0 to 10 pixels");
    require(c.camera.gamma >= 0.2 && c.camera.gamma <= 5.0, "gamma must be 0.2 to 5");
    require(c.light.lamps >= 1 && c.light.lamps <= 64, "a ring has 1 to 64 lamps");
    require(c.light.radius >= 0.0 && c.light.radius <= 0.5 * c.radius,
            "the lamp ring must be at most half the pipe wide");
    require(c.motion.drop >= -0.5 * c.radius && c.motion.drop <= 0.5 * c.radius && c.motion.lateral <= 0.05 * c.radius,
            "the camera's drop must stay within half, its wobble within a twentieth of the pipe's radius");
    require(c.motion.speed > 0.0 && c.motion.fps > 0.0 && c.motion.ramp >= 0.0 && c.motion.lookahead > 0.0,
            "speed, frame rate and look-ahead must be positive, the ramp not negative");
    require(c.sensors.metres_per_count > 0.0, "metres per count must be positive");
    return c;
}

} // namespace

// Ahead as far as the lamp lights the wall to a tenth of a grey level: the light falls with (radius / distance)^3.
Scene::Reach Scene::lit_reach(const SceneConfig &config)
{
    return {2.0 * config.radius, 1.2 * config.radius * std::cbrt(std::max(config.light.rim_grey, 1.0) / 0.1)};
}

Scene::Scene(const SceneConfig &config)
    : config_(checked(config)), tube_(config.radius, config.runs, config.ovals), lens_(config.lens),
      frames_(drive(tube_, config.motion, config.sensors, config.seed)), reach_(lit_reach(config)),
      surface_(config.surface, config.radius, texels_around(lens_), reach_.behind + reach_.ahead)
{
    make_pixel_table();
    make_blur_kernel();
    make_response();
    buffers_ = std::make_unique<Buffers>(rays_.size(), static_cast<size_t>(config_.camera.width) *
                                                           static_cast<size_t>(config_.camera.height));
}

Scene::~Scene() = default;

void Scene::make_pixel_table()
{
    const CameraConfig &camera = config_.camera;
    for (int y = 0; y < camera.height; y++) {
        row_offset_.push_back(rays_.size());
        int from = camera.width, to = 0;
        for (int x = 0; x < camera.width; x++) {
            const double px[2] = {static_cast<double>(x), static_cast<double>(y)};
            PixelRay r{};
            if (!ray(px, r)) {
                continue;
            }
            from = std::min(from, x);
            to = x + 1;
            rays_.push_back(r);
            const double edge = std::acos(std::clamp(r.dz, -1.0, 1.0)) / lens_.theta_max();
            vignette_.push_back(static_cast<float>(1.0 - camera.vignetting * edge * edge * edge * edge));
        }
        row_from_.push_back(std::min(from, to));
        row_to_.push_back(to);
    }
    if (rays_.empty()) {
        throw std::invalid_argument("the image circle does not touch the image");
    }
}

void Scene::make_blur_kernel()
{
    const double sigma = config_.camera.blur;
    const int reach = static_cast<int>(std::ceil(3.5 * sigma));
    double sum = 0.0;
    for (int k = -reach; k <= reach; k++) {
        sum += sigma > 0.0 ? std::exp(-0.5 * k * k / (sigma * sigma)) : 1.0;
    }
    for (int k = 0; k <= reach; k++) {
        blur_.push_back(static_cast<float>((sigma > 0.0 ? std::exp(-0.5 * k * k / (sigma * sigma)) : 1.0) / sum));
    }
}

void Scene::make_response()
{
    for (int i = 0; i <= 255 * RESPONSE_STEPS; i++) {
        const double encoded =
            255.0 * std::pow(static_cast<double>(i) / (255.0 * RESPONSE_STEPS), 1.0 / config_.camera.gamma);
        response_.push_back(static_cast<uint8_t>(std::lround(encoded)));
    }
}

bool Scene::on_sensor(const double px[2]) const
{
    return px[0] >= -0.5 && px[1] >= -0.5 && px[0] <= config_.camera.width - 0.5 &&
           px[1] <= config_.camera.height - 0.5;
}

bool Scene::ray(const double px[2], PixelRay &ray) const
{
    const double u = px[0] - config_.camera.c_u, v = px[1] - config_.camera.c_v, r = std::hypot(u, v);
    double theta = 0.0;
    if (!on_sensor(px) || !lens_.theta_of_radius(r, theta)) {
        return false;
    }
    const double s = r > 0.0 ? std::sin(theta) / r : 0.0;
    ray = {s * u, s * v, std::cos(theta), lens_.pupil(theta)};
    return true;
}

bool Scene::cast(int frame, const double px[2], double world[3]) const
{
    PixelRay r{};
    Hit hit{};
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    const Tube::View view(tube_, f.world_from_cam, f.centre);
    if (!ray(px, r) || !view.cast({0.0, 0.0, r.pupil}, {r.dx, r.dy, r.dz}, hit)) {
        return false;
    }
    const Eigen::Vector3d local(hit.t * r.dx, hit.t * r.dy, r.pupil + hit.t * r.dz);
    Eigen::Map<Eigen::Vector3d>(world, 3) = f.centre + f.world_from_cam * local;
    return true;
}

bool Scene::project(int frame, const double world[3], double px[2]) const
{
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    const Eigen::Vector3d p = f.world_from_cam.transpose() * (Eigen::Map<const Eigen::Vector3d>(world) - f.centre);
    const double rho = std::hypot(p.x(), p.y());
    double theta = 0.0;
    if (!lens_.theta_of_point(rho, p.z(), theta)) {
        return false;
    }
    const double scale = rho > 0.0 ? lens_.radius(theta) / rho : 0.0;
    const double found[2] = {config_.camera.c_u + scale * p.x(), config_.camera.c_v + scale * p.y()};
    if (!on_sensor(found)) {
        return false;
    }
    px[0] = found[0];
    px[1] = found[1];
    return true;
}

} // namespace pipefish::sim
