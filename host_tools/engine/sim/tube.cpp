#include "sim/tube.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sim
{

double Section::radius(double phi) const
{
    const double c = std::cos(phi - clock) / a, s = std::sin(phi - clock) / b;
    return 1 / std::sqrt(c * c + s * s);
}

namespace
{

// The direction at clock angle phi across the tangent.
Vec3 spoke(const Frame &f, double phi)
{
    return std::cos(phi) * f.up + std::sin(phi) * f.right;
}

// Turned about the bend's centre by the angle whose cosine and sine are given.
Frame turned(const Frame &f, const Vec3 &inward, double radius, double cosine, double sine)
{
    const Vec3 tangent = cosine * f.tangent + sine * inward;
    const Vec3 shift = cosine * inward - sine * f.tangent - inward; // of a vector along `inward`
    return {f.centre + radius * ((1 - cosine) * inward + sine * f.tangent), tangent, f.up + f.up.dot(inward) * shift,
            f.right + f.right.dot(inward) * shift};
}

Frame advance(const Frame &f, const Piece &piece, double s)
{
    if (piece.angle == 0)
        return {f.centre + s * f.tangent, f.tangent, f.up, f.right};
    return turned(f, spoke(f, piece.clock), piece.radius, std::cos(s / piece.radius), std::sin(s / piece.radius));
}

double smooth_step(double x)
{
    x = std::clamp(x, 0.0, 1.0);
    return x * x * (3 - 2 * x);
}

} // namespace

Tube::Tube(double diameter, std::vector<Piece> pieces, std::vector<OvalStretch> ovals)
    : radius_(diameter / 2), pieces_(std::move(pieces)), ovals_(std::move(ovals))
{
    start_.push_back(0);
    frames_.push_back({Vec3::Zero(), Vec3::UnitZ(), -Vec3::UnitY(), Vec3::UnitX()});
    for (Piece &piece : pieces_) {
        if (piece.angle != 0)
            piece.length = piece.angle * piece.radius;
        inward_.push_back(spoke(frames_.back(), piece.clock));
        frames_.push_back(advance(frames_.back(), piece, piece.length));
        start_.push_back(start_.back() + piece.length);
    }
    inward_.push_back(Vec3::Zero());
    changes_ = start_;
    for (const OvalStretch &oval : ovals_) {
        changes_.push_back(oval.start);
        changes_.push_back(oval.end);
    }
    std::sort(changes_.begin(), changes_.end());
}

Frame Tube::frame(double s) const
{
    const auto after = std::upper_bound(start_.begin(), start_.end(), s);
    const auto i = static_cast<size_t>(after - start_.begin());
    if (i == 0)
        return advance(frames_.front(), Piece{}, s);
    if (i == start_.size())
        return advance(frames_.back(), Piece{}, s - start_.back());
    return advance(frames_[i - 1], pieces_[i - 1], s - start_[i - 1]);
}

Section Tube::section(double s) const
{
    for (const OvalStretch &o : ovals_) {
        if (s <= o.start || s >= o.end)
            continue;
        const double ramp = std::max(o.ramp, 1e-9);
        const double half = 0.5 * o.ovality * smooth_step((s - o.start) / ramp) * smooth_step((o.end - s) / ramp);
        return {radius_ * (1 + half), radius_ * (1 - half), o.clock};
    }
    return {radius_, radius_, 0};
}

// The foot on a piece is in closed form; a foot beyond a piece's end belongs to its neighbour.
Tube::Local Tube::local(const Vec3 &point, int hint) const
{
    static const Piece straight;
    const int count = static_cast<int>(pieces_.size());
    int i = std::clamp(hint, 0, count);
    for (int tries = 0, last = 0;; tries++) {
        const auto k = static_cast<size_t>(i);
        const Frame &f = frames_[k];
        const Vec3 d = point - f.centre;
        const bool beyond = i == count; // the straight extrapolation after the end
        const Piece &piece = beyond ? straight : pieces_[k];
        double s = d.dot(f.tangent);
        const double from_centre = piece.radius - d.dot(inward_[k]), along = s;
        if (piece.angle != 0)
            s = piece.radius * std::atan2(along, from_centre);
        const int step = !beyond && s > piece.length ? 1 : s < 0 && i > 0 ? -1 : 0;
        if (step == 0 || step == -last || tries > count) { // settled, or on the kink between two pieces
            Local at;
            at.s = start_[k] + s;
            at.piece = i;
            at.bent = piece.angle != 0;
            if (at.bent) {
                const double distance = std::sqrt(along * along + from_centre * from_centre);
                at.frame = turned(f, inward_[k], piece.radius, from_centre / distance, along / distance);
            } else {
                at.frame = {f.centre + s * f.tangent, f.tangent, f.up, f.right};
            }
            at.section = section(at.s);
            const Vec3 across = point - at.frame.centre;
            at.up = across.dot(at.frame.up);
            at.right = across.dot(at.frame.right);
            return at;
        }
        last = step;
        i += step;
    }
}

TubePoint Tube::locate(const Vec3 &point, int hint) const
{
    const Local at = local(point, hint);
    return {at.s, std::hypot(at.up, at.right), std::atan2(at.right, at.up), at.piece};
}

Vec3 Tube::wall(double s, double phi) const
{
    const Frame f = frame(s);
    return f.centre + section(s).radius(phi) * spoke(f, phi);
}

// How far along the ray the wall stays one straight cylinder.
double Tube::straight_ahead(const Local &at, const Vec3 &direction) const
{
    if (at.bent || at.section.a != at.section.b)
        return 0;
    const double rate = at.frame.tangent.dot(direction);
    const auto next = std::upper_bound(changes_.begin(), changes_.end(), at.s);
    if (rate > 0)
        return next == changes_.end() ? HUGE_VAL : (*next - at.s) / rate;
    return next == changes_.begin() ? HUGE_VAL : (*std::prev(next) - at.s) / std::min(rate, -1e-12);
}

namespace
{

// Coordinates in which the cross-section is the unit circle.
struct Unit {
    double x, y;
};

Unit to_unit(const Section &section, double up, double right)
{
    if (section.a == section.b)
        return {up / section.a, right / section.a};
    const double c = std::cos(section.clock), s = std::sin(section.clock);
    return {(c * up + s * right) / section.a, (c * right - s * up) / section.b};
}

} // namespace

// Newton's method with the straight cylinder of the local section about the local tangent in place of a line: one step
// in a straight run of one section. Where the wall changes, steps are bounded so that it is not jumped over; once the
// ray is beyond it, bisection guards the bracket.
std::optional<Hit> Tube::cast(const Vec3 &origin, const Vec3 &direction, double max_distance, int hint) const
{
    constexpr double kClose = 1e-9;
    Local at = local(origin, hint);
    double t = 0, low = 0, high = HUGE_VAL;
    for (int i = 0;; i++) {
        const Unit p = to_unit(at.section, at.up, at.right);
        const double room = 1 - p.x * p.x - p.y * p.y; // > 0 inside
        const double gap = 0.5 * radius_ * room;       // at the wall, metres but for the ellipse's stretch
        if (i == 0 && !(room > 0))
            return std::nullopt;
        if (std::abs(gap) <= kClose || high - low < 1e-12)
            break;
        (room > 0 ? low : high) = t;
        const Unit v = to_unit(at.section, direction.dot(at.frame.up), direction.dot(at.frame.right));
        const double vv = v.x * v.x + v.y * v.y, b = p.x * v.x + p.y * v.y, root = b * b + vv * room;
        double next = root >= 0 && b + std::sqrt(root) > 1e-12 ? t + room / (b + std::sqrt(root)) : HUGE_VAL;
        if (high == HUGE_VAL)
            next = std::min(next, t + std::max(0.15 * radius_ + 2 * gap, straight_ahead(at, direction)));
        else if (!(next > low && next < high) || i > 30)
            next = 0.5 * (low + high);
        t = next;
        if (t > max_distance)
            return std::nullopt;
        at = local(origin + t * direction, at.piece);
    }
    // Gradient of the ellipse; the wall's slope along s (below 1 %) does not matter to the light.
    const Section &section = at.section;
    const double c = std::cos(section.clock), n = std::sin(section.clock);
    const Unit u = to_unit(section, at.up, at.right);
    const double x = u.x / section.a, y = u.y / section.b;
    const bool round = section.a == section.b;
    const double up = round ? x : c * x - n * y, right = round ? y : n * x + c * y;
    const double size = std::hypot(up, right);
    Hit hit;
    hit.distance = t;
    hit.point = origin + t * direction;
    hit.at = {at.s, std::hypot(at.up, at.right), std::atan2(at.right, at.up), at.piece};
    hit.normal = -(up / size * at.frame.up + right / size * at.frame.right);
    return hit;
}

} // namespace pipefish::sim
