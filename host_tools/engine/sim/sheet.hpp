// A textured surface of stated shape: a plane with a relief, or a piece of a cylinder, whose texture may be stretched
// within it. Rays meet it exactly: a ray's first hit is found, never passed.
//
// Its frame: x to the right and y down on its face, z away from a viewer in front of it. A point has the texture
// coordinates (a, b), metres from the sheet's middle; (u, v) = (2 a / width, 2 b / height) are within -1 and 1. It lies
//     at x = a + stretch_a(u, v), y = b + stretch_b(u, v)
// of the base, which is the plane z = relief(2 x / width, 2 y / height), or, bent by `curvature` k about the y axis,
//     (sin(k x) / k, y, (1 - cos(k x)) / k):
// seen from the front k > 0 is the outside of a cylinder, k < 0 the inside.
#pragma once

#include <Eigen/Dense>
#include <array>
#include <vector>

namespace pipefish::sim
{

struct Monomial { // metres u^i v^j
    int i = 0, j = 0;
    double metres = 0.0;
};

struct Wave { // metres sin(u_rate u + v_rate v + phase), rates in radians
    double u_rate = 0.0, v_rate = 0.0, phase = 0.0, metres = 0.0;
};

struct Relief { // a function of (u, v)
    std::vector<Monomial> powers;
    std::vector<Wave> waves;

    bool empty() const { return powers.empty() && waves.empty(); }
    double at(double u, double v, double slope[2]) const;
    // Bounds for |u|, |v| <= reach: of the value, and of the second derivative along a direction that changes u and v
    // by |du| + |dv| = 1.
    double most(double reach) const;
    double most_curved(double reach) const;
};

struct OutlineWave { // the outline's radius gains the share cos(k angle - phase)
    int k = 1;
    double share = 0.0, phase = 0.0;
};

struct Shadow { // the light falls to `share` where u cos(angle) + v sin(angle) > offset, within `soft` around it
    double angle = 0.0, offset = 0.0, soft = 0.05, share = 0.5;
};

enum class Outline { rectangle, round }; // round: the ellipse |(u, v)| = 1, waved

struct SheetSpec {
    double width = 0.3, height = 0.2; // metres
    Outline outline = Outline::rectangle;
    std::vector<OutlineWave> outline_waves;
    double curvature = 0.0; // 1 / metres
    Relief relief, stretch_a, stretch_b;
    std::array<double, 12> pose = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1}; // cam_from_sheet [R | t], row by row
    int texture = 0;                                                    // which of the list that goes with the sheets
    double back = 0.3;                                                  // albedo of the other face
    double gain = 1.0;                                                  // of the light
    Relief light; // of the light's logarithm ("metres" stands for nothing)
    std::vector<Shadow> shadows;
};

struct SheetHit {
    double t = 0.0, a = 0.0, b = 0.0;
    bool back = false;
};

class Sheet
{
public:
    // Throws std::invalid_argument: a relief on a cylinder, a cylinder wider than its circumference, a stretch that
    // folds.
    explicit Sheet(const SheetSpec &spec);

    const SheetSpec &spec() const { return spec_; }
    // The first hit at t > 0 of the ray origin + t direction, in the camera's frame.
    bool cast(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction, SheetHit &hit) const;
    // The point with the texture coordinates (a, b), in the camera's frame; *normal gets the unit normal of the front.
    Eigen::Vector3d place(double a, double b, Eigen::Vector3d *normal = nullptr) const;
    // Factor of the light at (a, b).
    double light(double a, double b) const;
    bool inside(double a, double b) const;
    // Of the ball around all of it: centre and radius.
    const Eigen::Vector3d &centre() const { return centre_; }
    double radius() const { return radius_; }

private:
    bool accept(double x, double y, SheetHit &hit) const;
    bool cast_plane(const Eigen::Vector3d &o, const Eigen::Vector3d &d, SheetHit &hit) const;
    bool cast_relief(const Eigen::Vector3d &o, const Eigen::Vector3d &d, SheetHit &hit) const;
    bool cast_cylinder(const Eigen::Vector3d &o, const Eigen::Vector3d &d, SheetHit &hit) const;
    Eigen::Vector3d normal(double x, double y) const;
    void stretched(double a, double b, double &x, double &y, double slopes[4]) const;

    SheetSpec spec_;
    Eigen::Matrix3d rotation_;
    Eigen::Vector3d shift_, centre_;
    double radius_ = 0.0;
    double reach_u_ = 1.0, reach_v_ = 1.0, most_ = 0.0, curved_ = 0.0; // of the base's |u|, |v|; of the relief there
};

} // namespace pipefish::sim
