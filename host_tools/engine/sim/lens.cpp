#include "sim/lens.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <stdexcept>

namespace pipefish::sim
{

namespace
{

struct Surface {
    double vertex, radius, index; // millimetres from the stop; sphere centred at vertex - radius; index beyond it
};

// From the stop outwards. Chosen by hand for a smooth, growing pupil shift; close in shape to common fisheyes.
constexpr Surface PRESCRIPTION[] = {
    {3.0, 4.2, 1.62},
    {4.0, 9.0, 1.0},
    {8.0, 6.6, 1.77},
    {9.6, 15.5, 1.0},
};

struct Chief {
    bool ok;
    double theta, crossing; // radians; where the ray outside, prolonged, meets the axis, millimetres
};

// Traces the chief ray that leaves the stop's centre at the angle alpha > 0 out into the object space (Snell at
// spheres).
Chief trace_chief(double alpha)
{
    double px = 0.0, pz = 0.0, dx = std::sin(alpha), dz = std::cos(alpha), index = 1.0;
    for (const Surface &s : PRESCRIPTION) {
        const double oz = pz - (s.vertex - s.radius);
        const double b = px * dx + oz * dz;
        const double disc = b * b - (px * px + oz * oz - s.radius * s.radius);
        if (disc < 0.0) {
            return {false, 0.0, 0.0};
        }
        const double t = -b + std::sqrt(disc);
        px += t * dx;
        pz += t * dz;
        const double nx = px / s.radius, nz = (pz - (s.vertex - s.radius)) / s.radius;
        const double cos_in = dx * nx + dz * nz, k = index / s.index;
        const double cos2_out = 1.0 - k * k * (1.0 - cos_in * cos_in);
        if (t < 0.0 || cos2_out < 0.0) {
            return {false, 0.0, 0.0};
        }
        const double bend = std::sqrt(cos2_out) - k * cos_in;
        dx = k * dx + bend * nx;
        dz = k * dz + bend * nz;
        index = s.index;
    }
    return {true, std::atan2(dx, dz), pz - px * dz / dx};
}

// The rear group: between an orthographic and a stereographic mapping of the angle at the stop.
double rear_group(double alpha)
{
    return 0.6 * std::sin(alpha) + 0.8 * std::tan(0.5 * alpha);
}

// The root in [lo, hi] of an increasing function f(t, &slope): Newton from t, a step that leaves the bracket bisects
// it.
template <typename F> double increasing_root(double lo, double hi, double t, const F &f)
{
    for (int k = 0; k < 80; k++) {
        double slope = 0.0;
        const double error = f(t, &slope);
        (error > 0.0 ? hi : lo) = t;
        double next = t - error / slope;
        if (!(next >= lo && next <= hi)) {
            next = 0.5 * (lo + hi);
        }
        const bool done = std::abs(next - t) < 1e-15;
        t = next;
        if (done) {
            break;
        }
    }
    return t;
}

} // namespace

LensTable trace_fisheye(double theta_max, double circle_radius, double pupil_scale)
{
    constexpr double STEP =
        std::numbers::pi / 360.0; // half a degree: the spline is the lens, so any smooth step will do
    if (!(theta_max > 10.0 * STEP && theta_max <= 100.0 / 180.0 * std::numbers::pi + 1e-12)) {
        throw std::invalid_argument("theta_max must be above 5 and at most 100 degrees for the traced lens");
    }
    const int steps = static_cast<int>(std::ceil(theta_max / STEP - 1e-9));
    const double axis_crossing = trace_chief(1e-5).crossing;
    LensTable table;
    for (int i = 0; i <= steps; i++) {
        const double theta = std::min(theta_max, i * STEP);
        double lo = 0.0, hi = 0.45 * std::numbers::pi;
        for (int k = 0; k < 64 && i > 0; k++) {
            const double mid = 0.5 * (lo + hi);
            const Chief chief = trace_chief(mid);
            (chief.ok && chief.theta < theta ? lo : hi) = mid;
        }
        const Chief chief = i > 0 ? trace_chief(lo) : Chief{true, 0.0, axis_crossing};
        if (!chief.ok || std::abs(chief.theta - theta) > 1e-9) {
            throw std::invalid_argument("theta_max is beyond the traced lens's field");
        }
        table.theta.push_back(theta);
        table.radius.push_back(i > 0 ? rear_group(lo) : 0.0);
        table.pupil.push_back(1e-3 * pupil_scale * (chief.crossing - axis_crossing));
    }
    const double scale = circle_radius / table.radius.back();
    for (double &r : table.radius) {
        r *= scale;
    }
    return table;
}

Spline::Spline(const std::vector<double> &x, const std::vector<double> &y, bool even) : x_(x), y_(y), y2_(x.size())
{
    // Thomas algorithm on the second derivatives; the first row is y'' = 0 or the clamped end y' = 0.
    const size_t n = x.size();
    std::vector<double> c(n), d(n);
    if (even) {
        const double h = x[1] - x[0];
        c[0] = 0.5;
        d[0] = 3.0 * (y[1] - y[0]) / (h * h);
    }
    for (size_t i = 1; i + 1 < n; i++) {
        const double h0 = x[i] - x[i - 1], h1 = x[i + 1] - x[i];
        const double rhs = 6.0 * ((y[i + 1] - y[i]) / h1 - (y[i] - y[i - 1]) / h0);
        const double pivot = 2.0 * (h0 + h1) - h0 * c[i - 1];
        c[i] = h1 / pivot;
        d[i] = (rhs - h0 * d[i - 1]) / pivot;
    }
    for (size_t i = n - 1; i-- > 0;) {
        y2_[i] = d[i] - c[i] * y2_[i + 1];
    }
}

double Spline::operator()(double t, double *slope) const
{
    const auto at = std::upper_bound(x_.begin() + 1, x_.end() - 1, t);
    const size_t i = static_cast<size_t>(at - x_.begin()) - 1;
    const double h = x_[i + 1] - x_[i], b = (t - x_[i]) / h, a = 1.0 - b;
    if (slope != nullptr) {
        *slope = (y_[i + 1] - y_[i]) / h + h / 6.0 * ((3.0 * b * b - 1.0) * y2_[i + 1] - (3.0 * a * a - 1.0) * y2_[i]);
    }
    return a * y_[i] + b * y_[i + 1] + h * h / 6.0 * ((a * a * a - a) * y2_[i] + (b * b * b - b) * y2_[i + 1]);
}

Lens::Lens(LensTable table) : table_(std::move(table))
{
    const size_t n = table_.theta.size();
    if (n < 4 || table_.radius.size() != n || table_.pupil.size() != n) {
        throw std::invalid_argument("a lens table needs at least 4 nodes, as many radii and pupils as angles");
    }
    if (table_.theta[0] != 0.0 || table_.radius[0] != 0.0 || table_.pupil[0] != 0.0) {
        throw std::invalid_argument("a lens table starts at theta = 0, radius 0, pupil 0");
    }
    for (size_t i = 1; i < n; i++) {
        if (!(table_.theta[i] > table_.theta[i - 1]) || !(table_.radius[i] > table_.radius[i - 1]) ||
            !std::isfinite(table_.radius[i]) || !(std::abs(table_.pupil[i]) < 0.1)) {
            throw std::invalid_argument("a lens table's angles and radii must increase, its pupil stay within 0.1 m");
        }
    }
    if (!(table_.theta.back() < std::numbers::pi)) {
        throw std::invalid_argument("a lens table ends below pi radians");
    }
    radius_ = Spline(table_.theta, table_.radius, false);
    pupil_ = Spline(table_.theta, table_.pupil, true);
    constexpr int PER_NODE = 16;
    for (size_t i = 0; i + 1 < n; i++) {
        for (int k = 0; k <= PER_NODE; k++) {
            double slope = 0.0;
            radius_(table_.theta[i] + k * (table_.theta[i + 1] - table_.theta[i]) / PER_NODE, &slope);
            if (!(slope > 0.0)) {
                throw std::invalid_argument("the lens table's radius is not increasing between its nodes");
            }
        }
    }
}

bool Lens::theta_of_radius(double r, double &theta) const
{
    if (!(r >= 0.0 && r <= circle_radius())) {
        return false;
    }
    double lo = 0.0, hi = theta_max(), t = hi * r / circle_radius();
    theta = increasing_root(lo, hi, t, [&](double at, double *slope) { return radius_(at, slope) - r; });
    return true;
}

bool Lens::theta_of_point(double rho, double z, double &theta) const
{
    if (!std::isfinite(rho) || !std::isfinite(z)) {
        return false;
    }
    const auto miss = [&](double t, double *slope) { // > 0: the point lies further off the axis than the ray of t
        double de = 0.0;
        const double ahead = z - pupil_(t, &de), s = std::sin(t), c = std::cos(t);
        if (slope != nullptr) {
            *slope = -rho * s - ahead * c + de * s;
        }
        return rho * c - ahead * s;
    };
    double lo = 0.0, hi = theta_max(), t = std::min(std::atan2(rho, z), hi);
    if (miss(hi, nullptr) > 0.0) {
        return false;
    }
    theta = increasing_root(lo, hi, t, [&](double at, double *slope) {
        const double value = miss(at, slope);
        *slope = -*slope;
        return -value;
    });
    return rho * std::sin(theta) + (z - pupil_(theta)) * std::cos(theta) > 0.0;
}

} // namespace pipefish::sim
