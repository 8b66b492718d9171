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

constexpr double WALK_STEP = 0.05; // metres

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

// From 0 to 1 while u does, at rest at both ends (quintic).
double ease(double u)
{
    u = std::clamp(u, 0.0, 1.0);
    return u * u * u * (10.0 + u * (6.0 * u - 15.0));
}

std::vector<SpeedKey> speed_keys(const MotionSpec &spec)
{
    if (!spec.schedule.empty()) {
        return spec.schedule;
    }
    if (spec.ramp > 0.0) {
        return {{0.0, 0.0}, {spec.ramp, spec.speed}};
    }
    return {{0.0, spec.speed}};
}

// The integral of the speed since the first key.
double distance_at(const std::vector<SpeedKey> &keys, double time)
{
    if (time < keys[0].time) {
        return keys[0].speed * (time - keys[0].time);
    }
    double sum = 0.0;
    for (size_t i = 0; i + 1 < keys.size(); i++) {
        const double span = keys[i + 1].time - keys[i].time, dt = std::min(time - keys[i].time, span);
        sum += dt * (keys[i].speed + 0.5 * dt / span * (keys[i + 1].speed - keys[i].speed));
        if (time <= keys[i + 1].time) {
            return sum;
        }
    }
    return sum + keys.back().speed * (time - keys.back().time);
}

// A pushed camera sticks, then jumps to where it should be: in jerks of stick_slip_m times 0.5 to 1.5.
double stick_slip(const MotionSpec &spec, double pushed)
{
    if (!(spec.stick_slip_m > 0.0)) {
        return pushed;
    }
    const auto boundary = [&](double cell) { // the cells' ends move by up to a quarter of their length
        const uint64_t n = static_cast<uint64_t>(static_cast<int64_t>(cell));
        return spec.stick_slip_m * (cell + 0.5 * (uniform_of(hash64(spec.seed, STREAM_STICK, n)) - 0.5));
    };
    double cell = std::floor(pushed / spec.stick_slip_m);
    if (pushed < boundary(cell)) {
        cell -= 1.0;
    } else if (pushed >= boundary(cell + 1.0)) {
        cell += 1.0;
    }
    const double from = boundary(cell), to = boundary(cell + 1.0);
    return from + (to - from) * ease(((pushed - from) / (to - from) - spec.stick_share) / (1.0 - spec.stick_share));
}

double floor_height(const MotionSpec &spec, double s)
{
    double sum = 0.0;
    for (const Bump &b : spec.bumps) {
        const double u = (s - b.s) / b.length; // within -0.5..0.5 on the bump
        if (std::abs(u) < 0.5) {
            sum += 0.5 * b.height * (1.0 + std::cos(2.0 * std::numbers::pi * u));
        }
        sum += b.step * ease(u + 0.5);
    }
    return sum;
}

// Of the pan-tilt head, camera as it looks straight on -> camera as it is turned.
Eigen::Matrix3d head_turn(const MotionSpec &spec, double time)
{
    const auto at = [&](double HeadKey::*angle) {
        const auto next =
            std::find_if(spec.head.begin(), spec.head.end(), [time](const HeadKey &k) { return k.time > time; });
        if (next == spec.head.begin()) {
            return (*next).*angle;
        }
        const HeadKey &before = *(next - 1);
        if (next == spec.head.end()) {
            return before.*angle;
        }
        const double u = (time - before.time) / (next->time - before.time);
        return before.*angle + ease(u) * ((*next).*angle - before.*angle);
    };
    return Eigen::AngleAxisd(at(&HeadKey::pan), Eigen::Vector3d::UnitY()).toRotationMatrix() *
           Eigen::AngleAxisd(at(&HeadKey::tilt), Eigen::Vector3d::UnitX()).toRotationMatrix();
}

} // namespace

void attitude(const Eigen::Matrix3d &world_from_cam, double &roll, double &pitch)
{
    const Eigen::Vector3d down = world_from_cam.row(1).transpose(); // gravity in the camera's frame
    roll = std::atan2(down.x(), down.y());
    pitch = std::asin(std::clamp(-down.z(), -1.0, 1.0));
}

std::pair<double, double> travel(const MotionSpec &spec)
{
    std::pair<double, double> range{0.0, 0.0};
    const std::vector<SpeedKey> keys = speed_keys(spec);
    const double pushed_0 = distance_at(keys, 0.0), at_0 = stick_slip(spec, 0.0);
    for (int i = 0; i < spec.frames; i++) {
        const double d = stick_slip(spec, distance_at(keys, i / spec.frame_rate) - pushed_0) - at_0;
        range = {std::min(range.first, d), std::max(range.second, d)};
    }
    return range;
}

Trajectory::Trajectory(const Tube &tube, const MotionSpec &spec) : tube_(tube), spec_(spec), keys_(speed_keys(spec))
{
    const auto [least, most] = travel(spec);
    const int64_t first = static_cast<int64_t>(std::floor(least / WALK_STEP)) - 2;
    const int64_t last = static_cast<int64_t>(std::ceil(most / WALK_STEP)) + 2;
    walk_from_ = static_cast<double>(first) * WALK_STEP;
    double sum = 0.0, at_start = 0.0;
    for (int64_t i = first; i <= last && spec.roll_walk > 0.0; i++) {
        at_start = i == 0 ? sum : at_start;
        walk_.push_back(sum);
        sum += spec.roll_walk * std::sqrt(WALK_STEP) * normal(spec.seed, STREAM_WALK, static_cast<uint64_t>(i));
    }
    for (double &roll : walk_) {
        roll -= at_start;
    }
}

double Trajectory::pushed(double time) const
{
    return distance_at(keys_, time) - distance_at(keys_, 0.0);
}

double Trajectory::driven(double time) const
{
    return stick_slip(spec_, pushed(time)) - stick_slip(spec_, 0.0);
}

double Trajectory::walked_roll(double distance) const
{
    if (walk_.empty()) {
        return 0.0;
    }
    const double u = std::clamp((distance - walk_from_) / WALK_STEP, 0.0, static_cast<double>(walk_.size()) - 1.001);
    const size_t i = static_cast<size_t>(u);
    return walk_[i] + (walk_[i + 1] - walk_[i]) * ease(u - static_cast<double>(i));
}

Eigen::Vector3d Trajectory::nominal(double s) const
{
    const Frame3 f = tube_.ride(s);
    return f.origin + spec_.below_axis * f.world_from_frame.col(1);
}

CameraState Trajectory::at(double time) const
{
    const double d = driven(time);
    CameraState c{};
    c.s = spec_.start + d;
    const Eigen::Vector3d here = nominal(c.s);
    const Eigen::Matrix3d section = tube_.ride(c.s).world_from_frame;
    const Eigen::Vector3d z = (nominal(c.s + spec_.lookahead) - here).normalized();
    const Eigen::Vector3d y = z.cross(section.col(0)).normalized();
    Eigen::Matrix3d look;
    look << y.cross(z), y, z;
    const auto turn = [](double angle, const Eigen::Vector3d &about) {
        return Eigen::AngleAxisd(angle, about).toRotationMatrix();
    };
    const auto sway = [&](uint64_t axis) { return wobble(spec_.seed, axis, d); };
    const double front = floor_height(spec_, c.s - spec_.camera_ahead);
    const double rear = floor_height(spec_, c.s - spec_.camera_ahead - spec_.wheelbase);
    const double rise = (front - rear) / spec_.wheelbase;
    const double climb = spec_.climb_rad * sway(5);
    c.world_from_cam = look * turn(spec_.wobble_rad * sway(0), Eigen::Vector3d::UnitY()) *
                       turn(spec_.wobble_rad * sway(1) + std::atan(rise), Eigen::Vector3d::UnitX()) *
                       turn(2.0 * spec_.wobble_rad * sway(2) + climb + walked_roll(d), Eigen::Vector3d::UnitZ());
    c.centre = here + spec_.wobble_m * (sway(3) * section.col(0) + sway(4) / 3.0 * section.col(1)) -
               (front + rise * spec_.camera_ahead) * section.col(1) +
               spec_.below_axis * (-std::sin(climb) * section.col(0) + (std::cos(climb) - 1.0) * section.col(1));
    if (!spec_.head.empty()) {
        const Eigen::Vector3d pivot = c.centre - spec_.head_arm * c.world_from_cam.col(2);
        c.world_from_cam = c.world_from_cam * head_turn(spec_, time);
        c.centre = pivot + spec_.head_arm * c.world_from_cam.col(2);
    }
    return c;
}

std::vector<FrameState> Trajectory::frames() const
{
    constexpr int ARC_STEPS = 8; // chords a frame: 1e-8 relative in a 3 D bend at 10 mm a frame
    std::vector<FrameState> frames;
    double arc = 0.0, previous = spec_.start;
    for (int i = 0; i < spec_.frames; i++) {
        const double time = i / spec_.frame_rate;
        FrameState f{};
        static_cast<CameraState &>(f) = at(time);
        f.time = time;
        for (int k = 0; k < ARC_STEPS; k++) {
            const double a = previous + (f.s - previous) * k / ARC_STEPS;
            const double b = previous + (f.s - previous) * (k + 1) / ARC_STEPS;
            arc += std::copysign((nominal(b) - nominal(a)).norm(), f.s - previous);
        }
        previous = f.s;
        f.arc = arc;
        f.pushed = pushed(time);
        attitude(f.world_from_cam, f.roll, f.pitch);
        frames.push_back(f);
    }
    return frames;
}

} // namespace pipefish::sim
