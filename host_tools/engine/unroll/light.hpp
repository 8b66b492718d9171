// How bright a wall of one reflectance looks: lamp, lens and exposure. A pixel's grey is
//   exp(gain of its keyframe + field at its direction + fall-off) times the wall's reflectance,
// with the fall-off of a lamp beside the lens, cos(incidence) / distance^2, and the field whatever lamp and lens add.
#pragma once

#include <Eigen/Core>

#include <vector>

namespace pipefish::unroll
{

// Natural logarithm over the angle from the axis and the azimuth of the camera, bilinear between knots.
struct LightField {
    static constexpr int RINGS = 14, SECTORS = 12;
    double theta_max = 1.6; // radians, of the last ring; the first is at 0
    Eigen::VectorXd value = Eigen::VectorXd::Zero(RINGS * SECTORS);

    struct Place {
        int knot[4];
        double weight[4];
    };
    Place place(double theta, double phi) const;
    double at(double theta, double phi) const;
};

// A piece of wall in a keyframe: the logarithm of its grey over the fall-off.
struct Glance {
    int patch, view;
    double level, theta, phi;
};

struct Light {
    LightField field;
    Eigen::VectorXd gain; // a view
    double level = 0.0;   // median of the wall's logarithm of reflectance
    double scatter = 0.0; // robust sigma of what two views of one patch differ by after balancing
};

// Gains and field that make views of the same patches alike. `glances` by patch; along: where each view is along the
// pipe. What no overlap tells (the level of a stretch without overlap to others, a trend along the pipe) stays zero.
Light balance(const std::vector<Glance> &glances, const Eigen::VectorXd &along, double theta_max);

} // namespace pipefish::unroll
