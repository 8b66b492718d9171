// Robust losses of a whitened squared residual s: rho(s) with rho(0) = 0 and rho'(0) = 1, so that small residuals count
// as in least squares. Used with the weight rho' (iteratively reweighted least squares).
#pragma once

#include <cmath>

namespace pipefish::optim
{

struct RobustLoss {
    enum class Kind { squared, huber, cauchy };
    Kind kind = Kind::squared;
    double scale = 1.0; // in standard deviations: where the loss starts to bend

    struct Value {
        double rho, weight;
    };

    Value operator()(double s) const
    {
        const double c2 = scale * scale;
        switch (kind) {
        case Kind::huber: {
            if (s <= c2) {
                return {s, 1.0};
            }
            const double root = std::sqrt(s);
            return {2.0 * scale * root - c2, scale / root};
        }
        case Kind::cauchy:
            return {c2 * std::log1p(s / c2), 1.0 / (1.0 + s / c2)};
        default:
            return {s, 1.0};
        }
    }
};

} // namespace pipefish::optim
