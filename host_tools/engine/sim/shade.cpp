// Shading: the light on the wall points that the rays of a frame met, and what the surface makes of it.
#include "sim/shade.hpp"

#include "sim/brdf.hpp"
#include "sim/buffers.hpp"
#include "sim/parallel.hpp"
#include "sim/scene.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <thread>

namespace pipefish::sim
{

namespace
{

constexpr size_t BLOCK = 64; // points that are lit at a time: what is known of them stays in the nearest cache

// A block of points as the lamps' loop wants it.
struct Block {
    float alpha[BLOCK], rise[BLOCK]; // roughness; rise_of() it
    float matt[BLOCK], shine[BLOCK];
};

// Light of one lamp: E (1 - R) onto `matt`, E pi D V F onto `shine`, with E the irradiance. FOGGY dims it on its way.
template <bool FOGGY, typename Power>
void add_lamp(const Samples &p, size_t from, size_t n, const Lamp lamp, const Lighting &light, const Power &power,
              Block &block)
{
    const float *__restrict const x = p.x.data() + from, *__restrict const y = p.y.data() + from,
                                  *__restrict const z = p.z.data() + from;
    const float *__restrict const nx = p.nx.data() + from, *__restrict const ny = p.ny.data() + from,
                                  *__restrict const nz = p.nz.data() + from;
    const float *__restrict const vx = p.vx.data() + from, *__restrict const vy = p.vy.data() + from,
                                  *__restrict const vz = p.vz.data() + from;
    const float *__restrict const nv = p.nv.data() + from, *__restrict const alpha2 = p.alpha2.data() + from;
    const float *__restrict const alpha = block.alpha, *__restrict const rise = block.rise;
    float *__restrict const matt = block.matt, *__restrict const shine = block.shine;
    const float gloss = light.gloss, widen = light.widen, density = light.density;
    for (size_t i = 0; i < n; i++) {
        const float dx = lamp.x - x[i], dy = lamp.y - y[i], dz = lamp.z - z[i];
        const float d2 = dx * dx + dy * dy + dz * dz, inverse = 1.0f / std::sqrt(d2), fall = inverse * inverse;
        const float facing = (dx * nx[i] + dy * ny[i] + dz * nz[i]) * inverse, nl = positive(facing);
        const float lv = (dx * vx[i] + dy * vy[i] + dz * vz[i]) * inverse;
        const float cosine = -(dx * lamp.dx + dy * lamp.dy + dz * lamp.dz) * inverse;
        float light_on = (lamp.side + lamp.forward * power(positive(cosine))) * fall * nl;
        if constexpr (FOGGY) {
            light_on *= std::exp(-density * d2 * inverse);
        }
        matt[i] += light_on * (1.0f - gloss * (F0 + rise[i] * power5(1.0f - nl)));
        shine[i] += light_on * mirrored(nl, nv[i], lv, alpha2[i] + widen * fall, alpha[i]);
    }
}

template <bool FOGGY> void add_lamps(const Samples &p, size_t from, size_t n, const Lighting &light, Block &block)
{
    for (const Lamp &lamp : light.lamps) {
        if (light.exponent == 2) {
            add_lamp<FOGGY>(
                p, from, n, lamp, light, [](float c) { return c * c; }, block);
        } else {
            const int exponent = light.exponent;
            add_lamp<FOGGY>(
                p, from, n, lamp, light,
                [exponent](float c) {
                    float power = 1.0f;
                    for (int k = 0; k < exponent; k++) {
                        power *= c;
                    }
                    return power;
                },
                block);
        }
    }
}

} // namespace

Lighting::Lighting(const LampSpec &lamp, const FogSpec &fog, double pipe_radius, double wall_albedo, double gloss_)
    : lamps(make_lamps(lamp)), exponent(lamp.exponent), widen(static_cast<float>(lamp.size * lamp.size / 32.0)),
      scale(static_cast<float>(lamp.exposure * pipe_radius * pipe_radius)), radius(static_cast<float>(pipe_radius)),
      albedo(static_cast<float>(wall_albedo)), bounce(static_cast<float>(lamp.bounce)),
      gloss(static_cast<float>(gloss_)), density(static_cast<float>(fog.density)),
      ambient(lamps, lamp.exponent, pipe_radius, wall_albedo)
{
}

namespace
{

// What point i sends to the camera: the lamps' light on it, the wall's, and the mirror image of the wall opposite.
float level(const Samples &p, size_t i, const Lighting &light, float matt, float shine, float rise)
{
    if (p.nx[i] * p.nx[i] + p.ny[i] * p.ny[i] + p.nz[i] * p.nz[i] == 0.0f) {
        return 0.0f;
    }
    const float taken = F0 + rise * power5(1.0f - p.nv[i]);
    float seen = 0.0f;
    if (light.bounce > 0.0f) {
        matt += light.bounce * light.ambient.bounced(p.along[i]);
        // A ray through the axis meets the wall again as far on as the tangent of its angle of incidence says.
        const float tangent = std::sqrt(std::max(1.0f - p.nv[i] * p.nv[i], 0.0f)) / p.nv[i];
        const float there = p.along[i] + std::copysign(2.0f * light.radius * tangent, p.along[i]);
        seen =
            light.bounce * light.albedo * (light.ambient.direct(there) + light.bounce * light.ambient.bounced(there));
    }
    const float sum = p.albedo[i] * (1.0f - light.gloss * taken) * matt + light.gloss * (shine + taken * seen);
    return light.density > 0.0f
               ? sum * std::exp(-light.density * std::sqrt(p.x[i] * p.x[i] + p.y[i] * p.y[i] + p.z[i] * p.z[i]))
               : sum;
}

} // namespace

void shade(const Samples &p, const Lighting &light, float *out)
{
    for (size_t from = 0; from < p.size(); from += BLOCK) {
        const size_t n = std::min(BLOCK, p.size() - from);
        Block block{};
        for (size_t i = 0; i < n; i++) {
            block.alpha[i] = std::sqrt(p.alpha2[from + i]);
            block.rise[i] = rise_of(block.alpha[i]);
        }
        if (light.density > 0.0f) {
            add_lamps<true>(p, from, n, light, block);
        } else {
            add_lamps<false>(p, from, n, light, block);
        }
        for (size_t i = 0; i < n; i++) {
            out[from + i] = light.scale * level(p, from + i, light, block.matt[i], block.shine[i], block.rise[i]);
        }
    }
}

namespace
{

// A wall's normal tilted by its relief: t_s along the pipe, t_c clockwise.
void tilt(const Texel &texel, const Eigen::Vector3f &normal, const Eigen::Vector3f &axis, Samples &out, size_t i)
{
    const Eigen::Vector3f clockwise = normal.cross(axis).normalized(), along = clockwise.cross(normal);
    const Eigen::Vector3f n = (normal - texel.slope_s * along - texel.slope_clock * clockwise).normalized();
    out.set_normal(i, n);
}

} // namespace

void Scene::make_shading()
{
    const TextureSpec &texture = spec_.texture;
    const bool shiny = texture.contrast > 0.0 || texture.roughness > 0.0;
    const double radius = 0.5 * spec_.diameter;
    Lighting lighting(spec_.lamp, spec_.fog, radius, static_cast<double>(wall_look(texture).albedo),
                      shiny ? texture.gloss : 0.0);
    Window window(spec_.window, spec_.lens.width, spec_.lens.height, spec_.lens.c_u, spec_.lens.c_v,
                  lens_.circle_radius());
    shading_ = std::make_unique<Shading>(Shading{std::move(lighting), std::move(window)});
    if (spec_.fog.density > 0.0) {
        make_veil();
    }
    const int frames = spec_.motion.frames;
    std::vector<std::vector<float>> metered(static_cast<size_t>(frames));
    if (spec_.exposure.mode == ExposureMode::AUTO) {
        parallel_for(frames, static_cast<int>(std::thread::hardware_concurrency()),
                     [&](int f) { metered[static_cast<size_t>(f)] = meter(f); });
    }
    shading_->gain = exposure_gains(spec_.exposure, frames, metered);
}

double Scene::flicker(int frame, double row) const
{
    const double shutter = spec_.sensor.exposure_s;
    return flicker_level(spec_.lamp.flicker, row_time(frame, row) - 0.5 * shutter, shutter);
}

double Scene::light_level(int frame)
{
    const std::lock_guard<std::mutex> guard(rendering_);
    if (!buffers_) {
        prepare();
    }
    return shading_->gain[static_cast<size_t>(frame)] * flicker(frame, 0.5 * (spec_.lens.height - 1));
}

// What the exposure's control loop sees of a frame: the plain wall in a coarse grid of pixels, at gain 1.
std::vector<float> Scene::meter(int frame) const
{
    constexpr int ACROSS = 20;
    const FrameState &f = frames_[static_cast<size_t>(frame)];
    const Tube::View view(tube_, f.world_from_cam, f.centre);
    const WallLook look = wall_look(spec_.texture);
    const double step = 2.0 * lens_.circle_radius() / ACROSS;
    Samples samples(ACROSS * ACROSS);
    size_t n = 0;
    for (int k = 0; k < ACROSS * ACROSS; k++) {
        const double px[2] = {spec_.lens.c_u - lens_.circle_radius() + (k % ACROSS + 0.5) * step,
                              spec_.lens.c_v - lens_.circle_radius() + (k / ACROSS + 0.5) * step};
        PixelRay r{};
        Hit hit{};
        if (!ray(px, r) || !view.cast({0.0, 0.0, r.pupil}, {r.dx, r.dy, r.dz}, hit)) {
            continue;
        }
        samples.x[n] = static_cast<float>(hit.t * r.dx);
        samples.y[n] = static_cast<float>(hit.t * r.dy);
        samples.z[n] = static_cast<float>(r.pupil + hit.t * r.dz);
        samples.vx[n] = static_cast<float>(-r.dx);
        samples.vy[n] = static_cast<float>(-r.dy);
        samples.vz[n] = static_cast<float>(-r.dz);
        samples.set_normal(n, hit.normal.cast<float>());
        samples.albedo[n] = look.albedo;
        samples.alpha2[n] = look.alpha * look.alpha;
        samples.along[n] = static_cast<float>(hit.s - f.s);
        n++;
    }
    std::vector<float> out(samples.size());
    shade(samples, shading_->lighting, out.data());
    out.resize(n);
    const float level = static_cast<float>(flicker(frame, 0.5 * (spec_.lens.height - 1)));
    for (float &place : out) {
        place *= level;
    }
    return out;
}

void Scene::make_veil()
{
    Veil &veil = shading_->veil;
    veil.columns = (spec_.lens.width - 1) / Veil::STEP + 2;
    veil.rows = (spec_.lens.height - 1) / Veil::STEP + 2;
    veil.radius = static_cast<float>(0.5 * spec_.diameter);
    const Lighting &light = shading_->lighting;
    for (int y = 0; y < veil.rows; y++) {
        for (int x = 0; x < veil.columns; x++) {
            const double px[2] = {static_cast<double>(x * Veil::STEP), static_cast<double>(y * Veil::STEP)};
            PixelRay r{};
            if (!ray(px, r)) { // beyond the picture the field goes on evenly: those nodes serve the rim's pixels
                const double u = px[0] - spec_.lens.c_u, v = px[1] - spec_.lens.c_v;
                const double theta = lens_.theta_max() * std::hypot(u, v) / lens_.circle_radius();
                const double share = std::sin(theta) / std::max(std::hypot(u, v), 1e-9);
                r = {share * u, share * v, std::cos(theta), lens_.pupil(std::min(theta, lens_.theta_max()))};
            }
            const double origin[3] = {0.0, 0.0, r.pupil}, direction[3] = {r.dx, r.dy, r.dz};
            for (int k = 0; k < Veil::DEPTHS; k++) {
                const double share = static_cast<double>(k) / Veil::DEPTHS;
                const double depth = 0.5 * spec_.diameter * share / (1.0 - share);
                veil.nodes.push_back(light.scale *
                                     static_cast<float>(fog_veil(spec_.fog, light.lamps, light.exponent,
                                                                 spec_.lamp.size, origin, direction, depth)));
            }
        }
    }
}

float Veil::at(float x, float y, float depth) const
{
    const float u = x / STEP, v = y / STEP;
    const float w = std::min(depth / (depth + radius) * DEPTHS, static_cast<float>(DEPTHS) - 1.001f);
    const size_t i = static_cast<size_t>(u), j = static_cast<size_t>(v), k = static_cast<size_t>(w);
    const float fu = u - static_cast<float>(i), fv = v - static_cast<float>(j), fw = w - static_cast<float>(k);
    const auto node = [&](size_t a, size_t b) {
        const float *const column = nodes.data() + ((j + b) * static_cast<size_t>(columns) + i + a) * DEPTHS + k;
        return column[0] + fw * (column[1] - column[0]);
    };
    const float top = node(0, 0) + fu * (node(1, 0) - node(0, 0)), bottom = node(0, 1) + fu * (node(1, 1) - node(0, 1));
    return top + fv * (bottom - top);
}

// The pipe's direction in the camera's frame, a tenth of a radius apart along the wall that is made.
void Scene::prepare_shading(const CameraState &f)
{
    Shading &now = *shading_;
    now.per_metre = 10.0 / (0.5 * spec_.diameter);
    now.start = f.s - reach_.behind;
    now.camera_s = f.s;
    const int nodes = static_cast<int>((reach_.behind + reach_.ahead) * now.per_metre) + 2;
    now.axis.clear();
    for (int i = 0; i < nodes; i++) {
        const Eigen::Vector3d tangent = tube_.frame(now.start + i / now.per_metre).world_from_frame.col(2);
        now.axis.push_back((f.world_from_cam.transpose() * tangent).cast<float>());
    }
}

// How many texels a pixel covers along and around, from its neighbours' places. Where one neighbour lies far away (an
// edge stands between), the other one counts.
Scene::Footprint Scene::footprint(int row, int x, size_t own, const Buffers &buffers) const
{
    const int height = spec_.lens.height;
    const float around = static_cast<float>(surface_->around());
    const auto step = [&](int at_x, int at_y, float &along, float &across) {
        const size_t at = static_cast<size_t>(at_y);
        if (at_y < 0 || at_y >= height || at_x < row_from_[at] || at_x >= row_to_[at]) {
            return -1.0f;
        }
        const size_t other = row_offset_[at] + static_cast<size_t>(at_x - row_from_[at]);
        along = buffers.texel_row[other] - buffers.texel_row[own];
        across = buffers.texel_column[other] - buffers.texel_column[own];
        across -= around * std::nearbyint(across / around);
        return along * along + across * across;
    };
    Footprint sum{0.0f, 0.0f};
    const auto direction = [&](int dx, int dy) {
        float along_a = 0.0f, across_a = 0.0f, along_b = 0.0f, across_b = 0.0f;
        const float a = step(x + dx, row + dy, along_a, across_a), b = step(x - dx, row - dy, along_b, across_b);
        if (a < 0.0f && b < 0.0f) {
            return;
        }
        constexpr float FAR = 16.0f; // four times the other's distance, squared
        float along, across;
        if (b < 0.0f || (a >= 0.0f && b > FAR * a)) {
            along = along_a, across = across_a;
        } else if (a < 0.0f || a > FAR * b) {
            along = along_b, across = across_b;
        } else {
            along = 0.5f * (along_a - along_b), across = 0.5f * (across_a - across_b);
        }
        sum.along += along * along;
        sum.across += across * across;
    };
    direction(1, 0);
    direction(0, 1);
    return {std::sqrt(sum.along), std::sqrt(sum.across)};
}

void Scene::shade_row(int frame, int row, Buffers &buffers) const
{
    const size_t at = static_cast<size_t>(row), width = static_cast<size_t>(spec_.lens.width);
    const size_t from = static_cast<size_t>(row_from_[at]), n = static_cast<size_t>(row_to_[at]) - from;
    const RowHits &hits = buffers.hits[at];
    const Shading &now = *shading_;
    const float gain = static_cast<float>(now.gain[static_cast<size_t>(frame)] * flicker(frame, row)) * buffers.share;
    Samples samples(n);
    samples.x = hits.x;
    samples.y = hits.y;
    samples.z = hits.z;
    const double texel = surface_->texel(), base = surface_->base();
    for (size_t i = 0; i < n; i++) {
        const size_t own = row_offset_[at] + i;
        const PixelRay &ray = rays_[own];
        samples.vx[i] = static_cast<float>(-ray.dx);
        samples.vy[i] = static_cast<float>(-ray.dy);
        samples.vz[i] = static_cast<float>(-ray.dz);
        const Eigen::Vector3f normal(hits.nx[i], hits.ny[i], hits.nz[i]);
        if (normal.isZero()) {
            continue;
        }
        const Footprint size = footprint(row, static_cast<int>(from + i), own, buffers);
        const Texel wall = surface_->sample(buffers.texel_row[own], buffers.texel_column[own], size.along, size.across);
        const double s = base + static_cast<double>(buffers.texel_row[own]) * texel;
        const double node = std::clamp((s - now.start) * now.per_metre, 0.0, static_cast<double>(now.axis.size() - 1));
        tilt(wall, normal, now.axis[static_cast<size_t>(node)], samples, i);
        samples.albedo[i] = wall.albedo;
        samples.alpha2[i] = wall.alpha2;
        samples.along[i] = static_cast<float>(s - now.camera_s);
    }
    float *const line = buffers.image.data() + at * width + from;
    std::vector<float> levels(n);
    shade(samples, now.lighting, levels.data());
    for (size_t i = 0; i < n; i++) {
        float level = levels[i];
        if (!now.veil.nodes.empty()) {
            const float depth = std::sqrt(hits.x[i] * hits.x[i] + hits.y[i] * hits.y[i] + hits.z[i] * hits.z[i]);
            level += now.veil.at(static_cast<float>(from + i), static_cast<float>(row), depth);
        }
        line[i] += level * vignette_[row_offset_[at] + i] * gain;
    }
}

} // namespace pipefish::sim
