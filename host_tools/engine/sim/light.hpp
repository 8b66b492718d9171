// Light: the lamps on the camera, what the pipe's wall throws back of it, fog, flicker, exposure. All of it in linear
// grey levels: a white (albedo 1) matt wall, square to a lamp of unit intensity at the pipe's radius, has
// LampSpec::exposure of them.
#pragma once

#include <cstddef>
#include <vector>

namespace pipefish::sim
{

// Camera frame: x right, y down, z along the optical axis, origin at the camera's centre; metres.
struct LampPlace {
    double x = 0.0, y = 0.0, z = 0.0;
    double yaw = 0.0, pitch = 0.0; // radians: the beam's axis, to the right and upwards of the optical axis
    double intensity = 1.0;        // factor
};

enum class LampLayout { RING, SIDES, LIST };

struct FlickerSpec {
    double amplitude = 0.0;   // 0..1; sine: 1 + amplitude sin; PWM: off-time is dimmed to 1 - amplitude
    double frequency = 100.0; // hertz
    double duty = 0.0;        // 0 = sine, else the bright share of the period
};

// Each lamp shines with the intensity side + forward cos^exponent a at the angle a from its beam's axis, and with
// `side` alone behind it; the lamps' mean counts.
struct LampSpec {
    LampLayout layout = LampLayout::RING;
    int lamps = 8;               // on the ring, the first one at the top
    double ring_radius = 0.03;   // metres; of SIDES: right and left of the lens; 0 = all at the camera centre
    std::vector<LampPlace> list; // of LIST
    double side = 0.12, forward = 1.0;
    int exponent = 2;
    double size = 0.004;      // metres, diameter of a lamp: how wide its highlight is at least
    double exposure = 1150.0; // grey levels, see above
    double bounce = 1.0;      // factor of the light that comes from other wall
    FlickerSpec flicker;
};

struct FogSpec {
    double density = 0.0;    // extinction, 1 / m; 0 = clear
    double albedo = 0.95;    // share of it that is scattered, not absorbed
    double anisotropy = 0.6; // mean cosine of the scattering (Henyey and Greenstein)
};

struct Lamp {
    float x, y, z, dx, dy, dz; // place and unit direction of the beam
    float side, forward;       // intensities
};

std::vector<Lamp> make_lamps(const LampSpec &spec);

// Share of the mean light that lamps give in a window of `shutter` seconds from `time` on.
double flicker_level(const FlickerSpec &spec, double time, double shutter);

// Light along a straight round pipe of this radius and mean albedo, the camera on its axis at z = 0: ring means, in the
// units of I / d^2 with I the lamps' mean intensity.
class Ambient
{
public:
    Ambient(const std::vector<Lamp> &lamps, int exponent, double radius, double albedo);
    float direct(float z) const { return at(direct_, z); } // from the lamps
    // From other wall, all bounces: B = K (D + albedo B) with K the exchange between rings of an infinite cylinder.
    float bounced(float z) const { return at(bounced_, z); }

private:
    float at(const std::vector<float> &table, float z) const;
    float start_, per_metre_;
    std::vector<float> direct_, bounced_;
};

// What fog scatters into a view of this ray down to `depth` metres: depth -> veil, in the units of Ambient. By Gauss's
// quadrature in the angle seen from each lamp, which takes the 1 / d^2 out of the integrand; rays pass no
// nearer to a lamp than its size.
double fog_veil(const FogSpec &fog, const std::vector<Lamp> &lamps, int exponent, double size, const double origin[3],
                const double direction[3], double depth);

inline float beam(const Lamp &lamp, int exponent, float cosine)
{
    float power = 1.0f;
    for (int k = 0; k < exponent; k++) {
        power *= cosine;
    }
    return lamp.side + (cosine > 0.0f ? lamp.forward * power : 0.0f);
}

} // namespace pipefish::sim
