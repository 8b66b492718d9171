// The simulated lens: a table of field angle, image radius and pupil shift, made from a compound law that no odd
// polynomial equals. Independent of lib/camera on purpose.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

namespace pipefish::sim
{

using Vec2 = Eigen::Vector2d;
using Vec3 = Eigen::Vector3d;

struct LensSpec {
    int width = 1280, height = 800;
    double focal_px = 262;     // pixels per radian on the axis
    double equisolid = 0.65;   // share of 2 sin(theta / 2) in the law, the rest is theta
    double theta_max = 1.6144; // 92.5 degrees
    double c_u = 643.2, c_v = 397.6;
    double pupil_mm = 1.5;    // how far the entrance pupil moves back along the axis at 90 degrees
    double vignetting = 0.25; // share of light lost at the rim
};

struct Ray {
    Vec3 origin, direction; // camera frame, metres
};

class Lens
{
public:
    explicit Lens(const LensSpec &spec);
    const LensSpec &spec() const { return spec_; }

    std::optional<Ray> unproject(const Vec2 &px) const;
    std::optional<Vec2> project(const Vec3 &point) const;

    double circle_radius() const { return radius_.back(); }      // pixels, at theta_max
    double pupil(double theta) const;                            // z of the ray's origin, metres
    double radius(double theta) const;                           // pixels
    const std::vector<double> &table() const { return radius_; } // at theta_max * i / (n - 1)

private:
    LensSpec spec_;
    std::vector<double> radius_;
    double step_;
};

} // namespace pipefish::sim
