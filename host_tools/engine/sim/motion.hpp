// How the crawler moves, and what its encoder and inclinometer say.
#pragma once

#include "sim/tube.hpp"

#include <Eigen/Geometry>
#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct MotionSpec {
    uint64_t seed = 1;
    int frames = 600;
    double frame_rate = 20;    // 1/s
    double start = 0.3;        // metres of arc length at frame 0
    double speed = 0.2;        // metres per second after a ramp of one second
    double below_axis = 0.012; // metres: cameras ride low
    double wobble_m = 0.003;   // amplitude of the lateral wobble
    double wobble_rad = 0.012; // of yaw and pitch; roll twice as much
    double metres_per_count = 0.0005;
    double encoder_bias = 0.004;    // the wheel's scale is off by this share
    double encoder_slip = 0.00224;  // random walk, metres per square root of a metre: 0.5 mm in 5 cm
    double attitude_sigma = 0.0035; // radians
};

// camera from world: X_cam = rotation (X_world - centre).
struct Pose {
    Eigen::Matrix3d rotation;
    Vec3 centre;
    double s; // arc length
    int piece;
};

struct Telemetry {
    int64_t time_ns, encoder_count;
    double roll, pitch;
};

class Motion
{
public:
    Motion(const MotionSpec &spec, const Tube &tube);
    const MotionSpec &spec() const { return spec_; }
    const Pose &pose(int frame) const { return poses_.at(static_cast<size_t>(frame)); }
    const Telemetry &telemetry(int frame) const { return telemetry_.at(static_cast<size_t>(frame)); }

private:
    MotionSpec spec_;
    std::vector<Pose> poses_;
    std::vector<Telemetry> telemetry_;
};

} // namespace pipefish::sim
