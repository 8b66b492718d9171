// Fields of the simulator's lens and sensor.
#pragma once

#include "bind/sim_fields.hpp"
#include "sim/lens.hpp"
#include "sim/sensor.hpp"

namespace pipefish::sim
{

template <> struct Names<LensPreset> {
    static constexpr std::array values = {"fisheye-185", "fisheye-220", "wide-120",
                                          "narrow-60",   "hyperbolic",  "equiangular"};
};

template <typename F> void fields(F &f, LensNode &n)
{
    f("theta", n.theta, 0, 3);
    f("radius_px", n.radius_px, 0, 20000);
    f("pupil_m", n.pupil_m, -0.1, 0.1);
}

template <typename F> void fields(F &f, LensHarmonic &h)
{
    f("harmonic", h.harmonic, 1, 3);
    f("radial_px", h.radial_px, -20, 20);
    f("tangential_px", h.tangential_px, -20, 20);
    f("phase", h.phase, -kTurn, kTurn);
}

template <typename F> void fields(F &f, LensProfile &p)
{
    f("f_u", p.f_u, 0, 1e5); // 0: no profile
    f("f_v", p.f_v, 0, 1e5);
    f("skew", p.skew, -1e5, 1e5);
    f("k2", p.k2, -1e6, 1e6);
    f("k3", p.k3, -1e6, 1e6);
    f("k4", p.k4, -1e6, 1e6);
    f("k5", p.k5, -1e6, 1e6);
    f("asym_radial_theta", p.asym_radial_theta, -1e6, 1e6);
    f("asym_radial_phi", p.asym_radial_phi, -1e6, 1e6);
    f("asym_tangential_theta", p.asym_tangential_theta, -1e6, 1e6);
    f("asym_tangential_phi", p.asym_tangential_phi, -1e6, 1e6);
    f("cpoly", p.cpoly, -1e6, 1e6);
    f("pupil_e1", p.pupil_e1, -0.1, 0.1);
}

template <typename F> void fields(F &f, LensSpec &l)
{
    f("preset", l.preset);
    f("width", l.width, 64, 8192);
    f("height", l.height, 64, 8192);
    if constexpr (F::reads)
        l.apply_preset();
    f("c_u", l.c_u, -8192, 16384);
    f("c_v", l.c_v, -8192, 16384);
    f("theta_min", l.theta_min, 0, 1.5);
    f("theta_max", l.theta_max, 0.1, 3);
    f("circle_radius", l.circle_radius, 10, 10000);
    f("pupil_scale", l.pupil_scale, 0, 10);
    f("zonal_px", l.zonal_px, 0, 2);
    f("table", l.table);
    f("profile", l.profile);
    if constexpr (F::reads)
        if (!l.table.empty() || l.profile.f_u > 0) // a lens as stated has no other flaws than stated
            l.asymmetry.clear();
    f("asymmetry", l.asymmetry);
    f("vignetting", l.vignetting, 0, 1);
    f("rim_blur_px", l.rim_blur_px, 0, 3);
}

template <typename F> void fields(F &f, SensorSpec &s)
{
    f("seed", s.seed, 0, kMaxSeed);
    f("blur_px", s.blur_px, 0, 5);
    f("exposure_s", s.exposure_s, 0, 1);
    f("line_time_s", s.line_time_s, 0, 0.001);
    f("read_noise", s.read_noise, 0, 50);
    f("shot_noise", s.shot_noise, 0, 5);
    f("offset_pattern", s.offset_pattern, 0, 20);
    f("gain_pattern", s.gain_pattern, 0, 0.2);
    f("hot_pixels", s.hot_pixels, 0, 0.01);
    f("bits", s.bits, 8, 10);
    f("jpeg_quality", s.jpeg_quality, 0, 100);
}

// What single ranges cannot say.
inline void check_camera(const LensSpec &lens, const SensorSpec &sensor)
{
    if (!(lens.theta_min < lens.theta_max))
        Reader::fail("lens.theta_min", "must be below theta_max");
    if ((lens.profile.f_u > 0) != (lens.profile.f_v > 0))
        Reader::fail("lens.profile", "needs both f_u and f_v");
    if (lens.profile.f_u > 0 && !lens.table.empty())
        Reader::fail("lens.profile", "the lens is a profile or a table, not both");
    if (lens.profile.f_u > 0 && !lens.asymmetry.empty())
        Reader::fail("lens.asymmetry", "a profile has its own");
    if (sensor.bits == 9)
        Reader::fail("sensor.bits", "must be 8 or 10");
    if (sensor.bits == 10 && sensor.jpeg_quality > 0)
        Reader::fail("sensor.jpeg_quality", "JPEG has 8 bits, not 10");
}

} // namespace pipefish::sim
