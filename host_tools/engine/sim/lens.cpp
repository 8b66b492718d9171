#include "sim/lens.hpp"

#include <algorithm>
#include <cmath>
#include <complex>
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
    if (!(theta_max > 10.0 * STEP && theta_max <= 115.0 / 180.0 * std::numbers::pi + 1e-12)) {
        throw std::invalid_argument("theta_max must be above 5 and at most 115 degrees for the traced lens");
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

namespace
{

constexpr double DEGREE = std::numbers::pi / 180.0;

// Nodes every half degree of a law for the shape of the image radius and of the pupil shift.
template <typename Radius, typename Pupil>
LensTable tabulate(double theta_max, double circle_radius, const Radius &radius, const Pupil &pupil)
{
    LensTable table;
    const int steps = static_cast<int>(std::ceil(theta_max / (0.5 * DEGREE) - 1e-9));
    for (int i = 0; i <= steps; i++) {
        const double theta = std::min(theta_max, i * 0.5 * DEGREE);
        table.theta.push_back(theta);
        table.radius.push_back(circle_radius * radius(theta) / radius(theta_max));
        table.pupil.push_back(pupil(theta));
    }
    return table;
}

LensTable preset_table(const LensSpec &spec)
{
    const double most = spec.theta_max, mm = 1e-3 * spec.pupil_scale;
    switch (spec.preset) {
    case LensPreset::narrow_60: // a perspective lens with barrel distortion; its pupil hardly moves
        if (!(most < 60.0 * DEGREE)) {
            throw std::invalid_argument("theta_max must be below 60 degrees for the narrow lens");
        }
        return tabulate(
            most, spec.circle_radius, [](double t) { return std::tan(t) * (1.0 - 0.06 * std::tan(t) * std::tan(t)); },
            [mm](double t) { return 0.4 * mm * t * t; });
    case LensPreset::hyperbolic: // the mirror's focus is the one viewpoint, but for a millimetre of misplacement
        if (!(most < 140.0 * DEGREE)) {
            throw std::invalid_argument("theta_max must be below 140 degrees for the hyperbolic mirror");
        }
        return tabulate(
            most, spec.circle_radius, [](double t) { return std::sin(t) / (0.9 + std::cos(t)); },
            [mm](double t) { return 0.5 * mm * (1.0 - std::cos(t)); });
    case LensPreset::equiangular: // no one viewpoint: the caustic is centimetres long
        return tabulate(
            most, spec.circle_radius, [](double t) { return t; },
            [mm](double t) { return -6.0 * mm * (1.0 - std::cos(t)); });
    default:
        return trace_fisheye(most, spec.circle_radius, spec.pupil_scale);
    }
}

double profile_radius(const LensProfile &p, double t, double *slope = nullptr)
{
    const double t2 = t * t;
    if (slope != nullptr) {
        *slope = 1.0 + t2 * (3.0 * p.k2 + t2 * (5.0 * p.k3 + t2 * (7.0 * p.k4 + t2 * 9.0 * p.k5)));
    }
    return t * (1.0 + t2 * (p.k2 + t2 * (p.k3 + t2 * (p.k4 + t2 * p.k5))));
}

// A vector along and across the direction phi, and its derivatives, in the axes x and y.
Lens::Image turned(const Lens::Image &p, double c, double s)
{
    const double x = c * p.x - s * p.y, y = s * p.x + c * p.y;
    return {x,
            y,
            c * p.x_theta - s * p.y_theta,
            s * p.x_theta + c * p.y_theta,
            c * p.x_phi - s * p.y_phi - y,
            s * p.x_phi + c * p.y_phi + x};
}

// docs/profile.md's x_d, y_d.
Lens::Image profile_image(const LensProfile &p, double theta, double phi)
{
    using Complex = std::complex<double>;
    const double t2 = theta * theta, c = std::cos(phi), s = std::sin(phi), c2 = c * c - s * s, s2 = 2.0 * s * c;
    const auto odd = [&](const std::array<double, 3> &a, double &slope) {
        slope = a[0] + t2 * (3.0 * a[1] + t2 * 5.0 * a[2]);
        return theta * (a[0] + t2 * (a[1] + t2 * a[2]));
    };
    const auto wave = [&](const std::array<double, 4> &b, double &slope) {
        slope = -b[0] * s + b[1] * c - 2.0 * b[2] * s2 + 2.0 * b[3] * c2;
        return b[0] * c + b[1] * s + b[2] * c2 + b[3] * s2;
    };
    double a_slope = 0.0, b_slope = 0.0, slope = 0.0;
    Lens::Image m{};
    m.x = profile_radius(p, theta, &slope);
    m.x_theta = slope;
    double a = odd(p.asym_radial_theta, a_slope), b = wave(p.asym_radial_phi, b_slope);
    m.x += a * b;
    m.x_theta += a_slope * b;
    m.x_phi = a * b_slope;
    a = odd(p.asym_tangential_theta, a_slope);
    b = wave(p.asym_tangential_phi, b_slope);
    m.y = a * b;
    m.y_theta = a_slope * b;
    m.y_phi = a * b_slope;
    m = turned(m, c, s);
    constexpr int POWERS[7][2] = {{0, 1}, {2, 0}, {1, 1}, {0, 2}, {3, 0}, {1, 2}, {0, 3}}; // of z and conj(z)
    for (size_t k = 0; k < 7; k++) {
        const int degree = POWERS[k][0] + POWERS[k][1], turns = POWERS[k][0] - POWERS[k][1];
        const Complex unit = Complex(p.cpoly[2 * k], p.cpoly[2 * k + 1]) * std::polar(1.0, turns * phi);
        const Complex w = unit * std::pow(theta, degree), w_theta = unit * (degree * std::pow(theta, degree - 1));
        const Complex w_phi = w * Complex(0.0, turns);
        m = {m.x + w.real(),         m.y + w.imag(),        m.x_theta + w_theta.real(), m.y_theta + w_theta.imag(),
             m.x_phi + w_phi.real(), m.y_phi + w_phi.imag()};
    }
    return m;
}

LensTable table_of(const LensSpec &spec)
{
    LensTable table;
    if (spec.profile.f_u > 0.0) { // of its symmetric part: for first guesses and for the size of a texel
        const double focal = 0.5 * (spec.profile.f_u + spec.profile.f_v);
        return tabulate(
            spec.theta_max, focal * profile_radius(spec.profile, spec.theta_max),
            [&](double t) { return profile_radius(spec.profile, t); },
            [&](double t) { return spec.profile.pupil_e1 * t * t; });
    }
    if (!spec.table.empty()) {
        for (const LensNode &node : spec.table) {
            table.theta.push_back(node.theta);
            table.radius.push_back(node.radius_px);
            table.pupil.push_back(node.pupil_m);
        }
        return table;
    }
    table = preset_table(spec);
    // Zones left by the polishing of the front lens: three and a half waves between axis and rim, growing outwards,
    // which no polynomial of degree 9 follows.
    for (size_t i = 0; i < table.theta.size(); i++) {
        const double share = table.theta[i] / spec.theta_max;
        table.radius[i] += spec.zonal_px * share * share * std::sin(7.0 * std::numbers::pi * share);
    }
    return table;
}

} // namespace

void LensSpec::apply_preset()
{
    struct Preset {
        double theta_min, theta_max, circle_radius, vignetting, rim_blur_px; // degrees; pixels of 800 rows
    };
    static constexpr Preset PRESETS[] = {
        {0.0, 1.6144 / DEGREE, 395.0, 0.25, 0.6}, // fisheye-185
        {0.0, 110.0, 395.0, 0.4, 0.9},            // fisheye-220
        {0.0, 72.0, 772.0, 0.35, 0.5},            // wide-120: 60 degrees at the sides, the corners inside the circle
        {0.0, 35.8, 774.0, 0.3, 0.3},             // narrow-60: 30 degrees at the sides
        {20.0, 105.0, 390.0, 0.1, 0.5},           // hyperbolic
        {17.0, 110.0, 390.0, 0.1, 0.7},           // equiangular
    };
    const Preset &p = PRESETS[static_cast<size_t>(preset)];
    const double scale = height / 800.0;
    c_u = 0.5 * width + 3.2 * scale;
    c_v = 0.5 * height - 2.4 * scale;
    theta_min = p.theta_min * DEGREE;
    theta_max = p.theta_max * DEGREE;
    circle_radius = p.circle_radius * scale;
    vignetting = p.vignetting;
    rim_blur_px = p.rim_blur_px;
}

Lens::Lens(const LensSpec &spec)
    : table_(table_of(spec)), theta_min_(spec.theta_min), asymmetry_(spec.asymmetry), profile_(spec.profile)
{
    check_table();
    radius_ = Spline(table_.theta, table_.radius, false);
    pupil_ = Spline(table_.theta, table_.pupil, true);
    check_image();
}

void Lens::check_table() const
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
}

// The radius must increase between the nodes too, and no two directions may fall on one pixel.
void Lens::check_image() const
{
    constexpr int PER_NODE = 16, AROUND = 24;
    for (size_t i = 0; i + 1 < table_.theta.size(); i++) {
        for (int k = 0; k <= PER_NODE; k++) {
            const double theta = table_.theta[i] + k * (table_.theta[i + 1] - table_.theta[i]) / PER_NODE;
            double slope = 0.0;
            radius_(theta, &slope);
            if (!(slope > 0.0)) {
                throw std::invalid_argument("the lens's radius is not increasing between its nodes");
            }
            for (int a = 0; a < AROUND && theta > 0.0; a++) {
                const Image at = image(theta, 2.0 * std::numbers::pi * a / AROUND);
                if (!(at.x_theta * at.y_phi - at.y_theta * at.x_phi > 0.0)) {
                    throw std::invalid_argument("the lens's asymmetry folds the image");
                }
            }
        }
    }
}

double Lens::pupil(double theta) const
{
    return pupil(theta, nullptr);
}

double Lens::pupil(double theta, double *slope) const
{
    if (profile_.f_u > 0.0) {
        if (slope != nullptr) {
            *slope = 2.0 * profile_.pupil_e1 * theta;
        }
        return profile_.pupil_e1 * theta * theta;
    }
    return pupil_(theta, slope);
}

Lens::Image Lens::image(double theta, double phi) const
{
    const double c = std::cos(phi), s = std::sin(phi);
    if (profile_.f_u > 0.0) {
        const Image m = profile_image(profile_, theta, phi);
        const auto u = [&](double x, double y) { return profile_.f_u * x + profile_.skew * y; };
        return {u(m.x, m.y),         profile_.f_v * m.y,    u(m.x_theta, m.y_theta), profile_.f_v * m.y_theta,
                u(m.x_phi, m.y_phi), profile_.f_v * m.y_phi};
    }
    Image p{}; // along and across the direction phi
    p.x = radius_(theta, &p.x_theta);
    double power[4];
    power[0] = theta / theta_max();
    for (int k = 1; k < 4; k++) {
        power[k] = power[k - 1] * power[0];
    }
    for (const LensHarmonic &h : asymmetry_) {
        const double angle = h.harmonic * phi - h.phase, ca = std::cos(angle), sa = std::sin(angle);
        const double a = power[h.harmonic], a_theta = (h.harmonic + 1) * power[h.harmonic - 1] / theta_max();
        p.x += a * h.radial_px * ca;
        p.x_theta += a_theta * h.radial_px * ca;
        p.x_phi -= a * h.radial_px * h.harmonic * sa;
        p.y += a * h.tangential_px * sa;
        p.y_theta += a_theta * h.tangential_px * sa;
        p.y_phi += a * h.tangential_px * h.harmonic * ca;
    }
    return turned(p, c, s);
}

bool Lens::angles(double x, double y, double &theta, double &phi) const
{
    double rx = x, ry = y, r = std::hypot(x, y);
    if (profile_.f_u > 0.0) {
        ry = y / profile_.f_v;
        rx = (x - profile_.skew * ry) / profile_.f_u;
        r = std::hypot(rx, ry) * table_.radius.back() / profile_radius(profile_, theta_max());
    }
    phi = std::atan2(ry, rx);
    // Without the asymmetry; then Newton on both angles. Nothing that the asymmetry reaches from beyond the circle is
    // further out than a tenth of it.
    if (!(r <= 1.1 * circle_radius())) {
        return false;
    }
    const double aim = std::min(r, circle_radius());
    theta = increasing_root(0.0, theta_max(), theta_max() * aim / circle_radius(),
                            [&](double at, double *slope) { return radius_(at, slope) - aim; });
    if (theta > 1e-9) {
        double error = 0.0;
        for (int k = 0; k < 12; k++) {
            const Image at = image(theta, phi);
            const double ex = x - at.x, ey = y - at.y, det = at.x_theta * at.y_phi - at.y_theta * at.x_phi;
            error = std::hypot(ex, ey);
            if (error < 1e-12 * circle_radius()) {
                break;
            }
            theta += (ex * at.y_phi - ey * at.x_phi) / det;
            phi += (ey * at.x_theta - ex * at.y_theta) / det;
        }
        if (!(error < 1e-9)) {
            return false;
        }
    }
    return theta >= theta_min_ && theta <= theta_max();
}

bool Lens::theta_of_point(double rho, double z, double &theta) const
{
    if (!std::isfinite(rho) || !std::isfinite(z)) {
        return false;
    }
    const auto miss = [&](double t, double *slope) { // > 0: the point lies further off the axis than the ray of t
        double de = 0.0;
        const double ahead = z - pupil(t, &de), s = std::sin(t), c = std::cos(t);
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
    return theta >= theta_min_ && rho * std::sin(theta) + (z - pupil(theta)) * std::cos(theta) > 0.0;
}

} // namespace pipefish::sim
