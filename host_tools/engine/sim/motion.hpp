// How the camera moves: a place and an attitude for every moment.
//
// The vehicle drives along the centreline. The camera sits below the centreline and looks at where it will be
// `lookahead` further on, so in a bend it turns ahead of the tangent as a vehicle with a front axle does. On top come
// wobble (a smooth function of the distance driven), pitch and lift where wheels cross bumps of the floor, a random
// walk of the roll, sliding up the sides, and the turns of a pan-tilt head.
#pragma once

#include "sim/tube.hpp"

#include <cstdint>
#include <utility>
#include <vector>

namespace pipefish::sim
{

struct SpeedKey {
    double time = 0.0, speed = 0.0; // seconds since frame 0; m/s, negative backwards
};

struct HeadKey {
    double time = 0.0, pan = 0.0, tilt = 0.0; // seconds; radians to the right, upwards
};

// The floor from s - length / 2 to s + length / 2: a raised cosine of `height` (negative: a gap), and from there on
// `step` higher.
struct Bump {
    double s = 0.0, length = 0.02, height = 0.0, step = 0.0; // metres
};

struct MotionSpec {
    uint64_t seed = 1; // of wobble, stick-slip, roll and climb
    int frames = 600;
    double frame_rate = 20.0;       // a second
    double start = 0.3;             // metres along the centreline, at frame 0
    double speed = 0.2, ramp = 1.0; // m/s; seconds from standstill to speed
    std::vector<SpeedKey> schedule; // if not empty: the speed instead, linear between the keys, constant outside
    double below_axis = 0.012;      // metres, camera under the centreline
    double lookahead = 0.15;        // metres
    double wobble_m = 0.003;        // largest sideways sway; a third of it up and down
    double wobble_rad = 0.012;      // largest yaw and pitch; roll twice as much
    double wheelbase = 0.2;         // metres between the axles
    double camera_ahead = 0.08;     // metres from the front axle
    std::vector<Bump> bumps;        // of the floor under the wheels
    double stick_slip_m = 0.0;      // metres, mean length of a pushed camera's jerks; 0 = it runs smoothly
    double stick_share = 0.6;       // share of a jerk's push in which the camera sticks
    double roll_walk = 0.0;         // radians per square root of a metre
    double climb_rad = 0.0;         // how far the camera slides up the sides, clock angle around the axis
    std::vector<HeadKey> head;      // of the pan-tilt head; smooth between the keys, constant outside
    double head_arm = 0.03;         // metres from the head's pivot to the camera centre
};

struct CameraState {
    double s;                       // metres along the centreline, of the camera's section
    Eigen::Matrix3d world_from_cam; // columns: the camera's x (right), y (down), z (optical axis)
    Eigen::Vector3d centre;         // paraxial entrance pupil, world
};

struct FrameState : CameraState { // in the middle of the frame's exposure, and of its rows
    double time;                  // seconds since frame 0
    double arc,
        pushed; // metres since frame 0, backwards negative: driven by the camera without its wobble; pushed cable
    double roll, pitch; // true, radians; see attitude()
};

// Roll (clockwise seen along the view, in (-pi, pi]) and pitch (axis above the horizontal) from gravity = world +y.
void attitude(const Eigen::Matrix3d &world_from_cam, double &roll, double &pitch);

// The least and the largest distance of any frame from the start, along the drive, metres.
std::pair<double, double> travel(const MotionSpec &spec);

class Trajectory
{
public:
    // Borrows the tube.
    Trajectory(const Tube &tube, const MotionSpec &spec);

    CameraState at(double time) const;
    std::vector<FrameState> frames() const;

private:
    double pushed(double time) const;
    double driven(double time) const;
    double walked_roll(double distance) const;
    Eigen::Vector3d nominal(double s) const;

    const Tube &tube_;
    MotionSpec spec_;
    std::vector<SpeedKey> keys_;
    double walk_from_;
    std::vector<double> walk_; // the roll's random walk, every WALK_STEP metres
};

} // namespace pipefish::sim
