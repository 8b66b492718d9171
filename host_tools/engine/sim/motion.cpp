#include "sim/motion.hpp"

#include "sim/random.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::sim
{

namespace
{

// Unit variance: three waves of 0.35 to 2.5 m with random phases.
double wobble(uint64_t seed, uint64_t axis, double distance)
{
    constexpr double SHORTEST[] = {1.2, 0.6, 0.35}, LONGEST[] = {2.5, 1.2, 0.6}, WEIGHT[] = {0.80, 0.50, 0.33};
    double sum = 0.0;
    for (uint64_t k = 0; k < 3; k++) {
        const double phase = uniform_of(hash64(seed, STREAM_WOBBLE, axis, 2 * k));
        const double draw = uniform_of(hash64(seed, STREAM_WOBBLE, axis, 2 * k + 1));
        const double wavelength = SHORTEST[k] + (LONGEST[k] - SHORTEST[k]) * draw;
        sum += WEIGHT[k] * std::sqrt(2.0) * std::sin(2.0 * std::numbers::pi * (phase + distance / wavelength));
    }
    return sum;
}

// Distance driven `t` seconds after the start.
double distance_at(const MotionConfig &m, double length, double peak, double t)
{
    const double ramp = m.ramp * peak / m.speed; // a drive too short for the full speed turns round half-way
    const double total = length / peak + ramp, rate = ramp > 0.0 ? peak / ramp : 0.0;
    if (t < ramp) {
        return 0.5 * rate * t * t;
    }
    if (t > total - ramp) {
        const double left = std::max(0.0, total - t);
        return length - 0.5 * rate * left * left;
    }
    return peak * (t - 0.5 * ramp);
}

Eigen::Vector3d nominal(const Tube &tube, double drop, double s)
{
    const Frame3 f = tube.frame(s);
    return f.origin + drop * f.world_from_frame.col(1);
}

} // namespace

void attitude(const Eigen::Matrix3d &world_from_cam, double &roll, double &pitch)
{
    const Eigen::Vector3d down = world_from_cam.row(1).transpose(); // gravity in the camera's frame
    roll = std::atan2(down.x(), down.y());
    pitch = std::asin(std::clamp(-down.z(), -1.0, 1.0));
}

std::vector<FrameState> drive(const Tube &tube, const MotionConfig &motion, const SensorConfig &sensors, uint64_t seed)
{
    constexpr int ARC_STEPS = 8;       // chords a frame: 1e-8 relative in a 3 D bend at 10 mm a frame
    constexpr double SLIP_OVER = 0.05; // metres that `slip` refers to
    const double length = motion.end - motion.start;
    const double peak =
        motion.ramp > 0.0 ? std::min(motion.speed, std::sqrt(length * motion.speed / motion.ramp)) : motion.speed;
    const double total = length / peak + motion.ramp * peak / motion.speed;
    if (!(length > 0.0) || !(total * motion.fps < 1e7)) {
        throw std::invalid_argument("a drive must go forward and have fewer than ten million frames");
    }
    std::vector<FrameState> frames;
    double arc = 0.0, slip = 0.0, previous = motion.start;
    const int count = static_cast<int>(std::floor(total * motion.fps + 1e-9)) + 1;
    for (int i = 0; i < count; i++) {
        FrameState f{};
        const double t = i / motion.fps, d = distance_at(motion, length, peak, t);
        f.time_ns = std::llround(t * 1e9);
        f.s = motion.start + d;
        const double arc_before = arc;
        for (int k = 0; k < ARC_STEPS && i > 0; k++) {
            const double a = previous + (f.s - previous) * k / ARC_STEPS,
                         b = previous + (f.s - previous) * (k + 1) / ARC_STEPS;
            arc += (nominal(tube, motion.drop, b) - nominal(tube, motion.drop, a)).norm();
        }
        previous = f.s;
        f.arc = arc;

        const Eigen::Vector3d here = nominal(tube, motion.drop, f.s);
        const Eigen::Matrix3d section = tube.frame(f.s).world_from_frame;
        const Eigen::Vector3d z = (nominal(tube, motion.drop, f.s + motion.lookahead) - here).normalized();
        const Eigen::Vector3d y = z.cross(section.col(0)).normalized();
        Eigen::Matrix3d look;
        look << y.cross(z), y, z;
        const auto turn = [&](uint64_t axis, double sigma, const Eigen::Vector3d &about) {
            return Eigen::AngleAxisd(sigma * wobble(seed, axis, d), about).toRotationMatrix();
        };
        f.world_from_cam = look * turn(0, motion.yaw, Eigen::Vector3d::UnitY()) *
                           turn(1, motion.pitch, Eigen::Vector3d::UnitX()) *
                           turn(2, motion.roll, Eigen::Vector3d::UnitZ());
        f.centre = here + motion.lateral * (wobble(seed, 3, d) * section.col(0) + wobble(seed, 4, d) * section.col(1));

        attitude(f.world_from_cam, f.roll, f.pitch);
        const uint64_t n = static_cast<uint64_t>(i);
        slip += sensors.slip * std::sqrt((arc - arc_before) / SLIP_OVER) * normal(seed, STREAM_SLIP, n);
        f.encoder_count =
            static_cast<int64_t>(std::floor((arc * (1.0 + sensors.scale_bias) + slip) / sensors.metres_per_count));
        f.measured_roll = f.roll + sensors.attitude_sigma * normal(seed, STREAM_ROLL, n);
        f.measured_pitch = f.pitch + sensors.attitude_sigma * normal(seed, STREAM_PITCH, n);
        frames.push_back(f);
    }
    return frames;
}

} // namespace pipefish::sim
