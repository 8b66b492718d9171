// An unknown lens in few numbers whose natural values are known, so that priors are simple:
//
//   r(theta) = f theta (1 + x (kappa_2 + kappa_3 x + kappa_4 x^2 + kappa_5 x^3)),  x = (theta / theta_end)^2
//   kappa    = (1 - w) K(q) + w M(q) + D z
//
// K(q): the polynomial nearest to a nominal projection; q = 1 perspective, 1/4 stereographic, 0 equidistant, -1/8
// equisolid, -1/2 orthographic, and all between (tan(sqrt(q) theta) / sqrt(q), sin(sqrt(-2q) theta) / sqrt(-2q)).
// M(q): to a central mirror's (l + 1) sin theta / (l + cos theta) of the same k2, which goes through perspective,
// stereographic and orthographic too and another way between; w of mean 1/2 and sigma 1/2.
// D z: how a real lens differs from its nearest nominal one, z of mean 0 and variance 1.
// Pixels are square. The camera that results is the generic one of lib/camera.
#pragma once

#include "pipefish/camera.h"
#include "selfcal/dual.hpp"

#include <Eigen/Core>

#include <array>
#include <span>

namespace pipefish::selfcal
{

enum Unknown { kLogF, kShape, kMix, kBend, kCentre = kBend + 3, kLens = kCentre + 2 };
using LensVector = Eigen::Matrix<double, kLens, 1>;
using LensMatrix = Eigen::Matrix<double, kLens, kLens>;

constexpr double kMixMean = 0.5, kMixSigma = 0.5;
constexpr double kShapeMean = 0.2, kShapeSigma = 0.5; // of q: from perspective to orthographic within 1.6 sigma

// r / f of a nominal projection, and of a mirror.
double nominal_radius(double q, double theta);
double mirror_radius(double q, double theta);

class LensFamily
{
public:
    // theta_end: the largest angle that is looked at; bend: how far a lens differs from a nominal one, of its radius.
    LensFamily(double theta_end, double bend);

    double theta_end() const { return theta_end_; }
    // Whether the nominal projection q holds up to theta_end.
    bool holds(double q) const;
    // k2 .. k5, and their derivative by the unknowns.
    Eigen::Vector4d coefficients(const LensVector &lens) const;
    Eigen::Matrix<double, 4, kLens> slope(const LensVector &lens) const;

private:
    Eigen::Vector4d nominal(double q, double mix) const;

    double theta_end_;
    Eigen::Vector4d unit_; // from kappa to k
    Eigen::Matrix<double, 4, Eigen::Dynamic> fit_;
    Eigen::VectorXd node_;
    Eigen::Matrix<double, 4, 3> bend_;
};

// The camera, with theta_max where r stops rising, at most `limit`.
pf_camera make_camera(const LensFamily &family, const LensVector &lens, uint32_t width, uint32_t height, double limit);

// A pixel's ray and what one pixel is on the sphere, away from the axis and around it.
template <class T> using Vec = std::array<T, 3>;
template <class T> struct Beam {
    Vec<T> ray, away, around;
};

// A camera with its derivatives by N unknowns, the first of them the lens's.
template <int N> class Slopes
{
public:
    Slopes(const pf_camera &camera, const LensFamily &family, const LensVector &lens);

    // False where the pixel is outside the model.
    bool operator()(const Eigen::Vector2d &uv, Beam<Dual<N>> &beam) const;
    // Angle from the axis.
    bool theta(const Eigen::Vector2d &uv, Dual<N> &theta) const;

private:
    struct Polar {
        Dual<N> rho, theta, cosine, sine; // rho: radius over f; cosine, sine: around the axis
        double angle = 0.0;
    };
    bool polar(const Eigen::Vector2d &uv, Polar &out) const;

    const pf_camera &camera_;
    Eigen::Matrix<double, 4, N> k_slope_;
};

bool make_beam(const pf_camera &camera, const Eigen::Vector2d &uv, Beam<double> &beam);

} // namespace pipefish::selfcal
