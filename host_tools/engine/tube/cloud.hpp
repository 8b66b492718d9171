// Points with their measurement noise, and the robust scale that tells it from the wall's roughness.
#pragma once

#include <Eigen/Core>

#include <span>
#include <vector>

namespace pipefish::tube
{

struct Cloud {
    Eigen::Matrix3Xd points;                 // metres
    std::vector<double> sigma;               // isotropic, one a point; empty: unknown
    std::vector<Eigen::Matrix3d> covariance; // one a point; empty: isotropic or unknown

    int size() const { return static_cast<int>(points.cols()); }
    // Variance of point i along the unit vector n; 0 where noise is unknown.
    double variance(int i, const Eigen::Vector3d &n) const
    {
        const size_t k = static_cast<size_t>(i);
        if (!covariance.empty()) {
            return n.dot(covariance[k] * n);
        }
        return sigma.empty() ? 0.0 : sigma[k] * sigma[k];
    }
};

// Tukey's biweight at 4.685 standard deviations: 95 % efficient on Gaussian noise.
constexpr double TUKEY = 4.685;
// Variance of that estimate over the inverse of its weighted normal matrix, for Gaussian noise: E psi^2 E w / (E
// psi')^2.
constexpr double TUKEY_VARIANCE = 0.9633;

inline double tukey_weight(double squared_over_variance)
{
    const double v = 1.0 - squared_over_variance / (TUKEY * TUKEY);
    return v > 0.0 ? v * v : 0.0;
}

// Standard deviation tau of the wall itself: the residuals r have variances noise + tau^2, next to which there may be
// gross ones of any share below a half. `parameters` were fitted to them. Zero where the noise explains all.
double roughness(std::span<const double> r, std::span<const double> noise, int parameters);

} // namespace pipefish::tube
