#include "sim/wall.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>

namespace pipefish::sim
{

namespace
{

constexpr double PI = std::numbers::pi, TWO_PI = 2.0 * PI;

// Quintic step 6x^5 - 15x^4 + 10x^3; |step'| <= 15/8, |step''| <= 10/sqrt(3).
constexpr double STEP_SLOPE = 15.0 / 8.0, STEP_CURVATURE = 5.7736;

double quintic(double x, double &slope)
{
    slope = 30.0 * x * x * (x - 1.0) * (x - 1.0);
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0);
}

// Rises from 0 at `start` to 1 over `ramp`, and falls again before `end`.
double window(double s, double start, double end, double ramp, double &slope)
{
    slope = 0.0;
    if (s <= start || s >= end) {
        return 0.0;
    }
    if (s < start + ramp) {
        const double w = quintic((s - start) / ramp, slope);
        slope /= ramp;
        return w;
    }
    if (s > end - ramp) {
        const double w = quintic((end - s) / ramp, slope);
        slope /= -ramp;
        return w;
    }
    return 1.0;
}

std::string place(const char *list, size_t index, const char *key)
{
    return std::string(list) + "[" + std::to_string(index) + "]" + key;
}

void check_stretch(double start, double end, double ramp, const std::string &where)
{
    if (!(start + 2.0 * ramp <= end)) {
        throw SpecError(where + ": must be at least two ramps behind start");
    }
}

// The smallest turn from `to` to `phi`, in [-pi, pi].
double turn_between(double phi, double to)
{
    const double turn = phi - to; // of at most a turn, as nearly always
    if (std::abs(turn) <= PI) {
        return turn;
    }
    return std::abs(turn) <= TWO_PI ? turn - std::copysign(TWO_PI, turn) : std::remainder(turn, TWO_PI);
}

class EggRelief : public Relief
{
public:
    EggRelief(const EggStretch &spec, double radius) : spec_(spec), radius_(radius)
    {
        from = spec.start;
        to = spec.end;
    }

    void add(double s, double phi, Height &sum) const override
    {
        double slope = 0.0;
        const double w = window(s, spec_.start, spec_.end, spec_.ramp, slope), a = spec_.share * radius_;
        double by_phi = 0.0;
        const double e = shape(turn_between(phi, spec_.clock), by_phi);
        sum.h += a * w * e;
        sum.by_s += a * slope * e;
        sum.by_phi += a * w * by_phi;
    }

    HeightBounds bounds(double s_from, double s_to) const override
    {
        // Of shape(): 0..1, first derivative up to 1.5805, second up to 10.98 (both where sides and invert meet).
        constexpr double SLOPE = 1.581, CURVATURE = 11.0;
        const bool even = s_from >= from + spec_.ramp && s_to <= to - spec_.ramp;
        const double a = spec_.share * radius_, b = even ? 0.0 : a / spec_.ramp;
        return {0.0,          a, b * STEP_SLOPE, a * SLOPE, b * STEP_CURVATURE / spec_.ramp, b * STEP_SLOPE * SLOPE,
                a * CURVATURE};
    }

    std::vector<double> cuts() const override { return {from, from + spec_.ramp, to - spec_.ramp, to}; }

private:
    EggStretch spec_;
    double radius_;

    // Excess of the egg's radius about the crown's centre over the crown's, which is 1: zero on the crown's half; the
    // sides are circles of 3 about (-+2, 0), the invert one of 1/2 about 1.5 below. `x`: clock from the narrow end.
    static double shape(double x, double &slope)
    {
        slope = 0.0;
        const double down = std::cos(x), across = std::sin(std::abs(x)), sign = x < 0.0 ? -1.0 : 1.0;
        if (down <= 0.0) {
            return 0.0;
        }
        // Along the direction u, a circle of radius a about c is at u.c + sqrt(a^2 - c^2 + (u.c)^2).
        const bool invert = across * 1.8 < down * 0.4; // they meet at (0.4, 1.8)
        const double uc = invert ? 1.5 * down : -2.0 * across, by_x = invert ? -1.5 * across : -2.0 * down;
        const double root = std::sqrt((invert ? -2.0 : 5.0) + uc * uc);
        slope = sign * by_x * (1.0 + uc / root);
        return uc + root - 1.0;
    }
};

class CorrugationRelief : public Relief
{
public:
    explicit CorrugationRelief(const Corrugation &spec) : spec_(spec)
    {
        from = spec.start;
        to = spec.end;
    }

    void add(double s, double, Height &sum) const override
    {
        double slope = 0.0;
        const double w = window(s, spec_.start, spec_.end, spec_.ramp, slope), k = TWO_PI / spec_.wavelength;
        const double c = std::cos(k * (s - spec_.start)), si = std::sin(k * (s - spec_.start));
        sum.h += spec_.amplitude * w * c;
        sum.by_s += spec_.amplitude * (slope * c - w * k * si);
    }

    HeightBounds bounds(double s_from, double s_to) const override
    {
        const bool even = s_from >= from + spec_.ramp && s_to <= to - spec_.ramp;
        const double a = spec_.amplitude, k = TWO_PI / spec_.wavelength, r = even ? 0.0 : 1.0 / spec_.ramp;
        return {-a,  a,  a * (STEP_SLOPE * r + k), 0.0, a * (STEP_CURVATURE * r * r + 2.0 * STEP_SLOPE * r * k + k * k),
                0.0, 0.0};
    }

    std::vector<double> cuts() const override { return {from, from + spec_.ramp, to - spec_.ramp, to}; }

private:
    Corrugation spec_;
};

class DepositRelief : public Relief
{
public:
    DepositRelief(const Deposit &spec, int index, double radius) : spec_(spec)
    {
        from = spec.s - 0.5 * spec.length;
        to = spec.s + 0.5 * spec.length;
        deposit = index;
        around_ = std::max(4, static_cast<int>(std::lround(TWO_PI * radius / spec.grain)));
    }

    void add(double s, double phi, Height &sum) const override { add_mound(s, phi, false, sum); }

    // All grains at their highest.
    void add_cover(double s, double phi, Height &sum) const override { add_mound(s, phi, true, sum); }
    double cover_depth() const override { return 2.0 * spec_.roughness; }
    HeightBounds cover_bounds(double, double) const override
    {
        return bounds_with({0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0}, spec_.height + spec_.roughness);
    }

    double outside(double phi) const override
    {
        return std::max(0.0, std::abs(turn_between(phi, spec_.clock)) - 0.5 * spec_.extent);
    }

    HeightBounds bounds(double, double) const override
    {
        // Of the grains: values in -1..1 at the corners, blended by quintics.
        const double a = spec_.roughness, g = 1.0 / spec_.grain, q = around_ / TWO_PI;
        return bounds_with({0.0, 0.0, 2.0 * a * STEP_SLOPE * g, 2.0 * a * STEP_SLOPE * q,
                            2.0 * a * STEP_CURVATURE * g * g, 4.0 * a * STEP_SLOPE * STEP_SLOPE * g * q,
                            2.0 * a * STEP_CURVATURE * q * q},
                           spec_.height + a);
    }

private:
    Deposit spec_;
    int around_; // grains on a turn

    void add_mound(double s, double phi, bool cover, Height &sum) const
    {
        const double x = (s - spec_.s) * 2.0 / spec_.length;
        const double y = turn_between(phi, spec_.clock) * 2.0 / spec_.extent;
        if (std::abs(x) >= 1.0 || std::abs(y) >= 1.0) {
            return;
        }
        const double ax = 1.0 - x * x, ay = 1.0 - y * y, bx = ax * ax * ax, by = ay * ay * ay;
        const double dx = -12.0 * x * ax * ax / spec_.length, dy = -12.0 * y * ay * ay / spec_.extent;
        Height n{spec_.height + (cover ? spec_.roughness : 0.0), 0.0, 0.0};
        if (spec_.roughness > 0.0 && !cover) {
            grains(s, phi, n);
        }
        sum.h -= n.h * bx * by;
        sum.by_s -= n.by_s * bx * by + n.h * dx * by;
        sum.by_phi -= n.by_phi * bx * by + n.h * bx * dy;
    }

    // The mound's share of a height up to `top` with the grains' derivatives `n`.
    HeightBounds bounds_with(const HeightBounds &n, double top) const
    {
        // Of (1 - x^2)^3: slope up to 1.7174 (x^2 = 1/5), curvature up to 6 (x = 0).
        const double slope_s = 1.7174 * 2.0 / spec_.length, slope_p = 1.7174 * 2.0 / spec_.extent;
        const double curve_s = 24.0 / (spec_.length * spec_.length), curve_p = 24.0 / (spec_.extent * spec_.extent);
        HeightBounds b;
        b.least = -top;
        b.most = std::max(0.0, spec_.roughness - spec_.height);
        b.by_s = n.by_s + top * slope_s;
        b.by_phi = n.by_phi + top * slope_p;
        b.by_ss = n.by_ss + 2.0 * n.by_s * slope_s + top * curve_s;
        b.by_phiphi = n.by_phiphi + 2.0 * n.by_phi * slope_p + top * curve_p;
        b.by_sphi = n.by_sphi + n.by_s * slope_p + n.by_phi * slope_s + top * slope_s * slope_p;
        return b;
    }

    double corner(int64_t i, int64_t j) const
    {
        return 2.0 * uniform_of(hash64(spec_.seed, STREAM_GRAIN, static_cast<uint64_t>(i),
                                       static_cast<uint64_t>(j % around_))) -
               1.0;
    }

    void grains(double s, double phi, Height &n) const
    {
        const double u = s / spec_.grain, v = phi * around_ / TWO_PI, iu = std::floor(u), iv = std::floor(v);
        const int64_t i = static_cast<int64_t>(iu), j = static_cast<int64_t>(iv);
        const double a = corner(i, j), b = corner(i + 1, j), c = corner(i, j + 1), d = corner(i + 1, j + 1);
        double slope_u = 0.0, slope_v = 0.0;
        const double fu = quintic(u - iu, slope_u), fv = quintic(v - iv, slope_v);
        const double low = a + (b - a) * fu, high = c + (d - c) * fu;
        n.h += spec_.roughness * (low + (high - low) * fv);
        n.by_s += spec_.roughness * ((b - a) + ((d - c) - (b - a)) * fv) * slope_u / spec_.grain;
        n.by_phi += spec_.roughness * (high - low) * slope_v * around_ / TWO_PI;
    }
};

class GridRelief : public Relief
{
public:
    GridRelief(const WallGrid &spec, double radius)
        : spec_(spec), rows_(static_cast<int>(spec.radius.size()) / spec.around), radius_(radius)
    {
        from = -std::numeric_limits<double>::infinity();
        to = -from;
    }

    void add(double s, double phi, Height &sum) const override
    {
        const double end = rows_ - 1.0, u = std::clamp((s - spec_.start) / spec_.step, 0.0, end);
        const double v = phi * spec_.around / TWO_PI, iu = std::min(std::floor(u), end - 1.0), iv = std::floor(v);
        const Weights wu(u - iu), wv(v - iv);
        const int i = static_cast<int>(iu), j = static_cast<int>(iv);
        double value = 0.0, by_u = 0.0, by_v = 0.0;
        for (int a = 0; a < 4; a++) {
            double row = 0.0, slope = 0.0;
            for (int b = 0; b < 4; b++) {
                const double r = at(i + a - 1, j + b - 1);
                row += wv.value[static_cast<size_t>(b)] * r;
                slope += wv.slope[static_cast<size_t>(b)] * r;
            }
            value += wu.value[static_cast<size_t>(a)] * row;
            by_u += wu.slope[static_cast<size_t>(a)] * row;
            by_v += wu.value[static_cast<size_t>(a)] * slope;
        }
        const bool inside = s > spec_.start && s < spec_.start + end * spec_.step;
        sum.h += value - radius_;
        sum.by_s += inside ? by_u / spec_.step : 0.0;
        sum.by_phi += by_v * spec_.around / TWO_PI;
    }

    HeightBounds bounds(double s_from, double s_to) const override
    {
        const double end = rows_ - 1.0;
        const int first = static_cast<int>(std::clamp(std::floor((s_from - spec_.start) / spec_.step), 0.0, end - 1.0));
        const int last = static_cast<int>(std::clamp(std::ceil((s_to - spec_.start) / spec_.step), 1.0, end));
        // Of a cubic between p1 and p2: its slope is within that of its Bezier legs, its curvature that of its ends.
        double least = at(first, 0), most = least, du = 0.0, duu = 0.0, dv = 0.0, dvv = 0.0;
        const auto cubic = [](double p0, double p1, double p2, double p3, double &d, double &dd) {
            const double m1 = 0.5 * (p2 - p0), m2 = 0.5 * (p3 - p1);
            d = std::max({d, std::abs(m1), std::abs(m2), std::abs(3.0 * (p2 - p1) - m1 - m2)});
            dd = std::max(
                {dd, std::abs(2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3), std::abs(-p0 + 4.0 * p1 - 5.0 * p2 + 2.0 * p3)});
        };
        for (int i = first - 1; i <= last + 1; i++) {
            for (int j = 0; j < spec_.around; j++) {
                least = std::min(least, at(i, j));
                most = std::max(most, at(i, j));
                cubic(at(i - 1, j), at(i, j), at(i + 1, j), at(i + 2, j), du, duu);
                cubic(at(i, j - 1), at(i, j), at(i, j + 1), at(i, j + 2), dv, dvv);
            }
        }
        // The weights' absolute values sum up to 1.25 at most (twice: 1.5625), their slopes' to 3, with sum zero.
        const double over = 0.28125 * (most - least), u = 1.0 / spec_.step, v = spec_.around / TWO_PI;
        return {least - over - radius_, most + over - radius_,   1.25 * du * u,     1.25 * dv * v,
                1.25 * duu * u * u,     3.0 * 1.25 * du * u * v, 1.25 * dvv * v * v};
    }

    std::vector<double> cuts() const override
    {
        std::vector<double> out;
        const int stride = std::max(8, static_cast<int>(radius_ / spec_.step));
        for (int i = 0; i < rows_ - 1; i += stride) {
            out.push_back(spec_.start + i * spec_.step);
        }
        out.push_back(spec_.start + (rows_ - 1) * spec_.step);
        return out;
    }

private:
    struct Weights { // of cubic convolution, Keys's a = -1/2
        std::array<double, 4> value, slope;
        explicit Weights(double x)
            : value{-0.5 * x + x * x - 0.5 * x * x * x, 1.0 - 2.5 * x * x + 1.5 * x * x * x,
                    0.5 * x + 2.0 * x * x - 1.5 * x * x * x, -0.5 * x * x + 0.5 * x * x * x},
              slope{-0.5 + 2.0 * x - 1.5 * x * x, -5.0 * x + 4.5 * x * x, 0.5 + 4.0 * x - 4.5 * x * x, -x + 1.5 * x * x}
        {
        }
    };
    WallGrid spec_;
    int rows_;
    double radius_;

    // The radius in a row and column that may lie outside. A row beyond an end mirrors the one inside it, so that the
    // slope is zero where the end row goes on.
    double at(int row, int column) const
    {
        const int n = spec_.around, last = rows_ - 1;
        row = std::clamp(row < 0 ? -row : row > last ? 2 * last - row : row, 0, last);
        return spec_.radius[static_cast<size_t>(row * n + (column % n + n) % n)];
    }
};

} // namespace

void HeightBounds::add(const HeightBounds &b)
{
    least += b.least;
    most += b.most;
    by_s += b.by_s;
    by_phi += b.by_phi;
    by_ss += b.by_ss;
    by_sphi += b.by_sphi;
    by_phiphi += b.by_phiphi;
}

std::vector<std::unique_ptr<Relief>> make_reliefs(const FeatureSpec &spec, double radius)
{
    std::vector<std::unique_ptr<Relief>> out;
    for (size_t i = 0; i < spec.eggs.size(); i++) {
        check_stretch(spec.eggs[i].start, spec.eggs[i].end, spec.eggs[i].ramp, place("eggs", i, ".end"));
        out.push_back(std::make_unique<EggRelief>(spec.eggs[i], radius));
    }
    for (size_t i = 0; i < spec.corrugations.size(); i++) {
        const Corrugation &c = spec.corrugations[i];
        check_stretch(c.start, c.end, c.ramp, place("corrugations", i, ".end"));
        out.push_back(std::make_unique<CorrugationRelief>(c));
    }
    for (size_t i = 0; i < spec.deposits.size(); i++) {
        out.push_back(std::make_unique<DepositRelief>(spec.deposits[i], static_cast<int>(i), radius));
    }
    const WallGrid &grid = spec.grid;
    if (grid.around > 0) {
        const size_t n = static_cast<size_t>(grid.around);
        if (grid.radius.size() % n != 0 || grid.radius.size() / n < 2) {
            throw SpecError("grid.radius: needs two rows or more of " + std::to_string(grid.around) + " values");
        }
        out.push_back(std::make_unique<GridRelief>(grid, radius));
    }
    return out;
}

std::vector<JointSpec> all_joints(const FeatureSpec &spec, double radius, double length)
{
    std::vector<JointSpec> out = spec.joints;
    const JointSeries &series = spec.joint_series;
    if (series.spacing > 0.0 && series.spacing < 4.0 * (series.gap + radius * 0.1)) {
        throw SpecError("joint_series.spacing: must be at least four gaps and 0.4 radii");
    }
    for (int k = 0; series.spacing > 0.0 && series.start + k * series.spacing < length; k++) {
        const auto random = [&](uint64_t what, double sigma) {
            return sigma *
                   std::clamp(normal(series.seed, STREAM_JOINT, 4 * static_cast<uint64_t>(k) + what), -2.0, 2.0);
        };
        JointSpec joint;
        joint.s = series.start + k * series.spacing;
        joint.gap = series.gap;
        joint.depth = series.depth;
        joint.step_right = random(0, series.step_sigma);
        joint.step_down = random(1, series.step_sigma);
        joint.yaw = random(2, series.angle_sigma);
        joint.pitch = random(3, series.angle_sigma);
        out.push_back(joint);
    }
    std::sort(out.begin(), out.end(), [](const JointSpec &a, const JointSpec &b) { return a.s < b.s; });
    for (size_t i = 0; i < out.size(); i++) {
        const std::string where = "joints at " + std::to_string(out[i].s) + " m";
        if (!(out[i].s > 0.0 && out[i].s + out[i].gap < length)) {
            throw SpecError(where + ": must lie within the pipe");
        }
        if (i + 1 < out.size() && !(out[i].s + out[i].gap + 0.1 * radius <= out[i + 1].s)) {
            throw SpecError(where + ": the next joint is too close");
        }
        if (std::hypot(out[i].step_right, out[i].step_down) > 0.3 * radius) {
            throw SpecError(where + ": a step must be at most 0.3 radii");
        }
        const double angle = std::hypot(out[i].yaw, out[i].pitch);
        if (out[i].gap > 0.0 && out[i].gap < std::tan(angle) * (1.1 * radius + out[i].depth)) {
            throw SpecError(where + ": the gap must be wide enough for the angle, tan(angle) (1.1 radii + depth)");
        }
    }
    return out;
}

CrackPath::CrackPath(const Crack &spec, double radius)
    : radius_(radius), half_width_(0.5 * spec.width), depth_(spec.depth)
{
    uint64_t count = 0;
    for (size_t i = 0; i + 1 < spec.path.size(); i++) {
        const PathPoint &a = spec.path[i], &b = spec.path[i + 1];
        const double ds = b.s - a.s, dp = (b.phi - a.phi) * radius, length = std::hypot(ds, dp);
        const int pieces = spec.meander > 0.0 ? std::clamp(static_cast<int>(length / spec.grain), 1, 200) : 1;
        path_.push_back(a);
        for (int k = 1; k < pieces; k++) {
            const double x = static_cast<double>(k) / pieces;
            const double aside = spec.meander * (2.0 * uniform_of(hash64(spec.seed, STREAM_CRACK, count++)) - 1.0);
            path_.push_back({a.s + x * ds - aside * dp / length, a.phi + (x * dp + aside * ds / length) / radius});
        }
    }
    path_.push_back(spec.path.back());
    all_ = {path_[0].s, path_[0].s, path_[0].phi, path_[0].phi};
    for (size_t i = 0; i + 1 < path_.size(); i++) {
        if (i % GROUP == 0) {
            boxes_.push_back({path_[i].s, path_[i].s, path_[i].phi, path_[i].phi});
        }
        for (Box *box : {&boxes_.back(), &all_}) {
            box->s_low = std::min(box->s_low, path_[i + 1].s);
            box->s_high = std::max(box->s_high, path_[i + 1].s);
            box->phi_low = std::min(box->phi_low, path_[i + 1].phi);
            box->phi_high = std::max(box->phi_high, path_[i + 1].phi);
        }
    }
}

double CrackPath::distance(double s, double phi, double reach, double *by_s, double *by_arc) const
{
    double best = std::numeric_limits<double>::infinity();
    if (s < all_.s_low - reach || s > all_.s_high + reach) {
        return best;
    }
    const double margin = reach / radius_;
    for (double turn = phi + TWO_PI * std::ceil((all_.phi_low - margin - phi) / TWO_PI); turn <= all_.phi_high + margin;
         turn += TWO_PI) {
        for (size_t first = 0; first + 1 < path_.size(); first += GROUP) {
            const Box &box = boxes_[first / GROUP];
            const double out_s = std::max({box.s_low - s, s - box.s_high, 0.0});
            const double out_p = std::max({box.phi_low - turn, turn - box.phi_high, 0.0}) * radius_;
            const double nearest = std::min(best, reach);
            if (out_s * out_s + out_p * out_p > nearest * nearest) {
                continue;
            }
            for (size_t i = first; i < std::min(first + GROUP, path_.size() - 1); i++) {
                const PathPoint &a = path_[i], &b = path_[i + 1];
                const double bs = b.s - a.s, bp = (b.phi - a.phi) * radius_;
                const double ps = s - a.s, pp = (turn - a.phi) * radius_;
                const double x = std::clamp((ps * bs + pp * bp) / (bs * bs + bp * bp), 0.0, 1.0);
                const double es = ps - x * bs, ep = pp - x * bp, d = std::hypot(es, ep);
                if (d < best) {
                    best = d;
                    if (by_s != nullptr && d > 0.0) {
                        *by_s = es / d;
                        *by_arc = ep / d;
                    }
                }
            }
        }
    }
    return best > reach ? std::numeric_limits<double>::infinity() : best;
}

} // namespace pipefish::sim
