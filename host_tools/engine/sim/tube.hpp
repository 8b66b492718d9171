// The pipe's inside: a centreline of straight runs and circular bends, and a wall r(s, phi) around it.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <optional>
#include <vector>

namespace pipefish::sim
{

using Vec3 = Eigen::Vector3d;

// One piece of the centreline. A bend turns by `angle` towards clock angle `clock` (0 = up, positive clockwise seen
// along the direction of travel) on a circle of `radius`.
struct Piece {
    double length = 0; // metres, of a straight run; a bend's follows from angle and radius
    double angle = 0;  // radians, 0 = straight
    double radius = 0; // metres, of the centreline
    double clock = 0;  // radians
};

// A stretch in which the wall is an ellipse: ovality (D_max - D_min) / D_mean rises from 0 at `start` to its full
// value over `ramp`, stays, and falls to 0 at `end`.
struct OvalStretch {
    double start = 0, end = 0, ramp = 0; // metres of arc length
    double ovality = 0;
    double clock = 0; // of D_max, radians
};

// Local frame of the centreline at s. `up` and `right` are transported without rotation about the tangent.
struct Frame {
    Vec3 centre, tangent, up, right;
};

// Where a point is, seen from the centreline: arc length, distance from the axis, clock angle.
struct TubePoint {
    double s = 0, rho = 0, phi = 0;
    int piece = 0;
};

// A cross-section: semi-axes and the clock angle of the longer.
struct Section {
    double a = 0, b = 0, clock = 0;
    double radius(double phi) const;
};

struct Hit {
    double distance = 0; // along the ray
    Vec3 point, normal;  // normal towards the inside
    TubePoint at;
};

// World frame: the pipe starts at the origin along +z, with x to the right and y down.
class Tube
{
public:
    Tube(double diameter, std::vector<Piece> pieces, std::vector<OvalStretch> ovals);

    double length() const { return start_.back(); }
    double diameter() const { return 2 * radius_; }

    // Straight extrapolation before 0 and beyond the end.
    Frame frame(double s) const;
    Section section(double s) const;

    // `hint` is the piece where the search begins; the answer's .piece serves as the next hint.
    TubePoint locate(const Vec3 &point, int hint = 0) const;
    Vec3 wall(double s, double phi) const;

    // First meeting of the ray with the wall, exact to 1e-8 m; the origin must be inside.
    std::optional<Hit> cast(const Vec3 &origin, const Vec3 &direction, double max_distance, int hint = 0) const;

private:
    double radius_;
    std::vector<Piece> pieces_;
    std::vector<OvalStretch> ovals_;
    std::vector<double> start_;   // arc length where piece i starts; the last is the whole length
    std::vector<Frame> frames_;   // at those places
    std::vector<Vec3> inward_;    // from there to the centre of the bend that begins there, unit length
    std::vector<double> changes_; // arc lengths where the wall stops being one straight cylinder, ascending

    // A point in the frame of its foot on the centreline.
    struct Local {
        double s, up, right;
        int piece;
        bool bent;
        Frame frame;
        Section section;
    };
    double straight_ahead(const Local &at, const Vec3 &direction) const;
    Local local(const Vec3 &point, int hint) const;
};

} // namespace pipefish::sim
