// The crawler: where the camera is in every frame, and what the wheel encoder and the inclinometer say about it.
//
// The crawler drives along the centreline at constant speed after a ramp. The camera sits below the centreline and
// looks at where it will be `lookahead` further on, so in a bend it turns ahead of the tangent as a vehicle with a
// front axle does. Wobble is a smooth function of the distance driven.
#pragma once

#include "sim/tube.hpp"

#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct MotionSpec {
    uint64_t seed = 1; // of wobble, slip and the sensors' noise
    int frames = 600;
    double frame_rate = 20.0;         // a second
    double start = 0.3;               // metres along the centreline, at frame 0
    double speed = 0.2, ramp = 1.0;   // m/s; seconds from standstill to speed
    double below_axis = 0.012;        // metres, camera under the centreline
    double lookahead = 0.15;          // metres
    double wobble_m = 0.003;          // largest sideways sway; a third of it up and down
    double wobble_rad = 0.012;        // largest yaw and pitch; roll twice as much
    double metres_per_count = 0.0005; // of the encoder
    double encoder_bias = 0.004;      // it counts (1 + bias) times the distance
    double encoder_slip = 0.00224;    // its random walk, metres per square root of a metre (0.5 mm in 50 mm)
    double attitude_sigma = 0.0035;   // radians, of the inclinometer's roll and pitch
};

struct FrameState {
    int64_t time_ns;                // since the recording's start
    double s, arc;                  // metres: of the camera's section along the centreline; driven by the crawler
    Eigen::Matrix3d world_from_cam; // columns: the camera's x (right), y (down), z (optical axis)
    Eigen::Vector3d centre;         // paraxial entrance pupil, world
    double roll, pitch;             // true, radians; see attitude()
    int64_t encoder_count;
    double measured_roll, measured_pitch;
};

// Roll (clockwise seen along the view, in (-pi, pi]) and pitch (axis above the horizontal) from gravity = world +y.
void attitude(const Eigen::Matrix3d &world_from_cam, double &roll, double &pitch);

// All frames of the drive.
std::vector<FrameState> drive(const Tube &tube, const MotionSpec &spec);

} // namespace pipefish::sim
