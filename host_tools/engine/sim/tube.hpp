// The pipe's inner wall: straight runs and circular bends along a centreline, with an elliptical section that varies
// smoothly along it; ray casting against it without iteration on straight runs of constant section.
//
// World: origin at the centre of the pipe's start, x right, y down (gravity), z along the first run. The section's
// frame (right, down, tangent) is carried along without twist. Clock angle: 0 at the top, clockwise seen along the
// travel, so the direction of clock c is (sin c, -cos c) in (right, down). The first and the last run are straight and
// go on without end.
#pragma once

#include <Eigen/Core>

#include <vector>

namespace pipefish::sim
{

struct Piece {           // a straight run (length) or a bend (the rest)
    double length = 0.0; // metres
    double angle = 0.0;  // radians; 0 = straight
    double radius = 0.0; // metres, of the centreline
    double clock = 0.0;  // radians: towards where the bend turns
};

// D_max - D_min = ovality * D_mean between start + ramp and end - ramp, blending to round at both ends (quintic).
struct OvalStretch {
    double start = 0.0, end = 1.0; // metres along the centreline
    double ramp = 0.25;            // metres, > 0, at most half the stretch
    double ovality = 0.0;
    double clock = 0.0; // of the largest diameter, radians
};

// The section {A u : |u| = 1} with A = [rho - e_c, -e_s; -e_s, rho + e_c] in (right, down): semi-axes rho +- |e|, the
// larger one at the clock angle atan2(e_s, e_c) / 2. d_c, d_s: derivatives by the arc length.
struct Section {
    double rho, e_c, e_s, d_c, d_s;
};

struct Frame3 {
    Eigen::Matrix3d world_from_frame; // columns: right, down, tangent
    Eigen::Vector3d origin;
};

struct WallPoint {
    double s, clock; // metres along the centreline; radians in [0, 2 pi)
    double distance; // from the centreline, metres
};

struct Hit {
    double t; // metres along the ray
    double s, clock;
    Eigen::Vector3d normal; // unit, into the pipe, in the frame of the View
};

class Tube
{
public:
    // Throws std::invalid_argument: no runs, a bend first or last, a bend tighter than the wall, sections that overlap
    // to more than 50 %.
    Tube(double radius, const std::vector<Piece> &pieces, const std::vector<OvalStretch> &ovals);

    double radius() const { return radius_; }
    double length() const { return length_; }
    Section section(double s) const;
    Frame3 frame(double s) const;                       // of the section at s
    Eigen::Vector3d wall(double s, double clock) const; // world point on the wall
    // The nearest section through a world point within 1.5 radii of the centreline. False when there is none.
    bool locate(const Eigen::Vector3d &world, WallPoint &out) const;

    // The tube seen from a camera: its pieces in the camera's frame, made once a frame. Borrows the tube.
    class View
    {
    public:
        View(const Tube &tube, const Eigen::Matrix3d &world_from_cam, const Eigen::Vector3d &centre);
        // First hit of the ray origin + t direction, t >= 0 (camera frame, unit direction). False: the origin is not
        // inside the pipe, or nothing within 1000 radii. The point is within 1e-9 radii of the wall.
        bool cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Hit &hit) const;

    private:
        struct Local {
            Eigen::Matrix3d rotation; // segment from camera
            Eigen::Vector3d offset;
        };
        const Tube &tube_;
        std::vector<Local> local_;
        int start_;
    };

private:
    struct Segment {
        double s0, length;
        double bend_radius, bend_angle; // 0 = straight
        double nx, ny;                  // unit vector to the bend's centre, in (right, down)
        bool varying;                   // the section changes inside
        Section constant;               // the section, if it does not
        double slope, curvature;        // bounds of |de/ds| and |d2e/ds2|
        double inverse_axis;            // 1 / smallest semi-axis
        double cos_end, sin_end;        // of bend_angle
        double curvature_radius;        // bend_radius less the largest semi-axis: the tightest line in the bend
        Frame3 frame;                   // at s0
    };
    struct SegmentRay;

    void add_segments(const Piece &piece, double &s, Frame3 &frame);
    void set_section_bounds(Segment &segment) const;
    int segment_at(double s) const;
    static Frame3 advance(const Frame3 &frame, const Segment &segment, double along);
    static WallPoint to_section(const Segment &segment, const Eigen::Vector3d &p);

    double radius_, length_;
    std::vector<OvalStretch> ovals_;
    std::vector<Eigen::Vector2d> largest_; // of each stretch: (e_c, e_s) between its ramps
    std::vector<Segment> segments_;
};

} // namespace pipefish::sim
