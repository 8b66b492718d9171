#include "sim/motion.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

// A smooth wobble of unit amplitude: three sines of the distance travelled with seeded phases.
double wobble(uint64_t seed, uint64_t channel, double s)
{
    double sum = 0;
    const double waves[] = {1.7, 0.61, 0.23}, weights[] = {0.55, 0.3, 0.15}; // metres
    for (uint64_t k = 0; k < 3; k++)
        sum += weights[k] * std::sin(2 * M_PI * (s / waves[k] + uniform(seed, 16 * channel + k)));
    return sum;
}

// Distance at time t with a ramp of one second to full speed.
double travelled(double speed, double t)
{
    return t < 1 ? 0.5 * speed * t * t : speed * (t - 0.5);
}

} // namespace

Motion::Motion(const MotionSpec &spec, const Tube &tube) : spec_(spec)
{
    double slip = 0, last = spec.start;
    for (int i = 0; i < spec.frames; i++) {
        const double t = i / spec.frame_rate, s = spec.start + travelled(spec.speed, t);
        const Frame f = tube.frame(s);
        const double yaw = spec.wobble_rad * wobble(spec.seed, 1, s), pitch = spec.wobble_rad * wobble(spec.seed, 2, s);
        const double roll = 2 * spec.wobble_rad * wobble(spec.seed, 3, s);
        Pose pose;
        pose.s = s;
        pose.centre = f.centre + spec.wobble_m * wobble(spec.seed, 4, s) * f.right +
                      (0.3 * spec.wobble_m * wobble(spec.seed, 5, s) - spec.below_axis) * f.up;
        Eigen::Matrix3d along; // rows: right, down, forward
        along << f.right.transpose(), -f.up.transpose(), f.tangent.transpose();
        const Eigen::Matrix3d tilt = (Eigen::AngleAxisd(roll, Vec3::UnitZ()) * Eigen::AngleAxisd(pitch, Vec3::UnitX()) *
                                      Eigen::AngleAxisd(yaw, Vec3::UnitY()))
                                         .toRotationMatrix();
        pose.rotation = tilt * along;
        pose.piece = tube.locate(pose.centre, i > 0 ? poses_.back().piece : 0).piece;

        const auto index = static_cast<uint64_t>(i);
        slip += spec.encoder_slip * std::sqrt(s - last) * normal(hash64(spec.seed, 101), index);
        last = s;
        Telemetry reading;
        reading.time_ns = std::llround(t * 1e9);
        reading.encoder_count = static_cast<int64_t>(
            std::floor(((s - spec.start) * (1 + spec.encoder_bias) + slip) / spec.metres_per_count));
        const Vec3 down = pose.rotation * Vec3::UnitY(); // gravity in the camera
        reading.roll = std::atan2(down.x(), down.y()) + spec.attitude_sigma * normal(hash64(spec.seed, 102), index);
        reading.pitch =
            std::asin(std::clamp(-down.z(), -1.0, 1.0)) + spec.attitude_sigma * normal(hash64(spec.seed, 103), index);
        poses_.push_back(pose);
        telemetry_.push_back(reading);
    }
}

} // namespace pipefish::sim
