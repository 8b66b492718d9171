#include "sim/motion.hpp"

#include "sim/random.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::sim
{

namespace
{

// Within -1..1: three waves of the distance with random phases.
double wobble(uint64_t seed, uint64_t axis, double distance)
{
    constexpr double WAVES[] = {1.7, 0.61, 0.23}, WEIGHTS[] = {0.55, 0.3, 0.15}; // metres
    double sum = 0.0;
    for (uint64_t k = 0; k < 3; k++) {
        const double phase = uniform_of(hash64(seed, STREAM_WOBBLE, axis, k));
        sum += WEIGHTS[k] * std::sin(2.0 * std::numbers::pi * (phase + distance / WAVES[k]));
    }
    return sum;
}

double distance_at(const MotionSpec &spec, double t)
{
    return t < spec.ramp ? 0.5 * spec.speed * t * t / spec.ramp : spec.speed * (t - 0.5 * spec.ramp);
}

Eigen::Vector3d nominal(const Tube &tube, double drop, double s)
{
    const Frame3 f = tube.ride(s);
    return f.origin + drop * f.world_from_frame.col(1);
}

} // namespace

void attitude(const Eigen::Matrix3d &world_from_cam, double &roll, double &pitch)
{
    const Eigen::Vector3d down = world_from_cam.row(1).transpose(); // gravity in the camera's frame
    roll = std::atan2(down.x(), down.y());
    pitch = std::asin(std::clamp(-down.z(), -1.0, 1.0));
}

std::vector<FrameState> drive(const Tube &tube, const MotionSpec &spec)
{
    constexpr int ARC_STEPS = 8; // chords a frame: 1e-8 relative in a 3 D bend at 10 mm a frame
    std::vector<FrameState> frames;
    double arc = 0.0, slip = 0.0, previous = spec.start;
    for (int i = 0; i < spec.frames; i++) {
        FrameState f{};
        const double t = i / spec.frame_rate, d = distance_at(spec, t);
        f.time_ns = std::llround(t * 1e9);
        f.s = spec.start + d;
        const double arc_before = arc;
        for (int k = 0; k < ARC_STEPS; k++) {
            const double a = previous + (f.s - previous) * k / ARC_STEPS;
            const double b = previous + (f.s - previous) * (k + 1) / ARC_STEPS;
            arc += (nominal(tube, spec.below_axis, b) - nominal(tube, spec.below_axis, a)).norm();
        }
        previous = f.s;
        f.arc = arc;

        const Eigen::Vector3d here = nominal(tube, spec.below_axis, f.s);
        const Eigen::Matrix3d section = tube.ride(f.s).world_from_frame;
        const Eigen::Vector3d z = (nominal(tube, spec.below_axis, f.s + spec.lookahead) - here).normalized();
        const Eigen::Vector3d y = z.cross(section.col(0)).normalized();
        Eigen::Matrix3d look;
        look << y.cross(z), y, z;
        const auto turn = [&](uint64_t axis, double most, const Eigen::Vector3d &about) {
            return Eigen::AngleAxisd(most * wobble(spec.seed, axis, d), about).toRotationMatrix();
        };
        f.world_from_cam = look * turn(0, spec.wobble_rad, Eigen::Vector3d::UnitY()) *
                           turn(1, spec.wobble_rad, Eigen::Vector3d::UnitX()) *
                           turn(2, 2.0 * spec.wobble_rad, Eigen::Vector3d::UnitZ());
        f.centre = here + spec.wobble_m * (wobble(spec.seed, 3, d) * section.col(0) +
                                           wobble(spec.seed, 4, d) / 3.0 * section.col(1));

        const uint64_t n = static_cast<uint64_t>(i);
        attitude(f.world_from_cam, f.roll, f.pitch);
        f.measured_roll = f.roll + spec.attitude_sigma * normal(spec.seed, STREAM_ROLL, n);
        f.measured_pitch = f.pitch + spec.attitude_sigma * normal(spec.seed, STREAM_PITCH, n);
        slip += spec.encoder_slip * std::sqrt(arc - arc_before) * normal(spec.seed, STREAM_SLIP, n);
        f.encoder_count =
            static_cast<int64_t>(std::floor((arc * (1.0 + spec.encoder_bias) + slip) / spec.metres_per_count));
        frames.push_back(f);
    }
    return frames;
}

} // namespace pipefish::sim
