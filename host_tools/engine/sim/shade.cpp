// Shading: the light on the wall points that the rays of a frame met, and what the surface makes of it.
#include "sim/shade.hpp"
#include "parallel.hpp"

#include "sim/brdf.hpp"
#include "sim/buffers.hpp"
#include "sim/scene.hpp"
#include "sim/wide.hpp"

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

// Light of one lamp: E (1 - R) onto `matt`, E pi D V F onto `shine`, with E the irradiance. FOGGY dims it on its way,
// SHADED by p.lit.
template <bool FOGGY, bool SHADED, typename Power>
[[gnu::always_inline]] inline void add_lamp(const Samples &p, size_t from, size_t n, size_t which,
                                            const Lighting &light, const Power &power, Block &block)
{
    const Lamp lamp = light.lamps[which];
    const float *__restrict const x = p.x.data() + from, *__restrict const y = p.y.data() + from,
                                  *__restrict const z = p.z.data() + from;
    const float *__restrict const nx = p.nx.data() + from, *__restrict const ny = p.ny.data() + from,
                                  *__restrict const nz = p.nz.data() + from;
    const float *__restrict const vx = p.vx.data() + from, *__restrict const vy = p.vy.data() + from,
                                  *__restrict const vz = p.vz.data() + from;
    const float *__restrict const nv = p.nv.data() + from, *__restrict const alpha2 = p.alpha2.data() + from;
    const float *__restrict const alpha = block.alpha, *__restrict const rise = block.rise;
    const float *__restrict const lit = SHADED ? p.lit.data() + which * p.size() + from : nullptr;
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
        if constexpr (SHADED) {
            light_on *= lit[i];
        }
        matt[i] += light_on * (1.0f - gloss * (F0 + rise[i] * power5(1.0f - nl)));
        shine[i] += light_on * mirrored(nl, nv[i], lv, alpha2[i] + widen * fall, alpha[i]);
    }
}

template <bool FOGGY, bool SHADED>
[[gnu::always_inline]] inline void add_lamps(const Samples &p, size_t from, size_t n, const Lighting &light,
                                             Block &block)
{
    for (size_t lamp = 0; lamp < light.lamps.size(); lamp++) {
        if (light.exponent == 2) {
            add_lamp<FOGGY, SHADED>(
                p, from, n, lamp, light, [](float c) { return c * c; }, block);
        } else {
            const int exponent = light.exponent;
            add_lamp<FOGGY, SHADED>(
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
        matt += p.sky[i] * light.bounce * light.ambient.bounced(p.along[i]);
        // A ray through the axis meets the wall again as far on as the tangent of its angle of incidence says.
        const float tangent = std::sqrt(std::max(1.0f - p.nv[i] * p.nv[i], 0.0f)) / p.nv[i];
        const float there = p.along[i] + std::copysign(2.0f * light.radius * tangent, p.along[i]);
        seen = p.sky[i] * light.bounce * light.albedo *
               (light.ambient.direct(there) + light.bounce * light.ambient.bounced(there));
    }
    const float sum = p.albedo[i] * (1.0f - light.gloss * taken) * matt + light.gloss * (shine + taken * seen);
    return light.density > 0.0f
               ? sum * std::exp(-light.density * std::sqrt(p.x[i] * p.x[i] + p.y[i] * p.y[i] + p.z[i] * p.z[i]))
               : sum;
}

} // namespace

PIPEFISH_WIDE void shade(const Samples &p, const Lighting &light, float *out)
{
    for (size_t from = 0; from < p.size(); from += BLOCK) {
        const size_t n = std::min(BLOCK, p.size() - from);
        Block block{};
        for (size_t i = 0; i < n; i++) {
            block.alpha[i] = std::sqrt(p.alpha2[from + i]);
            block.rise[i] = rise_of(block.alpha[i]);
        }
        if (light.density > 0.0f) {
            p.lit.empty() ? add_lamps<true, false>(p, from, n, light, block)
                          : add_lamps<true, true>(p, from, n, light, block);
        } else {
            p.lit.empty() ? add_lamps<false, false>(p, from, n, light, block)
                          : add_lamps<false, true>(p, from, n, light, block);
        }
        for (size_t i = 0; i < n; i++) {
            out[from + i] = light.scale * level(p, from + i, light, block.matt[i], block.shine[i], block.rise[i]);
        }
    }
}

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
    set_looks();
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
    const Gaze from = gaze(f.time);
    const double step = 2.0 * lens_.circle_radius() / ACROSS;
    RowPoints points(0, f.s);
    uint32_t n = 0;
    for (int k = 0; k < ACROSS * ACROSS; k++) {
        const double px[2] = {spec_.lens.c_u - lens_.circle_radius() + (k % ACROSS + 0.5) * step,
                              spec_.lens.c_v - lens_.circle_radius() + (k / ACROSS + 0.5) * step};
        PixelRay r{};
        Sight sight{};
        if (ray(px, r) && from.view.see({0.0, 0.0, r.pupil}, {r.dx, r.dy, r.dz}, sight)) {
            put_sight(from.view, r, sight, nullptr, 1.0f, n++, points);
        }
    }
    std::vector<float> levels(points.samples.size()), out(n, 0.0f);
    shade(points.samples, shading_->lighting, levels.data());
    for (size_t i = 0; i < levels.size(); i++) {
        out[points.pixel[i]] += points.weight[i] * levels[i];
    }
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

void Scene::shade_row(int frame, const Tube::View &view, int row, Buffers &buffers) const
{
    const size_t at = static_cast<size_t>(row), width = static_cast<size_t>(spec_.lens.width);
    const size_t from = static_cast<size_t>(row_from_[at]), n = static_cast<size_t>(row_to_[at]) - from;
    const Shading &now = *shading_;
    const float gain = static_cast<float>(now.gain[static_cast<size_t>(frame)] * flicker(frame, row)) * buffers.share;
    RowPoints points = gather_row(view, row, buffers);
    find_shadows(view, points);
    std::vector<float> levels(points.samples.size()), sum(n, 0.0f);
    shade(points.samples, now.lighting, levels.data());
    for (size_t i = 0; i < levels.size(); i++) {
        sum[points.pixel[i]] += points.weight[i] * levels[i];
    }
    const RowHits &hits = buffers.hits[at];
    float *const line = buffers.image.data() + at * width + from;
    for (size_t i = 0; i < n; i++) {
        if (!now.veil.nodes.empty()) {
            const float depth = std::sqrt(hits.x[i] * hits.x[i] + hits.y[i] * hits.y[i] + hits.z[i] * hits.z[i]);
            sum[i] += now.veil.at(static_cast<float>(from + i), static_cast<float>(row), depth);
        }
        line[i] += sum[i] * vignette_[row_offset_[at] + i] * gain;
    }
}

} // namespace pipefish::sim
