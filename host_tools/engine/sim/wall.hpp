// What makes a pipe's wall more than a tube: reliefs (heights added to the section's radius, positive away from the
// axis), cracks cut into it, and the descriptions of everything else that the geometry knows: joints, branches, holes,
// roots, water.
//
// A relief is twice differentiable by pieces and states bounds of its derivatives, from which the rays' steps follow.
#pragma once

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace pipefish::sim
{

// A description that contradicts itself; the message is "key: what".
struct SpecError : std::invalid_argument {
    using std::invalid_argument::invalid_argument;
};

// Metres and radians throughout; clock angles as in tube.hpp.

// The pipe ends at s and goes on behind a gap, displaced and turned.
struct JointSpec {
    double s = 0.0;                           // where the first pipe ends
    double gap = 0.005, depth = 0.01;         // the open groove, measured on the axis and from the first pipe's wall
    double step_right = 0.0, step_down = 0.0; // of the following pipe's axis, in the first pipe's section
    double yaw = 0.0, pitch = 0.0;            // of the following pipe: to the right, downwards
};

// Joints at equal distances with random steps and angles.
struct JointSeries {
    uint64_t seed = 1;
    double start = 0.0, spacing = 0.0, gap = 0.005, depth = 0.01; // spacing 0: none
    double step_sigma = 0.0, angle_sigma = 0.0;                   // of each component; cut at two sigma
};

// Blends to the egg of 2 to 3: crown of the pipe's radius R, sides of 3 R, invert of R / 2, the narrow end at `clock`.
struct EggStretch {
    double start = -1000.0, end = 1000.0, ramp = 0.25;
    double share = 1.0; // of the way from the circle to the egg
    double clock = 3.141592653589793;
};

struct Corrugation { // rings: the radius swings by +- amplitude
    double start = 0.0, end = 1.0, ramp = 0.05;
    double amplitude = 0.002, wavelength = 0.03;
};

// A mound height (1 - x^2)^3 (1 - y^2)^3, x and y from -1 to 1 along the pipe and around it, with grains on it.
struct Deposit {
    double s = 0.0, clock = 3.141592653589793; // of its centre
    double length = 0.4, extent = 1.6;         // along the pipe; around it, radians
    double height = 0.03;
    double roughness = 0.0, grain = 0.006; // height (times the mound's share of its own) and size of the grains
    uint64_t seed = 1;
};

// The wall as a table: radius[row * around + column] at s = start + row * step and clock = column * 2 pi / around, in
// metres, in place of the round section; between by cubic convolution (Keys, 1981: through the values, with a
// continuous slope); before and behind it, its end rows.
struct WallGrid {
    double start = 0.0, step = 0.01;
    int around = 0; // 0: none
    std::vector<double> radius;
};

// A hole through the wall: a cylinder along the radius, `depth` deep.
struct Hole {
    double s = 0.0, clock = 0.0, diameter = 0.03, depth = 0.05;
};

struct PathPoint {
    double s = 0.0, phi = 0.0; // phi goes on beyond a turn
};

// A groove of constant width along a path. Its width and the path's shape are measured on the nominal radius.
struct Crack {
    std::vector<PathPoint> path;
    double width = 0.001, depth = 0.01;
    double meander = 0.0, grain = 0.01; // random sideways displacement, metres; pieces between its corners
    uint64_t seed = 1;
};

// A branch pipe, from the axis at s towards `clock`, at `angle` with the direction of travel.
struct Lateral {
    double s = 0.0, clock = 1.5707963267948966, diameter = 0.1;
    double angle = 1.5707963267948966;
    double length = 2.0; // from the main axis to its closed end
};

// Roots that come through the wall and hang down: tapered tubes that branch.
struct Root {
    double s = 0.0, clock = 0.0, length = 0.1, diameter = 0.004;
    int strands = 5, branches = 4; // of the bundle; of every strand
    double spread = 0.35;          // radians, of the strands about the inward normal
    uint64_t seed = 1;
};

// Standing or flowing water, `depth` deep at the invert of the section at `s`, between two arc lengths.
struct Water {
    double s = 0.0, start = -1000.0, end = 1000.0, depth = 0.03;
    int sloped = 0;                                            // 0: horizontal; 1: along the pipe's slope at s
    double ripple = 0.0, ripple_length = 0.05, velocity = 0.3; // largest slope of the ripples, their size and speed
    double refraction = 1.333, body = 0.03;                    // index; reflectance of what is under the surface
    uint64_t seed = 1;
};

struct FeatureSpec {
    std::vector<JointSpec> joints;
    JointSeries joint_series;
    std::vector<EggStretch> eggs;
    std::vector<Corrugation> corrugations;
    std::vector<Deposit> deposits;
    WallGrid grid;
    std::vector<Hole> holes;
    std::vector<Crack> cracks;
    std::vector<Lateral> laterals;
    std::vector<Root> roots;
    std::vector<Water> water;
};

// A height over the section's radius and its derivatives.
struct Height {
    double h = 0.0, by_s = 0.0, by_phi = 0.0;
};

// Of a height: least and largest value, and bounds of the derivatives' absolute values.
struct HeightBounds {
    double least = 0.0, most = 0.0, by_s = 0.0, by_phi = 0.0, by_ss = 0.0, by_sphi = 0.0, by_phiphi = 0.0;
    void add(const HeightBounds &b);
};

class Relief
{
public:
    virtual ~Relief() = default;
    double from = 0.0, to = 0.0; // beyond these arc lengths it is zero
    int deposit = -1;            // its index, if it is one
    // Adds to `sum` at arc length s and clock angle phi in [0, 2 pi).
    virtual void add(double s, double phi, Height &sum) const = 0;
    virtual HeightBounds bounds(double s_from, double s_to) const = 0;
    // The same of a smoother wall that never lies further from the axis, and by how much it may lie nearer; 0: there is
    // none but itself.
    virtual void add_cover(double s, double phi, Height &sum) const { add(s, phi, sum); }
    virtual HeightBounds cover_bounds(double s_from, double s_to) const { return bounds(s_from, s_to); }
    virtual double cover_depth() const { return 0.0; }
    // By how much, radians, a clock angle lies outside the relief's extent; 0 inside and where it has no limits.
    virtual double outside(double) const { return 0.0; }
    virtual std::vector<double> cuts() const { return {from, to}; } // arc lengths where its bounds had better change
};

// All reliefs of a description, for a pipe of this radius. Throws SpecError.
std::vector<std::unique_ptr<Relief>> make_reliefs(const FeatureSpec &spec, double radius);

// The joints, those of the series among them, in order. Throws SpecError when they stand too close.
std::vector<JointSpec> all_joints(const FeatureSpec &spec, double radius, double length);

// A crack's path with its meander, and the distance from it on the nominal radius.
class CrackPath
{
public:
    CrackPath(const Crack &spec, double radius);

    double half_width() const { return half_width_; }
    double depth() const { return depth_; }
    double from() const { return all_.s_low - half_width_; }
    double to() const { return all_.s_high + half_width_; }
    const std::vector<PathPoint> &path() const { return path_; }

    // Distance of (s, phi) from the path, metres; infinite if above `reach`. (by_s, by_arc): its gradient by the arc
    // length and by nominal radius times clock angle.
    double distance(double s, double phi, double reach, double *by_s = nullptr, double *by_arc = nullptr) const;

private:
    static constexpr size_t GROUP = 8;
    struct Box {
        double s_low, s_high, phi_low, phi_high;
    };

    double radius_, half_width_, depth_;
    std::vector<PathPoint> path_;
    Box all_;
    std::vector<Box> boxes_; // of every GROUP pieces
};

} // namespace pipefish::sim
