#include "sim/exposure.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

namespace
{

double mean_level(const std::vector<float> &places, double gain)
{
    double sum = 0.0;
    for (float x : places) {
        sum += std::min(gain * static_cast<double>(x), 255.0);
    }
    return std::max(sum / static_cast<double>(std::max<size_t>(places.size(), 1)), 0.1);
}

} // namespace

std::vector<double> exposure_gains(const ExposureSpec &spec, int frames, const std::vector<std::vector<float>> &metered)
{
    std::vector<double> gains(static_cast<size_t>(frames), 1.0);
    if (spec.mode == ExposureMode::SCRIPT) {
        for (const ExposureStep &s : spec.steps) {
            for (size_t f = static_cast<size_t>(std::max(s.frame, 0)); f < gains.size(); f++) {
                gains[f] = s.gain;
            }
        }
    }
    if (spec.mode != ExposureMode::AUTO) {
        return gains;
    }
    const int highest = static_cast<int>(std::floor(std::log2(spec.most) / spec.step));
    const auto stops = [&](size_t frame, double gain) {
        return std::log2(spec.target / mean_level(metered[frame], gain));
    };
    int level = 0;
    // The recording begins with a settled loop.
    for (int k = 0; k < 100; k++) {
        const double error = stops(0, std::exp2(level * spec.step));
        if (std::abs(error) <= std::max(spec.slack, 0.6 * spec.step)) {
            break;
        }
        level = std::clamp(level + (error > 0.0 ? 1 : -1), -highest, highest);
    }
    for (int f = 0; f < frames; f++) {
        const int seen = f - spec.delay;
        if (f % spec.interval == 0 && seen >= 0) {
            const size_t at = static_cast<size_t>(seen);
            const double error = stops(at, gains[at]);
            if (std::abs(error) > spec.slack) {
                const int moved = std::clamp(static_cast<int>(std::lround(error / spec.step)), -3, 3);
                level = std::clamp(level + moved, -highest, highest);
            }
        }
        gains[static_cast<size_t>(f)] = std::exp2(level * spec.step);
    }
    return gains;
}

} // namespace pipefish::sim
