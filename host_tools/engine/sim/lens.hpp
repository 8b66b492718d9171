// The simulator's lens: a table of field angle, image radius and pupil position, interpolated by cubic splines, and
// harmonics around the axis on top. It shares no code and no formula with lib/camera, so that an error in either shows.
//
// A ray that makes the angle theta with the optical axis, in the direction phi around it (0 = the image's x axis, pi/2
// = its y axis), meets the axis at z = pupil(theta) (metres, pupil(0) = 0: the camera centre is the paraxial entrance
// pupil) and lands radius(theta) pixels from the principal point, moved by the asymmetry.
#pragma once

#include <array>
#include <vector>

namespace pipefish::sim
{

enum class LensPreset { fisheye_185, fisheye_220, wide_120, narrow_60, hyperbolic, equiangular };

struct LensNode {
    double theta = 0.0, radius_px = 0.0, pupil_m = 0.0;
};

// With a = (theta / theta_max)^(harmonic + 1), the image point moves a radial_px cos(harmonic phi - phase) outwards and
// a tangential_px sin(harmonic phi - phase) around the axis. That power makes the map smooth on the axis. A decentred
// element makes the first, a tilted one the second, a clamped one the third.
struct LensHarmonic {
    int harmonic = 1;
    double radial_px = 0.0, tangential_px = 0.0, phase = 0.0;
};

// "Exactly this profile": the model of docs/profile.md, generic radial function, no tilt. f_u = 0: there is none.
struct LensProfile {
    double f_u = 0.0, f_v = 0.0, skew = 0.0; // pixels per radian
    double k2 = 0.0, k3 = 0.0, k4 = 0.0, k5 = 0.0;
    std::array<double, 3> asym_radial_theta{}, asym_tangential_theta{};
    std::array<double, 4> asym_radial_phi{}, asym_tangential_phi{};
    std::array<double, 14> cpoly{};
    double pupil_e1 = 0.0; // metres
};

struct LensSpec {
    LensPreset preset = LensPreset::fisheye_185; // the radial law, and what apply_preset() sets
    int width = 1280, height = 800;              // pixels
    double c_u = 643.2, c_v = 397.6;             // principal point = centre of the image circle
    double theta_min = 0.0;       // radians; nearer to the axis the image is blind (a mirror's own camera)
    double theta_max = 1.6144;    // radians: the field's edge, 92.5 degrees
    double circle_radius = 395.0; // pixels, at theta_max
    double pupil_scale = 1.0;     // size of the lens; 0 = a central camera
    double zonal_px = 0.1;        // height of the zonal error of the image radius near the rim, pixels
    std::vector<LensHarmonic> asymmetry = {{1, 0.30, 0.10, 0.7}, {2, 0.12, 0.12, 1.9}, {3, 0.08, 0.05, 4.1}};
    double vignetting = 0.25;    // share of the light lost at the edge, grows with theta^4
    double rim_blur_px = 0.6;    // sigma that the optics add at the edge, in quadrature; grows with theta^2
    std::vector<LensNode> table; // if not empty: the lens, instead of the preset's law
    LensProfile profile;         // if f_u > 0: the lens, without anything on top

    // Sets all that a preset decides, for width and height as they are.
    void apply_preset();
};

struct LensTable {
    std::vector<double>
        theta; // radians, starts at 0, increasing, below pi; at least 4 nodes; the last is the field's edge
    std::vector<double> radius; // pixels, starts at 0, increasing
    std::vector<double> pupil;  // metres, starts at 0
};

// A table for a fisheye traced from its own prescription: two negative menisci in front of a stop (which give the pupil
// shift) and a rear group that maps the chief ray's angle at the stop by a compound law. theta_max in radians (up to
// 115 degrees), circle_radius in pixels at theta_max; pupil_scale stretches the lens (1: pupil shift 2.8 mm at 92.5
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
    // Throws std::invalid_argument: a table that is not as LensTable says, a preset's law that does not reach
    // theta_max, an image that does not grow or folds over within the field.
    explicit Lens(const LensSpec &spec);

    const LensTable &table() const { return table_; }
    double theta_max() const { return table_.theta.back(); }
    double circle_radius() const { return table_.radius.back(); } // without the asymmetry
    double radius(double theta) const { return radius_(theta); }  // likewise
    double pupil(double theta) const;

    struct Image { // pixels from the principal point, and derivatives by the angles
        double x, y, x_theta, y_theta, x_phi, y_phi;
    };
    Image image(double theta, double phi) const;
    // The inverse, to 1e-11 px. False where the lens sees nothing: beyond theta_max, nearer than theta_min.
    bool angles(double x, double y, double &theta, double &phi) const;
    // The field angle of the ray through the point (rho, z) (metres, rho >= 0 off the axis), whose origin is the pupil
    // of that very angle. False outside the field or behind the pupil.
    bool theta_of_point(double rho, double z, double &theta) const;

private:
    void check_table() const;
    void check_image() const;
    double pupil(double theta, double *slope) const;

    LensTable table_;
    Spline radius_, pupil_;
    double theta_min_;
    std::vector<LensHarmonic> asymmetry_;
    LensProfile profile_;
};

} // namespace pipefish::sim
