// Fields of the simulator's motion and telemetry.
#pragma once

#include "bind/sim_fields.hpp"
#include "sim/motion.hpp"
#include "sim/telemetry.hpp"

namespace pipefish::sim
{

template <typename F> void fields(F &f, SpeedKey &k)
{
    f("time", k.time, 0, 1e6);
    f("speed", k.speed, -10, 10);
}

template <typename F> void fields(F &f, HeadKey &k)
{
    f("time", k.time, 0, 1e6);
    f("pan", k.pan, -kTurn, kTurn);
    f("tilt", k.tilt, -kTurn, kTurn);
}

template <typename F> void fields(F &f, Bump &b)
{
    f("s", b.s, -1000, 1000);
    f("length", b.length, 0.001, 10);
    f("height", b.height, -0.1, 0.1);
    f("step", b.step, -0.1, 0.1);
}

template <typename F> void fields(F &f, MotionSpec &m)
{
    f("seed", m.seed, 0, kMaxSeed);
    f("frames", m.frames, 1, 1e6);
    f("frame_rate", m.frame_rate, 0.1, 1000);
    f("start", m.start, -100, 1000);
    f("speed", m.speed, -10, 10);
    f("ramp", m.ramp, 0, 1000);
    f("schedule", m.schedule);
    f("below_axis", m.below_axis, -1, 1);
    f("lookahead", m.lookahead, 0.01, 10);
    f("wobble_m", m.wobble_m, 0, 0.1);
    f("wobble_rad", m.wobble_rad, 0, 0.5);
    f("wheelbase", m.wheelbase, 0.01, 10);
    f("camera_ahead", m.camera_ahead, 0, 10);
    f("bumps", m.bumps);
    f("stick_slip_m", m.stick_slip_m, 0, 1);
    f("stick_share", m.stick_share, 0, 0.95);
    f("roll_walk", m.roll_walk, 0, 10);
    f("climb_rad", m.climb_rad, 0, 3.15);
    f("head", m.head);
    f("head_arm", m.head_arm, 0, 1);
}

template <typename F> void fields(F &f, EncoderSlip &s)
{
    f("at", s.at, -1000, 1000);
    f("metres", s.metres, -10, 10);
}

template <typename F> void fields(F &f, TelemetrySpec &t)
{
    f("seed", t.seed, 0, kMaxSeed);
    f("metres_per_count", t.metres_per_count, 1e-6, 1);
    f("encoder_bias", t.encoder_bias, -0.5, 0.5);
    f("encoder_noise", t.encoder_noise, 0, 1000);
    f("encoder_slip", t.encoder_slip, 0, 0.1);
    f("slip_rate", t.slip_rate, 0, 100);
    f("slip_m", t.slip_m, -1, 1);
    f("slips", t.slips);
    f("cable", t.cable);
    f("attitude_sigma", t.attitude_sigma, 0, 0.5);
    f("roll_bias", t.roll_bias, -0.5, 0.5);
    f("pitch_bias", t.pitch_bias, -0.5, 0.5);
    f("time_jitter_s", t.time_jitter_s, 0, 0.1);
    f("drop_rate", t.drop_rate, 0, 0.9);
    f("drop_longest", t.drop_longest, 1, 1000);
}

// What single ranges cannot say. `diameter` and `length` of the pipe, metres.
inline void check_motion(const MotionSpec &m, double diameter, double length)
{
    const auto rising = [](const auto &keys, const char *name) {
        for (size_t i = 1; i < keys.size(); i++)
            if (!(keys[i].time > keys[i - 1].time))
                Reader::fail("motion." + std::string(name) + "[" + std::to_string(i) + "].time",
                             "must be later than the one before");
    };
    rising(m.schedule, "schedule");
    rising(m.head, "head");
    double lift = 0;
    for (const Bump &b : m.bumps)
        lift = std::max({lift, std::abs(b.height), std::abs(b.step)});
    if (std::abs(m.below_axis) + 2 * m.wobble_m + lift * (1 + m.camera_ahead / m.wheelbase) > 0.4 * diameter)
        Reader::fail("motion.below_axis", "the camera would leave the pipe");
    const auto [least, most] = travel(m);
    if (m.start + least < -0.4 || m.start + most > length + 0.4)
        Reader::fail("motion", "the camera would drive out of the pipe's " + std::to_string(length) + " m");
}

} // namespace pipefish::sim
