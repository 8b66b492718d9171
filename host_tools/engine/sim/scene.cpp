#include "sim/scene.hpp"

#include "sim/buffers.hpp"
#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <string>

namespace pipefish::sim
{

namespace
{

// A power of two that gives the pixels at the rim, where the wall is sharpest, 0.6 to 1.2 texels each.
int texels_around(const Lens &lens)
{
    const double theta = std::min(lens.theta_max(), 0.5 * std::numbers::pi), step = 1e-3;
    const double slant = std::sin(theta) * std::sin(theta); // the wall's distance, and that it is seen at an angle
    const double pixels = 2.0 * std::numbers::pi * slant * (lens.radius(theta) - lens.radius(theta - step)) / step;
    int around = 64;
    while (around < 1.2 * pixels && around < 16384) {
        around *= 2;
    }
    return around;
}

// Wheels dip into the joints' gaps, as deep as their roundness lets them. Steps and angles are the tube's ride().
MotionSpec over_joints(MotionSpec motion, const std::vector<JointSpec> &joints)
{
    constexpr double WHEEL = 0.03; // metres, radius
    for (const JointSpec &joint : joints) {
        const double half = 0.5 * joint.gap;
        if (half > 0.0) {
            const double dip = half < WHEEL ? WHEEL - std::sqrt(WHEEL * WHEEL - half * half) : WHEEL;
            motion.bumps.push_back({joint.s + half, joint.gap, -std::min(dip, joint.depth), 0.0});
        }
    }
    return motion;
}

} // namespace

// Ahead as far as the lamps light the wall to a tenth of a grey level: the light falls with (radius / distance)^3.
Scene::Reach Scene::lit_reach(const SceneSpec &spec)
{
    const double brightest =
        spec.lamp.exposure * (spec.lamp.side + spec.lamp.forward) * static_cast<double>(wall_look(spec.texture).albedo);
    const double radii = std::clamp(std::cbrt(brightest / 0.1), 4.0, 30.0);
    const double ahead = 0.5 * spec.diameter * radii;
    const bool turns = std::any_of(spec.motion.head.begin(), spec.motion.head.end(),
                                   [](const HeadKey &k) { return std::abs(k.pan) + std::abs(k.tilt) > 0.3; });
    return {turns ? ahead : spec.diameter, ahead};
}

Scene::Scene(const SceneSpec &spec)
    : spec_(spec), tube_(0.5 * spec.diameter, spec.pieces, spec.ovals, spec.features), lens_(spec.lens),
      trajectory_(tube_, over_joints(spec.motion, tube_.joints())), frames_(trajectory_.frames()),
      readings_(measure(frames_, spec.telemetry)), reach_(lit_reach(spec))
{
    spec_.lens.theta_max = lens_.theta_max();
    spec_.lens.circle_radius = lens_.circle_radius();
    check_places();
}

// A camera or a lamp where there is no air would draw black or a dry pipe.
void Scene::check_places() const
{
    const auto in_wall = [&](const Eigen::Vector3d &world) {
        WallPoint at{};
        return !tube_.locate(world, at) || !(at.distance < tube_.wall_radius(at.s, at.clock));
    };
    const std::vector<Lamp> lamps = make_lamps(spec_.lamp);
    for (size_t k = 0; k < frames_.size(); k++) {
        const CameraState &camera = frames_[k];
        const std::string when = "at frame " + std::to_string(k) + " ";
        if (in_wall(camera.centre)) {
            throw SpecError("motion: " + when + "the camera would be in the wall or in what lies on it");
        }
        for (size_t i = 0; i < lamps.size(); i++) {
            const Eigen::Vector3f own(lamps[i].x, lamps[i].y, lamps[i].z);
            if (in_wall(camera.centre + camera.world_from_cam * own.cast<double>())) {
                throw SpecError("lamp: " + when + "lamp " + std::to_string(i) +
                                " would be in the wall or in what lies on it");
            }
        }
        const int water = tube_.water_over(camera.centre);
        if (water >= 0) {
            throw SpecError("water[" + std::to_string(water) + "]: " + when + "the camera would be under it");
        }
    }
}

Scene::~Scene() = default;

void Scene::prepare()
{
    surface_.emplace(spec_.texture, spec_.markers, 0.5 * spec_.diameter, texels_around(lens_),
                     reach_.behind + reach_.ahead);
    make_pixel_table();
    film_.emplace(spec_.lens, lens_.circle_radius(), spec_.sensor, spec_.tone);
    make_shading();
    buffers_ = std::make_unique<Buffers>(rays_.size(), static_cast<size_t>(spec_.lens.width),
                                         static_cast<size_t>(spec_.lens.height));
}

void Scene::make_pixel_table()
{
    const LensSpec &camera = spec_.lens;
    for (int y = 0; y < camera.height; y++) {
        row_offset_.push_back(rays_.size());
        int from = camera.width, to = 0;
        for (int x = 0; x < camera.width; x++) {
            const double px[2] = {static_cast<double>(x), static_cast<double>(y)};
            PixelRay r{0.0, 0.0, 1.0, 0.0};
            const bool sees = ray(px, r); // or not, within the ring that a mirror's image is: dark
            if (!sees &&
                !(from < x && std::hypot(px[0] - camera.c_u, px[1] - camera.c_v) < 0.5 * lens_.circle_radius())) {
                continue;
            }
            from = std::min(from, x);
            to = x + 1;
            rays_.push_back(r);
            const double edge = std::acos(std::clamp(r.dz, -1.0, 1.0)) / lens_.theta_max();
            const double light = 1.0 - camera.vignetting * edge * edge * edge * edge;
            vignette_.push_back(sees ? static_cast<float>(light) : 0.0f);
        }
        row_from_.push_back(std::min(from, to));
        row_to_.push_back(to);
    }
}

bool Scene::on_sensor(const double px[2]) const
{
    return px[0] >= -0.5 && px[1] >= -0.5 && px[0] <= spec_.lens.width - 0.5 && px[1] <= spec_.lens.height - 0.5;
}

bool Scene::ray(const double px[2], PixelRay &ray) const
{
    double theta = 0.0, phi = 0.0;
    if (!on_sensor(px) || !lens_.angles(px[0] - spec_.lens.c_u, px[1] - spec_.lens.c_v, theta, phi)) {
        return false;
    }
    const double s = std::sin(theta);
    ray = {s * std::cos(phi), s * std::sin(phi), std::cos(theta), lens_.pupil(theta)};
    return true;
}

double Scene::row_time(int frame, double v) const
{
    return frames_[static_cast<size_t>(frame)].time + (v - 0.5 * (spec_.lens.height - 1)) * spec_.sensor.line_time_s;
}

CameraState Scene::camera(int frame, double v) const
{
    if (spec_.sensor.line_time_s > 0.0) {
        return trajectory_.at(row_time(frame, v));
    }
    return frames_[static_cast<size_t>(frame)];
}

Gaze Scene::gaze(double time) const
{
    const CameraState camera = trajectory_.at(time);
    return {camera, Tube::View(tube_, camera.world_from_cam, camera.centre, time)};
}

const Gaze &FrameView::at(double v)
{
    const double time = scene_.row_time(frame_, v);
    if (!gaze_ || time != time_) {
        gaze_.emplace(scene_.gaze(time));
        time_ = time;
    }
    return *gaze_;
}

bool Scene::see(FrameView &from, const double px[2], Seen &seen) const
{
    return see_from(from.at(px[1]), px, seen);
}

bool Scene::see_from(const Gaze &from, const double px[2], Seen &seen) const
{
    PixelRay r{};
    if (!ray(px, r)) {
        return false;
    }
    const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.dx, r.dy, r.dz);
    Sight &sight = seen.sight;
    if (!from.view.see(origin, direction, sight)) {
        return false;
    }
    const CameraState &camera = from.camera;
    seen.point = camera.centre + camera.world_from_cam * (origin + sight.first.t * direction);
    seen.normal = camera.world_from_cam * sight.first.normal;
    if (sight.mirrors) {
        seen.mirrored = camera.centre + camera.world_from_cam * (sight.origin + sight.second.t * sight.direction);
    }
    return true;
}

bool Scene::visible(FrameView &from, const double world[3], double px[2]) const
{
    Seen seen{};
    if (!project(from.frame(), world, px) || !see(from, px, seen)) {
        return false;
    }
    const Eigen::Vector3d &centre = from.at(px[1]).camera.centre;
    const double distance = (Eigen::Map<const Eigen::Vector3d>(world) - centre).norm();
    return (seen.point - centre).norm() > distance - 1e-6 * tube_.radius();
}

bool Scene::flow(FrameView &a, FrameView &b, const double px[2], double out[2]) const
{
    Seen seen{};
    return see(a, px, seen) && seen.sight.first.material != Material::WATER && visible(b, seen.point.data(), out);
}

bool Scene::project(int frame, const double world[3], double px[2]) const
{
    const double last = spec_.lens.height - 1;
    // The row says when, and when says which row. A row's time is a small part of what the image needs to move by one.
    // A point that comes into the field or leaves it is not there for every row: then another start finds it.
    for (const double start : {0.5, 0.0, 1.0, 0.25, 0.75}) {
        double found[2] = {0.0, start * last};
        for (int k = 0; k < 100; k++) {
            const double row = found[1];
            if (!project_from(camera(frame, row), world, found)) {
                break;
            }
            if (spec_.sensor.line_time_s > 0.0 && !(std::abs(found[1] - row) < 1e-11)) {
                continue;
            }
            if (!on_sensor(found)) {
                return false;
            }
            px[0] = found[0];
            px[1] = found[1];
            return true;
        }
        if (spec_.sensor.line_time_s == 0.0) {
            return false;
        }
    }
    return false;
}

bool Scene::project_from(const CameraState &camera, const double world[3], double px[2]) const
{
    const Eigen::Vector3d p =
        camera.world_from_cam.transpose() * (Eigen::Map<const Eigen::Vector3d>(world) - camera.centre);
    double theta = 0.0;
    if (!lens_.theta_of_point(std::hypot(p.x(), p.y()), p.z(), theta)) {
        return false;
    }
    const Lens::Image at = lens_.image(theta, std::atan2(p.y(), p.x()));
    px[0] = spec_.lens.c_u + at.x;
    px[1] = spec_.lens.c_v + at.y;
    return true;
}

} // namespace pipefish::sim
