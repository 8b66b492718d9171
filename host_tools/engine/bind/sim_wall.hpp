// Fields of what makes a wall (sim/wall.hpp).
#pragma once

#include "bind/sim_fields.hpp"
#include "sim/wall.hpp"

namespace pipefish::sim
{

constexpr double kFar = 1000; // metres

template <typename F> void fields(F &f, JointSpec &j)
{
    f("s", j.s, 0, kFar);
    f("gap", j.gap, 0, 1);
    f("depth", j.depth, 0, 1);
    f("step_right", j.step_right, -1, 1);
    f("step_down", j.step_down, -1, 1);
    f("yaw", j.yaw, -0.3, 0.3);
    f("pitch", j.pitch, -0.3, 0.3);
}

template <typename F> void fields(F &f, JointSeries &j)
{
    f("seed", j.seed, 0, kMaxSeed);
    f("start", j.start, 0, kFar);
    f("spacing", j.spacing, 0, 100);
    f("gap", j.gap, 0, 1);
    f("depth", j.depth, 0, 1);
    f("step_sigma", j.step_sigma, 0, 0.1);
    f("angle_sigma", j.angle_sigma, 0, 0.1);
}

template <typename F> void fields(F &f, EggStretch &e)
{
    f("start", e.start, -kFar, kFar);
    f("end", e.end, -kFar, kFar);
    f("ramp", e.ramp, 0.001, kFar);
    f("share", e.share, 0, 1);
    f("clock", e.clock, -kTurn, kTurn);
}

template <typename F> void fields(F &f, Corrugation &c)
{
    f("start", c.start, -kFar, kFar);
    f("end", c.end, -kFar, kFar);
    f("ramp", c.ramp, 0.001, kFar);
    f("amplitude", c.amplitude, 0, 0.1);
    f("wavelength", c.wavelength, 0.001, 1);
}

template <typename F> void fields(F &f, Deposit &d)
{
    f("s", d.s, -kFar, kFar);
    f("clock", d.clock, -kTurn, kTurn);
    f("length", d.length, 0.01, 100);
    f("extent", d.extent, 0.05, kTurn);
    f("height", d.height, 0, 1);
    f("roughness", d.roughness, 0, 0.05);
    f("grain", d.grain, 0.001, 0.5);
    f("seed", d.seed, 0, kMaxSeed);
}

template <typename F> void fields(F &f, WallGrid &g)
{
    f("start", g.start, -kFar, kFar);
    f("step", g.step, 1e-4, 100);
    f("around", g.around, 0, 4096);
    f("radius", g.radius, 0.001, 10);
}

template <typename F> void fields(F &f, Hole &h)
{
    f("s", h.s, -kFar, kFar);
    f("clock", h.clock, -kTurn, kTurn);
    f("diameter", h.diameter, 1e-4, 1);
    f("depth", h.depth, 1e-4, 10);
}

template <typename F> void fields(F &f, PathPoint &p)
{
    f("s", p.s, -kFar, kFar);
    f("phi", p.phi, -2 * kTurn, 2 * kTurn);
}

template <typename F> void fields(F &f, Crack &c)
{
    f("path", c.path);
    f("width", c.width, 1e-5, 0.1);
    f("depth", c.depth, 1e-5, 1);
    f("meander", c.meander, 0, 0.1);
    f("grain", c.grain, 0.001, 1);
    f("seed", c.seed, 0, kMaxSeed);
}

template <typename F> void fields(F &f, Lateral &l)
{
    f("s", l.s, -kFar, kFar);
    f("clock", l.clock, -kTurn, kTurn);
    f("diameter", l.diameter, 0.01, 10);
    f("angle", l.angle, 0.3, M_PI - 0.3);
    f("length", l.length, 0.01, 100);
}

template <typename F> void fields(F &f, Root &r)
{
    f("s", r.s, -kFar, kFar);
    f("clock", r.clock, -kTurn, kTurn);
    f("length", r.length, 0.001, 2);
    f("diameter", r.diameter, 1e-4, 0.2);
    f("strands", r.strands, 1, 50);
    f("branches", r.branches, 0, 50);
    f("spread", r.spread, 0, 2);
    f("seed", r.seed, 0, kMaxSeed);
}

template <typename F> void fields(F &f, Water &w)
{
    f("s", w.s, -kFar, kFar);
    f("start", w.start, -kFar, kFar);
    f("end", w.end, -kFar, kFar);
    f("depth", w.depth, 0, 10);
    f("sloped", w.sloped, 0, 1);
    f("ripple", w.ripple, 0, 0.3);
    f("ripple_length", w.ripple_length, 0.001, 10);
    f("velocity", w.velocity, -10, 10);
    f("refraction", w.refraction, 1.01, 3);
    f("body", w.body, 0, 1);
    f("seed", w.seed, 0, kMaxSeed);
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

// What single ranges cannot say.
inline void check_wall(const FeatureSpec &features)
{
    for (size_t i = 0; i < features.cracks.size(); i++)
        if (features.cracks[i].path.size() < 2)
            Reader::fail("cracks[" + std::to_string(i) + "].path", "needs at least two points");
}

} // namespace pipefish::sim
