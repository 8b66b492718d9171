// The crawler: where the camera is in every frame, and what the wheel encoder and the inclinometer say about it.
//
// The crawler drives along the centreline at constant speed with a ramp at both ends. The camera sits `drop` below the
// centreline and looks at where it will be `lookahead` further on, so in a bend it lags the tangent as a rigid vehicle
// does. Wobble is a smooth function of the distance driven: it stops when the crawler stops.
#pragma once

#include "sim/tube.hpp"

#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct MotionConfig {
    double start, end;  // metres along the centreline, start < end
    double speed, ramp; // m/s; seconds from standstill to speed, and back
    double fps;
    double drop, lookahead;  // metres
    double lateral;          // metres, standard deviation of the sideways and of the vertical wobble
    double roll, pitch, yaw; // radians, standard deviations of the angular wobble
};

struct SensorConfig {
    double metres_per_count; // > 0
    double scale_bias;       // the encoder counts (1 + bias) times the distance
    double slip;             // metres, standard deviation of the encoder's random walk over 5 cm
    double attitude_sigma;   // radians, of the inclinometer's roll and pitch
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

// All frames of the drive. Throws std::invalid_argument for a drive that has no frame.
std::vector<FrameState> drive(const Tube &tube, const MotionConfig &motion, const SensorConfig &sensors, uint64_t seed);

} // namespace pipefish::sim
