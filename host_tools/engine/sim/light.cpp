#include "sim/light.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::sim
{

namespace
{

constexpr double PI = std::numbers::pi;
// The table of Ambient: 6 radii behind the camera, 40 ahead, ten nodes a radius.
constexpr int NODES_A_RADIUS = 10, BEHIND = 6, AHEAD = 40;

// Antiderivative over x of the view factor from a ring to a ring element at distance 2 R x of an infinite cylinder,
// 1 - (2 x^3 + 3 x) / (2 (x^2 + 1)^1.5); odd, +-1/2 at infinity.
double exchange(double x)
{
    const double y = std::abs(x), value = y - (2.0 * y * y + 1.0) / (2.0 * std::sqrt(1.0 + y * y)) + 0.5;
    return std::copysign(value, x);
}

} // namespace

std::vector<Lamp> make_lamps(const LampSpec &spec)
{
    std::vector<LampPlace> places;
    if (spec.layout == LampLayout::LIST) {
        places = spec.list;
    } else {
        const int n = spec.layout == LampLayout::SIDES ? 2 : spec.lamps;
        for (int k = 0; k < n; k++) {
            const double angle = 2.0 * PI * k / n + (spec.layout == LampLayout::SIDES ? 0.5 * PI : 0.0);
            places.push_back({.x = spec.ring_radius * std::sin(angle), .y = -spec.ring_radius * std::cos(angle)});
        }
    }
    std::vector<Lamp> lamps;
    for (const LampPlace &p : places) {
        const double share = p.intensity / static_cast<double>(places.size());
        lamps.push_back({static_cast<float>(p.x), static_cast<float>(p.y), static_cast<float>(p.z),
                         static_cast<float>(std::sin(p.yaw) * std::cos(p.pitch)),
                         static_cast<float>(-std::sin(p.pitch)),
                         static_cast<float>(std::cos(p.yaw) * std::cos(p.pitch)), static_cast<float>(share * spec.side),
                         static_cast<float>(share * spec.forward)});
    }
    return lamps;
}

double flicker_level(const FlickerSpec &spec, double time, double shutter)
{
    if (spec.amplitude == 0.0) {
        return 1.0;
    }
    const double from = spec.frequency * time, width = spec.frequency * shutter;
    if (spec.duty == 0.0) {
        const double half = PI * width, sinc = half > 1e-9 ? std::sin(half) / half : 1.0;
        return 1.0 + spec.amplitude * sinc * std::sin(2.0 * PI * from + half);
    }
    // Bright time up to t periods.
    const auto bright = [&](double t) { return std::floor(t) * spec.duty + std::min(t - std::floor(t), spec.duty); };
    const double share = width > 1e-9 ? (bright(from + width) - bright(from)) / width
                                      : (from - std::floor(from) < spec.duty ? 1.0 : 0.0);
    const double dim = 1.0 - spec.amplitude;
    return (dim + spec.amplitude * share) / (dim + spec.amplitude * spec.duty);
}

Ambient::Ambient(const std::vector<Lamp> &lamps, int exponent, double radius, double albedo)
    : start_(static_cast<float>(-BEHIND * radius)), per_metre_(static_cast<float>(NODES_A_RADIUS / radius))
{
    constexpr int N = (BEHIND + AHEAD) * NODES_A_RADIUS + 1, AROUND = 48;
    direct_.resize(N);
    for (int i = 0; i < N; i++) {
        const double z = radius * (static_cast<double>(i) / NODES_A_RADIUS - BEHIND);
        double sum = 0.0;
        for (const Lamp &lamp : lamps) {
            for (int k = 0; k < AROUND; k++) {
                const double x = radius * std::sin(2.0 * PI * k / AROUND), y = radius * std::cos(2.0 * PI * k / AROUND);
                const double dx = x - static_cast<double>(lamp.x), dy = y - static_cast<double>(lamp.y);
                const double dz = z - static_cast<double>(lamp.z), d = std::sqrt(dx * dx + dy * dy + dz * dz);
                const double cosine = (dx * static_cast<double>(lamp.dx) + dy * static_cast<double>(lamp.dy) +
                                       dz * static_cast<double>(lamp.dz)) /
                                      d;
                sum += static_cast<double>(beam(lamp, exponent, static_cast<float>(cosine))) * (dx * x + dy * y) /
                       (radius * d * d * d);
            }
        }
        direct_[static_cast<size_t>(i)] = static_cast<float>(sum / AROUND);
    }
    std::vector<double> kernel(N); // of the node k nodes away: the view factor to its cell
    for (int k = 0; k < N; k++) {
        const double half = 0.25 / NODES_A_RADIUS, x = 0.5 * k / NODES_A_RADIUS;
        kernel[static_cast<size_t>(k)] = exchange(x + half) - exchange(x - half);
    }
    std::vector<double> bounced(N, 0.0);
    for (int pass = 0; pass < 40 && std::pow(albedo, pass) > 1e-4; pass++) {
        std::vector<double> next(N, 0.0);
        for (int i = 0; i < N; i++) {
            for (int k = 0; k < N; k++) {
                const size_t j = static_cast<size_t>(k);
                next[static_cast<size_t>(i)] += kernel[static_cast<size_t>(std::abs(i - k))] * albedo *
                                                (static_cast<double>(direct_[j]) + bounced[j]);
            }
        }
        bounced = next;
    }
    bounced_.assign(bounced.begin(), bounced.end());
}

float Ambient::at(const std::vector<float> &table, float z) const
{
    const float last = static_cast<float>(table.size() - 1), x = std::clamp((z - start_) * per_metre_, 0.0f, last);
    const size_t i = static_cast<size_t>(std::min(x, last - 1.0f));
    return table[i] + (x - static_cast<float>(i)) * (table[i + 1] - table[i]);
}

double fog_veil(const FogSpec &fog, const std::vector<Lamp> &lamps, int exponent, double size, const double origin[3],
                const double direction[3], double depth)
{
    // Gauss and Legendre on -1..1, eight nodes.
    constexpr double NODE[] = {0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363};
    constexpr double WEIGHT[] = {0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763};
    const double g = fog.anisotropy;
    double veil = 0.0;
    for (const Lamp &lamp : lamps) {
        const double to[3] = {static_cast<double>(lamp.x) - origin[0], static_cast<double>(lamp.y) - origin[1],
                              static_cast<double>(lamp.z) - origin[2]};
        const double nearest = to[0] * direction[0] + to[1] * direction[1] + to[2] * direction[2];
        const double h =
            std::max(std::sqrt(std::max(to[0] * to[0] + to[1] * to[1] + to[2] * to[2] - nearest * nearest, 0.0)),
                     std::max(size, 1e-3));
        const double from = std::atan2(-nearest, h), until = std::atan2(depth - nearest, h);
        for (int k = 0; k < 8; k++) {
            const double node = k < 4 ? NODE[k] : -NODE[k - 4];
            const double angle = 0.5 * (from + until) + 0.5 * (until - from) * node;
            const double t = nearest + h * std::tan(angle), away = h / std::cos(angle);
            double out[3]; // unit, from the lamp to the place
            for (int c = 0; c < 3; c++) {
                out[c] = (t * direction[c] - to[c]) / away;
            }
            const double axis = out[0] * static_cast<double>(lamp.dx) + out[1] * static_cast<double>(lamp.dy) +
                                out[2] * static_cast<double>(lamp.dz);
            const double turn = -(out[0] * direction[0] + out[1] * direction[1] + out[2] * direction[2]);
            const double phase = (1.0 - g * g) / (4.0 * PI * std::pow(1.0 + g * g - 2.0 * g * turn, 1.5));
            veil += WEIGHT[k % 4] * 0.5 * (until - from) / h * phase *
                    static_cast<double>(beam(lamp, exponent, static_cast<float>(axis))) *
                    std::exp(-fog.density * (t + away));
        }
    }
    return PI * fog.density * fog.albedo * veil; // PI: the units are those of albedo x irradiance
}

} // namespace pipefish::sim
