// The camera's exposure from frame to frame: fixed, by a script, or by a control loop that lags and moves in steps.
#pragma once

#include <vector>

namespace pipefish::sim
{

enum class ExposureMode { FIXED, SCRIPT, AUTO };

struct ExposureStep {
    int frame = 0;
    double gain = 1.0; // from this frame on
};

struct ExposureSpec {
    ExposureMode mode = ExposureMode::FIXED;
    std::vector<ExposureStep> steps; // of SCRIPT, by frame
    double target = 80.0;            // AUTO: mean grey level that it wants
    double step = 0.25;              // AUTO: the gain moves by powers of 2^step
    double slack = 0.2;              // AUTO: stops of error that it leaves alone
    int interval = 4, delay = 2;     // AUTO: frames between decisions, and from a measured frame to its effect
    double most = 16.0;              // AUTO: gain at most, and one over it at least
};

// The gain of every frame. metered[f]: linear grey levels at gain 1 of the places that the control loop looks at in
// frame f; only AUTO reads it. A place counts as 255 where it is brighter.
std::vector<double> exposure_gains(const ExposureSpec &spec, int frames,
                                   const std::vector<std::vector<float>> &metered);

} // namespace pipefish::sim
