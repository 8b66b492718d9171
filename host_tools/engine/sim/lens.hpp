// The simulator's lens: a table of field angle, image radius and pupil position, interpolated by cubic splines. It
// shares no code and no formula with lib/camera, so that an error in either shows.
//
// A ray that makes the angle theta with the optical axis meets the axis at z = pupil(theta) (metres, pupil(0) = 0: the
// camera centre is the paraxial entrance pupil) and lands radius(theta) pixels from the principal point.
#pragma once

#include <vector>

namespace pipefish::sim
{

struct LensNode {
    double theta = 0.0, radius_px = 0.0, pupil_m = 0.0;
};

struct LensSpec {
    int width = 1280, height = 800;  // pixels
    double c_u = 643.2, c_v = 397.6; // principal point = centre of the image circle
    double theta_max = 1.6144;       // radians: the field's edge, 92.5 degrees
    double circle_radius = 395.0;    // pixels, at theta_max
    double pupil_scale = 1.0;        // size of the traced lens; 0 = a central camera
    double zonal_px = 0.1;           // height of the zonal error of the image radius near the rim, pixels
    double vignetting = 0.25;        // share of the light lost at the edge, grows with theta^4
    std::vector<LensNode> table;     // if not empty: the lens, instead of the traced one
};

struct LensTable {
    std::vector<double>
        theta; // radians, starts at 0, increasing, below pi; at least 4 nodes; the last is the field's edge
    std::vector<double> radius; // pixels, starts at 0, increasing
    std::vector<double> pupil;  // metres, starts at 0
};

// A table for a fisheye traced from its own prescription: two negative menisci in front of a stop (which give the pupil
// shift) and a rear group that maps the chief ray's angle at the stop by a compound law. theta_max in radians (up to
// 100 degrees), circle_radius in pixels at theta_max; pupil_scale stretches the lens (1: pupil shift 2.8 mm at 92.5
// degrees, 0: a central camera). Throws std::invalid_argument outside the prescription's field.
LensTable trace_fisheye(double theta_max, double circle_radius, double pupil_scale);

// Cubic spline through (x, y). At the first node either y'' = 0 (odd functions) or y' = 0 (even); y'' = 0 at the last.
class Spline
{
public:
    Spline() = default;
    Spline(const std::vector<double> &x, const std::vector<double> &y, bool even);
    // Value at t; *slope gets the derivative. Beyond the nodes the end polynomials continue.
    double operator()(double t, double *slope = nullptr) const;

private:
    std::vector<double> x_, y_, y2_;
};

class Lens
{
public:
    // Throws std::invalid_argument when the table is not as LensTable says, or its radius is not increasing between
    // nodes.
    explicit Lens(LensTable table);

    const LensTable &table() const { return table_; }
    double theta_max() const { return table_.theta.back(); }
    double circle_radius() const { return table_.radius.back(); }
    double radius(double theta) const { return radius_(theta); }
    double pupil(double theta) const { return pupil_(theta); }

    // The field angle seen `r` pixels from the principal point, to 1e-14 rad. False beyond the circle.
    bool theta_of_radius(double r, double &theta) const;
    // The field angle of the ray through the point (rho, z) (metres, rho >= 0 off the axis), whose origin is the pupil
    // of that very angle. False outside the field or behind the pupil.
    bool theta_of_point(double rho, double z, double &theta) const;

private:
    LensTable table_;
    Spline radius_, pupil_;
};

} // namespace pipefish::sim
