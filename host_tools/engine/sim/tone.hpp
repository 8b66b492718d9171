// From linear light to the sensor's answer: a soft knee below saturation, then gamma.
#pragma once

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

struct ToneSpec {
    double gamma = 1.0; // the answer is linear^(1 / gamma)
    double knee = 0.9;  // share of full scale where highlights begin to bend; 1 = clipped hard
};

// Full scale is 255 before and after. Above the knee k (shares of full scale): k + (1 - k)(1 - exp(-(x - k)/(1 - k))),
// which leaves k with slope 1 and never passes 1.
inline float tone(const ToneSpec &spec, float grey)
{
    const float knee = static_cast<float>(spec.knee);
    float x = grey * (1.0f / 255.0f);
    if (x > knee) {
        const float room = 1.0f - knee;
        x = room > 0.0f ? knee + room * (1.0f - std::exp((knee - x) / room)) : 1.0f;
    }
    if (spec.gamma != 1.0) {
        x = std::pow(std::max(x, 0.0f), static_cast<float>(1.0 / spec.gamma));
    }
    return 255.0f * x;
}

} // namespace pipefish::sim
