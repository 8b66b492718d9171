// Robust losses of a whitened squared residual s: rho(s) with rho(0) = 0 and rho'(0) = 1 (nearly, for a mixture), so
// that small residuals count as in least squares. Used with the weight rho' (iteratively reweighted least squares).
#pragma once

#include <cmath>

namespace pipefish::optim
{

struct RobustLoss {
    enum class Kind {
        squared,
        huber,
        cauchy,
        mixture, // normal, but a share of them with `scale` times the spread: what slips
    };
    Kind kind = Kind::squared;
    double scale = 1.0; // in standard deviations: where the loss starts to bend
    double share = 0.0; // of the wide part of a mixture

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
        case Kind::mixture: {
            // rho = -2 log of the density, less its value at 0; the weight is its derivative. With the exponential of
            // the wide part taken out of the sum: far off, where both are 0 in double precision, it is that part alone.
            const double wide = share / scale, decay = std::exp(-0.5 * s * (1.0 - 1.0 / c2));
            const double sum = (1.0 - share) * decay + wide;
            return {s / c2 - 2.0 * std::log(sum / (1.0 - share + wide)), ((1.0 - share) * decay + wide / c2) / sum};
        }
        default:
            return {s, 1.0};
        }
    }
};

} // namespace pipefish::optim
