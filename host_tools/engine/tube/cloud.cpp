#include "tube/cloud.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::tube
{

namespace
{

constexpr double CUT = 2.5;                // standard deviations, beyond which residuals say nothing about the core
constexpr double CUT_VARIANCE = 0.9112564; // of a standard Gaussian cut there

// Sum over residuals within the cut of r^2 / variance, less what Gaussian ones would give.
double excess(std::span<const double> r, std::span<const double> noise, double tau, double freedom)
{
    double sum = 0.0, count = 0.0;
    for (size_t i = 0; i < r.size(); i++) {
        const double z2 = r[i] * r[i] / (noise[i] + tau * tau);
        if (z2 < CUT * CUT) {
            sum += z2;
            count += 1.0;
        }
    }
    return sum - CUT_VARIANCE * freedom * count;
}

} // namespace

double roughness(std::span<const double> r, std::span<const double> noise, int parameters)
{
    if (r.empty()) {
        return 0.0;
    }
    std::vector<double> size(r.size());
    std::transform(r.begin(), r.end(), size.begin(), [](double v) { return std::abs(v); });
    const auto middle = size.begin() + static_cast<std::ptrdiff_t>(size.size() / 2);
    std::nth_element(size.begin(), middle, size.end());
    const double n = static_cast<double>(r.size()), freedom = std::max(0.2, 1.0 - parameters / n);
    // With 45 % of gross residuals the median of the sizes is the 91st percentile of the good ones: 1.7 sigma. The root
    // below that start is the core's; one above would be the gross ones'.
    double high = 2.0 * *middle, low = 0.0;
    if (high <= 0.0) {
        return 0.0;
    }
    while (excess(r, noise, high, freedom) > 0.0 && high < 16.0 * *middle) {
        high *= 1.5;
    }
    // Downwards in steps to the first sign change, then halving.
    double step = high;
    while (step > 1e-6 * high) {
        const double next = step * 0.8;
        if (excess(r, noise, next, freedom) > 0.0) {
            low = next;
            break;
        }
        step = next;
    }
    if (low == 0.0) {
        return 0.0; // the noise alone explains the residuals
    }
    high = step;
    for (int i = 0; i < 50; i++) {
        const double tau = 0.5 * (low + high);
        (excess(r, noise, tau, freedom) > 0.0 ? low : high) = tau;
    }
    return 0.5 * (low + high);
}

} // namespace pipefish::tube
