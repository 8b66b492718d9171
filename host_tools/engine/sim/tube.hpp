// The pipe's free space: straight runs and circular bends along a centreline; a section that varies smoothly along it,
// an ellipse plus reliefs (wall.hpp); joints with a gap, a step and an angle; cracks, holes and branches that open from
// it; roots in it and water on its floor. Rays meet straight runs of constant section without iteration.
//
// World: origin at the centre of the pipe's start, x right, y down (gravity), z along the first run. The section's
// frame (right, down, tangent) is carried along without twist. Clock angle: 0 at the top, clockwise seen along the
// travel, so the direction of clock c is (sin c, -cos c) in (right, down). The first and the last run are straight and
// go on without end.
#pragma once

#include "sim/roots.hpp"
#include "sim/wall.hpp"

#include <Eigen/Core>

#include <memory>
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

enum class Material : uint8_t { WALL, JOINT, DEPOSIT, HOLE, CRACK, LATERAL, ROOT, WATER };

struct Hit {
    double t; // metres along the ray
    // Metres along the centreline, clock angle. In a lateral or a hole: metres along its axis from the main axis, and
    // the angle around it. On a root: of the place where it grows.
    double s, clock;
    Eigen::Vector3d normal; // unit, towards the viewer's side, in the frame of the View
    Material material;
    int part;    // index in the list of its kind; of the wall: how many joints lie before it
    int segment; // for View alone
};

// What a ray sees: the first hit, and where that is water, what the surface mirrors.
struct Sight {
    Hit first, second;
    bool mirrors; // `second` is valid: a ray from `origin` along `direction`
    Eigen::Vector3d origin, direction;
    double mirrored; // share of the light that the surface mirrors (Fresnel, unpolarised)
};

struct WaterPlane { // normal.p = level, the normal up; right.p + right_0 and along.p + along_0 are places on it
    Eigen::Vector3d normal, right, along;
    double level, right_0, along_0;
};

class Tube
{
public:
    // Throws SpecError: a bend tighter than the wall, sections that overlap to more than 50 %, joints outside straight
    // runs, reliefs that close the pipe.
    Tube(double radius, const std::vector<Piece> &pieces, const std::vector<OvalStretch> &ovals,
         const FeatureSpec &features);

    double radius() const { return radius_; }
    double length() const { return length_; }
    const std::vector<JointSpec> &joints() const { return joints_; }
    const std::vector<CrackPath> &cracks() const { return cracks_; }
    Section section(double s) const; // without reliefs and grooves
    Frame3 frame(double s) const;    // of the section at s
    // The same, but smooth: half a diameter before and behind a joint it blends from one pipe to the next, as what
    // rolls over it does.
    Frame3 ride(double s) const;
    double wall_radius(double s, double clock) const;   // from the axis: section, reliefs, grooves and cracks
    Eigen::Vector3d wall(double s, double clock) const; // world point at that radius
    // The nearest section through a world point within 1.5 radii of the centreline (or 1.2 of the largest). False when
    // there is none.
    bool locate(const Eigen::Vector3d &world, WallPoint &out) const;
    // Index of the water that a world point in the pipe lies under, or -1.
    int water_over(const Eigen::Vector3d &world) const;

private:
    struct Segment;
    struct SegmentRay;
    struct RayState;
    struct Branch { // of laterals and holes: a closed cylinder, in the frame of its owner
        Eigen::Vector3d origin, axis, across;
        double radius, length;
        Material material;
        int part;
    };

public:
    // The tube seen from a camera: its parts in the camera's frame, made once a frame. Borrows the tube.
    class View
    {
    public:
        // `seconds`: the time of the water's ripples.
        View(const Tube &tube, const Eigen::Matrix3d &world_from_cam, const Eigen::Vector3d &centre,
             double seconds = 0.0);
        // First hit of the ray origin + t direction, t >= 0 (camera frame, unit direction). False: the origin is not
        // inside the pipe, or nothing within 1000 radii. The point is within 1e-9 radii of the surface.
        bool cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Hit &hit) const;
        // The same, with what water mirrors.
        bool see(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, Sight &sight) const;
        // Of a ray along `direction` that met water: sight.first and sight.origin say where; sets the rest.
        void mirror(const Eigen::Vector3d &direction, Sight &sight) const;
        // Does anything, or any root, stand between the points (camera frame)? The first 1 - 1e-6 of the way counts.
        bool blocked(const Eigen::Vector3d &from, const Eigen::Vector3d &to, bool roots_only) const;
        // Unit vector along a lateral or a hole, outwards.
        const Eigen::Vector3d &branch_axis(Material material, int part) const;
        // So near to roots (two radii of their bundle) that they may shade it?
        bool near_roots(const Eigen::Vector3d &point) const;
        // May a pixel of `pixel` radians around this hit show something thinner than itself: a crack, a gap, a root?
        bool thin_near(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, const Hit &hit,
                       double pixel) const;

    private:
        struct Local {
            Eigen::Matrix3d rotation; // segment from camera
            Eigen::Vector3d offset;
        };
        struct Walk; // a ray on its way

        enum class After : uint8_t { SOLID, MAIN, LOST };

        bool trace(const Eigen::Vector3d &o, const Eigen::Vector3d &d, int start, bool with_water, Hit &hit) const;
        SegmentRay ray_in(const Walk &walk) const;
        void set_wall_hit(Walk &walk, const SegmentRay &ray, const RayState &st) const;
        bool under(const Walk &walk, int water) const;
        void settle(Walk &walk) const;
        bool march(Walk &walk) const;
        bool in_opening(Walk &walk) const;
        After leave_branch(Walk &walk) const;
        After leave_crack(Walk &walk) const;
        After after(Walk &walk) const;
        double water_ahead(const Walk &walk, const Segment &segment) const;
        bool roots_before(const Eigen::Vector3d &o, const Eigen::Vector3d &d, bool any, Hit &hit) const;

        const Tube &tube_;
        std::vector<Local> local_;
        std::vector<Branch> branches_;
        std::vector<Bundle> bundles_;
        std::vector<WaterPlane> water_;
        double seconds_;
        int start_;
    };

private:
    struct Segment {
        double s0, length;
        double bend_radius, bend_angle; // 0 = straight
        double nx, ny;                  // unit vector to the bend's centre, in (right, down)
        bool varying;                   // the section changes inside
        Section constant;               // the section, if it does not
        double groove;                  // added to the section's radius
        double slope, curvature;        // bounds of |de/ds| and |d2e/ds2|
        double inverse_axis;            // 1 / smallest semi-axis
        double curvature_radius;        // bend_radius less the largest radius: the tightest line in the bend
        Frame3 frame;                   // at s0
        Eigen::Vector3d start_normal;   // inside: start_normal.p >= 0
        Eigen::Vector3d end_normal;     // and end_normal.p <= end_offset
        double end_offset;
        bool face;       // the wall is not continuous where it meets the segment before
        int joint, pipe; // the joint whose groove it is, or -1; joints before it
        // The reliefs here; with any, the wall is marched from `inner` on, the radius inside which there is none.
        std::vector<const Relief *> reliefs;
        double inner;
        HeightBounds bounds;       // of the radius
        HeightBounds calm;         // the same without the deposits
        HeightBounds cover;        // the same of the reliefs' covers
        double cover_depth;        // metres, of the deepest; 0: no relief has one
        std::vector<int> cracks;   // whose range touches it
        std::vector<int> branches; // the same; laterals first, then holes
        int water;                 // the stretch, or -1
    };

    struct Growth { // where the next segment begins
        double s;
        Frame3 frame;
        Eigen::Vector3d start_normal;
        bool face;
        int pipe;
    };

    void add_segments(const Piece &piece, Growth &growth);
    void add_segment(const Piece &piece, double from, double to, Growth &growth);
    void set_bounds(Segment &segment) const;
    void set_radius_bounds(Segment &segment, double largest, double from, double to) const;
    void add_openings(const FeatureSpec &features);
    int segment_at(double s) const;
    int find(const Eigen::Vector3d &world, WallPoint &out) const; // the segment, or -1
    // The wall's radius and its derivatives at (s, clock); (ux, uy) is the clock's direction.
    // `cover`: of the reliefs' covers.
    double radius_at(const Segment &segment, double s, double clock, double ux, double uy, Height &sum,
                     bool cover = false) const;
    static Frame3 advance(const Frame3 &frame, const Segment &segment, double along);
    static WallPoint to_section(const Segment &segment, const Eigen::Vector3d &p);

    double radius_, length_, largest_radius_;
    std::vector<OvalStretch> ovals_;
    std::vector<Eigen::Vector2d> largest_; // of each stretch: (e_c, e_s) between its ramps
    std::vector<std::unique_ptr<Relief>> reliefs_;
    std::vector<JointSpec> joints_;
    std::vector<Frame3> before_, after_; // of every joint: where its first pipe ends, where the next begins
    std::vector<CrackPath> cracks_;
    std::vector<Water> water_;
    std::vector<WaterPlane> planes_;
    std::vector<Branch> branches_; // in the world
    std::vector<Bundle> bundles_;
    std::vector<Root> roots_;
    std::vector<Segment> segments_;
};

} // namespace pipefish::sim
