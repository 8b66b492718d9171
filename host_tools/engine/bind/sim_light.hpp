// Fields of the simulator's surfaces, light, exposure and window.
#pragma once

#include "bind/sim_fields.hpp"
#include "sim/exposure.hpp"
#include "sim/light.hpp"
#include "sim/material.hpp"
#include "sim/tone.hpp"
#include "sim/window.hpp"

namespace pipefish::sim
{

template <> struct Names<WallMaterial> {
    static constexpr std::array values = {"concrete", "brick", "clay", "pvc", "lined"};
};

template <> struct Names<LampLayout> {
    static constexpr std::array values = {"ring", "sides", "list"};
};

template <> struct Names<ExposureMode> {
    static constexpr std::array values = {"fixed", "script", "auto"};
};

template <typename F> void fields(F &f, TextureSpec &t)
{
    f("material", t.material);
    f("seed", t.seed, 0, kMaxSeed);
    f("contrast", t.contrast, 0, 3);
    f("relief", t.relief, 0, 5);
    f("wear", t.wear, 0, 1);
    f("dirt", t.dirt, 0, 1);
    f("wetness", t.wetness, 0, 1);
    f("gloss", t.gloss, 0, 1);
    f("roughness", t.roughness, 0, 1);
    f("joint_spacing", t.joint_spacing, 0, 100);
}

template <typename F> void fields(F &f, LampPlace &p)
{
    f("x", p.x, -1, 1);
    f("y", p.y, -1, 1);
    f("z", p.z, -1, 1);
    f("yaw", p.yaw, -kTurn, kTurn);
    f("pitch", p.pitch, -kTurn, kTurn);
    f("intensity", p.intensity, 0, 1000);
}

template <typename F> void fields(F &f, FlickerSpec &l)
{
    f("amplitude", l.amplitude, 0, 1);
    f("frequency", l.frequency, 0, 1e6);
    f("duty", l.duty, 0, 1);
}

template <typename F> void fields(F &f, LampSpec &l)
{
    f("layout", l.layout);
    f("lamps", l.lamps, 1, 64);
    f("ring_radius", l.ring_radius, 0, 1);
    f("list", l.list);
    f("side", l.side, 0, 10);
    f("forward", l.forward, 0, 10);
    f("exponent", l.exponent, 0, 64);
    f("size", l.size, 0, 0.1);
    f("exposure", l.exposure, 0, 1e5);
    f("bounce", l.bounce, 0, 2);
    f("flicker", l.flicker);
}

template <typename F> void fields(F &f, FogSpec &s)
{
    f("density", s.density, 0, 100);
    f("albedo", s.albedo, 0, 1);
    f("anisotropy", s.anisotropy, -0.95, 0.95);
}

template <typename F> void fields(F &f, WindowSpec &w)
{
    f("seed", w.seed, 0, kMaxSeed);
    f("drops", w.drops, 0, 1000);
    f("drop_radius", w.drop_radius, 1, 1000);
    f("dirt", w.dirt, 0, 1000);
    f("dirt_radius", w.dirt_radius, 1, 1000);
    f("dirt_density", w.dirt_density, 0, 1);
}

template <typename F> void fields(F &f, ExposureStep &s)
{
    f("frame", s.frame, 0, 1e6);
    f("gain", s.gain, 0, 1000);
}

template <typename F> void fields(F &f, ExposureSpec &e)
{
    f("mode", e.mode);
    f("steps", e.steps);
    f("target", e.target, 1, 254);
    f("step", e.step, 0.01, 2);
    f("slack", e.slack, 0, 4);
    f("interval", e.interval, 1, 10000);
    f("delay", e.delay, 0, 1000);
    f("most", e.most, 1, 1000);
}

template <typename F> void fields(F &f, ToneSpec &t)
{
    f("gamma", t.gamma, 0.2, 5);
    f("knee", t.knee, 0, 1);
}

// What single ranges cannot say.
inline void check_light(const LampSpec &lamp, double diameter)
{
    if (lamp.layout == LampLayout::LIST && lamp.list.empty())
        Reader::fail("lamp.list", "needs at least one lamp");
    if (lamp.layout != LampLayout::LIST && lamp.ring_radius > 0.25 * diameter)
        Reader::fail("lamp.ring_radius", "must be at most a quarter of the pipe's diameter");
    for (size_t i = 0; i < lamp.list.size(); i++)
        if (std::hypot(lamp.list[i].x, lamp.list[i].y) > 0.25 * diameter)
            Reader::fail("lamp.list[" + std::to_string(i) + "]", "must be within a quarter of the pipe's diameter");
}

} // namespace pipefish::sim
