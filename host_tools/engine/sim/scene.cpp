#include "sim/scene.hpp"

#include "sim/buffers.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

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

LensTable lens_table(const LensSpec &spec)
{
    if (spec.table.empty()) {
        LensTable table = trace_fisheye(spec.theta_max, spec.circle_radius, spec.pupil_scale);
        // Zones left by the polishing of the front lens: three and a half waves between axis and rim, growing outwards,
        // which no polynomial of degree 9 follows.
        for (size_t i = 0; i < table.theta.size(); i++) {
            const double share = table.theta[i] / spec.theta_max;
            table.radius[i] += spec.zonal_px * share * share * std::sin(7.0 * std::numbers::pi * share);
        }
        return table;
    }
    LensTable table;
    for (const LensNode &node : spec.table) {
        table.theta.push_back(node.theta);
        table.radius.push_back(node.radius_px);
        table.pupil.push_back(node.pupil_m);
    }
    return table;
}

} // namespace

// Ahead as far as the lamps light the wall to a tenth of a grey level: the light falls with (radius / distance)^3.
Scene::Reach Scene::lit_reach(const SceneSpec &spec)
{
    const double brightest =
        spec.lamp.exposure * (spec.lamp.side + spec.lamp.forward) * static_cast<double>(Surface::MEAN);
    const double radii = std::clamp(std::cbrt(brightest / 0.1), 4.0, 30.0);
    return {spec.diameter, 0.5 * spec.diameter * radii};
}

Scene::Scene(const SceneSpec &spec)
    : spec_(spec), tube_(0.5 * spec.diameter, spec.pieces, spec.ovals, spec.features), lens_(lens_table(spec.lens)),
      frames_(drive(tube_, spec.motion)), reach_(lit_reach(spec))
{
    spec_.lens.theta_max = lens_.theta_max();
    spec_.lens.circle_radius = lens_.circle_radius();
}

Scene::~Scene() = default;

void Scene::prepare()
{
    surface_.emplace(spec_.texture, spec_.markers, 0.5 * spec_.diameter, texels_around(lens_),
                     reach_.behind + reach_.ahead);
    make_pixel_table();
    make_blur_kernel();
    buffers_ = std::make_unique<Buffers>(rays_.size(), static_cast<size_t>(spec_.lens.width) *
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
}

void Scene::make_blur_kernel()
{
    const double sigma = spec_.sensor.blur_px;
    const int reach = static_cast<int>(std::ceil(3.5 * sigma));
    double sum = 0.0;
    for (int k = -reach; k <= reach; k++) {
        sum += sigma > 0.0 ? std::exp(-0.5 * k * k / (sigma * sigma)) : 1.0;
    }
    for (int k = 0; k <= reach; k++) {
        blur_.push_back(static_cast<float>((sigma > 0.0 ? std::exp(-0.5 * k * k / (sigma * sigma)) : 1.0) / sum));
    }
}

bool Scene::on_sensor(const double px[2]) const
{
    return px[0] >= -0.5 && px[1] >= -0.5 && px[0] <= spec_.lens.width - 0.5 && px[1] <= spec_.lens.height - 0.5;
}

bool Scene::ray(const double px[2], PixelRay &ray) const
{
    const double u = px[0] - spec_.lens.c_u, v = px[1] - spec_.lens.c_v, r = std::hypot(u, v);
    double theta = 0.0;
    if (!on_sensor(px) || !lens_.theta_of_radius(r, theta)) {
        return false;
    }
    const double s = r > 0.0 ? std::sin(theta) / r : 0.0;
    ray = {s * u, s * v, std::cos(theta), lens_.pupil(theta)};
    return true;
}

Tube::View Scene::view(int frame) const
{
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    return {tube_, f.world_from_cam, f.centre, 1e-9 * static_cast<double>(f.time_ns)};
}

bool Scene::see(const Tube::View &view, int frame, const double px[2], Seen &seen) const
{
    PixelRay r{};
    if (!ray(px, r)) {
        return false;
    }
    const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.dx, r.dy, r.dz);
    Sight &sight = seen.sight;
    if (!view.see(origin, direction, sight)) {
        return false;
    }
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    seen.point = f.centre + f.world_from_cam * (origin + sight.first.t * direction);
    seen.normal = f.world_from_cam * sight.first.normal;
    if (sight.mirrors) {
        seen.mirrored = f.centre + f.world_from_cam * (sight.origin + sight.second.t * sight.direction);
    }
    return true;
}

bool Scene::visible(const Tube::View &view, int frame, const double world[3], double px[2]) const
{
    Seen seen{};
    if (!project(frame, world, px) || !see(view, frame, px, seen)) {
        return false;
    }
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    const double distance = (Eigen::Map<const Eigen::Vector3d>(world) - f.centre).norm();
    return (seen.point - f.centre).norm() > distance - 1e-6 * tube_.radius();
}

bool Scene::flow(const Tube::View &view_a, int a, const Tube::View &view_b, int b, const double px[2],
                 double out[2]) const
{
    Seen seen{};
    return see(view_a, a, px, seen) && seen.sight.first.material != Material::WATER &&
           visible(view_b, b, seen.point.data(), out);
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
    const double found[2] = {spec_.lens.c_u + scale * p.x(), spec_.lens.c_v + scale * p.y()};
    if (!on_sensor(found)) {
        return false;
    }
    px[0] = found[0];
    px[1] = found[1];
    return true;
}

} // namespace pipefish::sim
