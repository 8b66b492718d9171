// The keys and ranges of what makes a wall (sim/wall.hpp), as fields() of bind/sim.cpp wants them.
#pragma once

#include "sim/wall.hpp"

#include <numbers>

namespace pipefish::sim
{

namespace range
{
constexpr double TURN = 2 * std::numbers::pi, SEED = 9007199254740992.0, FAR = 1000; // metres
}

template <typename F> void fields(F &f, JointSpec &j)
{
    f("s", j.s, 0, range::FAR);
    f("gap", j.gap, 0, 1);
    f("depth", j.depth, 0, 1);
    f("step_right", j.step_right, -1, 1);
    f("step_down", j.step_down, -1, 1);
    f("yaw", j.yaw, -0.3, 0.3);
    f("pitch", j.pitch, -0.3, 0.3);
}

template <typename F> void fields(F &f, JointSeries &j)
{
    f("seed", j.seed, 0, range::SEED);
    f("start", j.start, 0, range::FAR);
    f("spacing", j.spacing, 0, 100);
    f("gap", j.gap, 0, 1);
    f("depth", j.depth, 0, 1);
    f("step_sigma", j.step_sigma, 0, 0.1);
    f("angle_sigma", j.angle_sigma, 0, 0.1);
}

template <typename F> void fields(F &f, EggStretch &e)
{
    f("start", e.start, -range::FAR, range::FAR);
    f("end", e.end, -range::FAR, range::FAR);
    f("ramp", e.ramp, 0.001, range::FAR);
    f("share", e.share, 0, 1);
    f("clock", e.clock, -range::TURN, range::TURN);
}

template <typename F> void fields(F &f, Corrugation &c)
{
    f("start", c.start, -range::FAR, range::FAR);
    f("end", c.end, -range::FAR, range::FAR);
    f("ramp", c.ramp, 0.001, range::FAR);
    f("amplitude", c.amplitude, 0, 0.1);
    f("wavelength", c.wavelength, 0.001, 1);
}

template <typename F> void fields(F &f, Deposit &d)
{
    f("s", d.s, -range::FAR, range::FAR);
    f("clock", d.clock, -range::TURN, range::TURN);
    f("length", d.length, 0.01, 100);
    f("extent", d.extent, 0.05, range::TURN);
    f("height", d.height, 0, 1);
    f("roughness", d.roughness, 0, 0.05);
    f("grain", d.grain, 0.001, 0.5);
    f("seed", d.seed, 0, range::SEED);
}

template <typename F> void fields(F &f, WallGrid &g)
{
    f("start", g.start, -range::FAR, range::FAR);
    f("step", g.step, 1e-4, 100);
    f("around", g.around, 0, 4096);
    f("radius", g.radius, 0.001, 10);
}

template <typename F> void fields(F &f, Hole &h)
{
    f("s", h.s, -range::FAR, range::FAR);
    f("clock", h.clock, -range::TURN, range::TURN);
    f("diameter", h.diameter, 1e-4, 1);
    f("depth", h.depth, 1e-4, 10);
}

template <typename F> void fields(F &f, PathPoint &p)
{
    f("s", p.s, -range::FAR, range::FAR);
    f("phi", p.phi, -2 * range::TURN, 2 * range::TURN);
}

template <typename F> void fields(F &f, Crack &c)
{
    f("path", c.path);
    f("width", c.width, 1e-5, 0.1);
    f("depth", c.depth, 1e-5, 1);
    f("meander", c.meander, 0, 0.1);
    f("grain", c.grain, 0.001, 1);
    f("seed", c.seed, 0, range::SEED);
}

template <typename F> void fields(F &f, Lateral &l)
{
    f("s", l.s, -range::FAR, range::FAR);
    f("clock", l.clock, -range::TURN, range::TURN);
    f("diameter", l.diameter, 0.01, 10);
    f("angle", l.angle, 0.3, std::numbers::pi - 0.3);
    f("length", l.length, 0.01, 100);
}

template <typename F> void fields(F &f, Root &r)
{
    f("s", r.s, -range::FAR, range::FAR);
    f("clock", r.clock, -range::TURN, range::TURN);
    f("length", r.length, 0.001, 2);
    f("diameter", r.diameter, 1e-4, 0.2);
    f("strands", r.strands, 1, 50);
    f("branches", r.branches, 0, 50);
    f("spread", r.spread, 0, 2);
    f("seed", r.seed, 0, range::SEED);
}

template <typename F> void fields(F &f, Water &w)
{
    f("s", w.s, -range::FAR, range::FAR);
    f("start", w.start, -range::FAR, range::FAR);
    f("end", w.end, -range::FAR, range::FAR);
    f("depth", w.depth, 0, 10);
    f("sloped", w.sloped, 0, 1);
    f("ripple", w.ripple, 0, 0.3);
    f("ripple_length", w.ripple_length, 0.001, 10);
    f("velocity", w.velocity, -10, 10);
    f("refraction", w.refraction, 1.01, 3);
    f("body", w.body, 0, 1);
    f("seed", w.seed, 0, range::SEED);
}

template <typename F> void fields(F &f, FeatureSpec &w)
{
    f("joints", w.joints);
    f("joint_series", w.joint_series);
    f("eggs", w.eggs);
    f("corrugations", w.corrugations);
    f("deposits", w.deposits);
    f("grid", w.grid);
    f("holes", w.holes);
    f("cracks", w.cracks);
    f("laterals", w.laterals);
    f("roots", w.roots);
    f("water", w.water);
}

} // namespace pipefish::sim
