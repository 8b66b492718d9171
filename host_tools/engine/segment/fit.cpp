#include "segment/fit.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <tuple>

namespace pipefish::segment
{

namespace
{

constexpr double kLightSpacing = 16; // of the grid, pixels

Side side_of(const Picture &here, const Picture &there, std::vector<Tie> ties, double scale, const Options &options)
{
    Side side;
    side.here = &here, side.there = &there, side.scale = scale;
    side.ties = std::move(ties);
    cv::Mat_<uint8_t> far(here.size(), uint8_t{255});
    const cv::Rect whole({0, 0}, here.size());
    for (const Tie &t : side.ties) {
        const cv::Point at(static_cast<int>(std::lround(t.at.x())), static_cast<int>(std::lround(t.at.y())));
        if (whole.contains(at))
            far(at) = 0;
    }
    cv::Mat_<float> distance;
    cv::distanceTransform(far, distance, cv::DIST_L2, cv::DIST_MASK_5);
    const cv::Mat_<uint8_t> near(distance <= options.reach);
    const cv::Rect box = cv::boundingRect(near);
    side.reach = near(box).clone();
    side.warp.lattice = Lattice(box, options.spacing);
    side.warp.d = Eigen::VectorXd::Zero(static_cast<Eigen::Index>(2 * side.warp.lattice.points()));
    side.light = Lattice(box, kLightSpacing);
    const auto points = static_cast<Eigen::Index>(side.light.points());
    side.gain.assign(here.channels(), Eigen::VectorXd::Ones(points));
    side.offset.assign(here.channels(), Eigen::VectorXd::Zero(points));
    side.sigma.assign(here.channels(), 0.08); // wide at first: what is a pixel off still pulls
    return side;
}

void add_ties(const Side &side, double weight, Normal &normal)
{
    const double unit = unit_there(side);
    for (const Tie &t : side.ties) {
        const Vector2d e = t.to - side.warp.to(t.at.x(), t.at.y());
        const double w = weight * t.weight * huber_weight(e.norm() / unit) / (unit * unit);
        normal.add(side.warp.lattice.at(t.at.x(), t.at.y()), w * Matrix2d::Identity(), w * e);
    }
}

// The way there and back, as far as this side's field can change it.
void add_round_trips(const Side &side, const Side &other, Normal &normal)
{
    const double here = unit_here(side), there = unit_there(side);
    for (const Tie &t : side.ties) {
        const Vector2d at = t.at, to = side.warp.to(at.x(), at.y());
        const Vector2d e = at - other.warp.to(to.x(), to.y());
        const Matrix2d j = other.warp.slope(to.x(), to.y());
        const double w = kRoundTrip * t.weight * huber_weight(e.norm() / here) / (here * here);
        normal.add(side.warp.lattice.at(at.x(), at.y()), w * j.transpose() * j, w * j.transpose() * e);
    }
    for (const Tie &t : other.ties) {
        const Vector2d at = t.at, to = other.warp.to(at.x(), at.y());
        const Vector2d e = at - side.warp.to(to.x(), to.y());
        const double w = kRoundTrip * t.weight * huber_weight(e.norm() / there) / (there * there);
        normal.add(side.warp.lattice.at(to.x(), to.y()), w * Matrix2d::Identity(), w * e);
    }
}

// Slope of a cubic spline from its coefficients.
Vector2d spline_slope(const Image &image, float x, float y)
{
    const int i = static_cast<int>(x), j = static_cast<int>(y);
    const auto along = [](float t, match::Float4 &w, match::Float4 &d) {
        const float s = 1 - t;
        w = match::Float4{s * s * s / 6, 2.0F / 3 - t * t * (1 - t / 2), 2.0F / 3 - s * s * (1 - s / 2), t * t * t / 6};
        d = match::Float4{-s * s / 2, t * (1.5F * t - 2), -s * (1.5F * s - 2), t * t / 2};
    };
    match::Float4 wx, dx, wy, dy, value = {}, slope = {};
    along(x - static_cast<float>(i), wx, dx);
    along(y - static_cast<float>(j), wy, dy);
    for (int r = 0; r < 4; r++) {
        const match::Float4 row = match::load(image[j - 1 + r] + i - 1);
        value += wy[r] * row, slope += dy[r] * row;
    }
    return {static_cast<double>(match::total(value * dx)), static_cast<double>(match::total(slope * wx))};
}

// Calls body(x, y in the box) for the layer's pixels that can be seen in both pictures.
template <typename Body>
void for_pixels(const Side &side, const Evidence &seen, const LabelImage &labels, int k, const Body &body)
{
    const cv::Rect &box = side.box();
    for (int y = 0; y < box.height; y++)
        for (int x = 0; x < box.width; x++)
            if (labels(box.y + y, box.x + x) == k && seen.possible(y, x))
                body(x, y);
}

void add_pixels(const Side &side, const Evidence &seen, const LabelImage &labels, int k, Normal &normal)
{
    const cv::Rect &box = side.box();
    const size_t channels = side.here->channels();
    std::vector<const Image *> there;
    for (size_t c = 0; c < channels; c++)
        there.push_back(&side.plane_there(c));
    for_pixels(side, seen, labels, k, [&](int x, int y) {
        const double weight = 2.0 * seen.fits(y, x) * seen.informed(y, x);
        if ((x + y) % 2 != 0 || weight < 1e-3) // every other pixel tells enough, and counts for two
            return;
        Matrix2d q = Matrix2d::Zero();
        Vector2d b = Vector2d::Zero();
        for (size_t c = 0; c < channels; c++) {
            const Vector2d slope = light_at(side, c, box.x + x, box.y + y).gain *
                                   spline_slope(*there[c], seen.flow(y, x)[0], seen.flow(y, x)[1]);
            const double w = weight / (side.sigma[c] * side.sigma[c]);
            q += w * slope * slope.transpose();
            b += w * seen.off[c](y, x) * slope;
        }
        normal.add(side.warp.lattice.at(box.x + x, box.y + y), q, b);
    });
}

double side_energy(const Side &side, const Evidence &seen, const Side &other, size_t s, const Given &given,
                   const Options &options)
{
    return data_energy(seen, side.box(), given.k, given.labels[s], given.labels[1 - s], options.lonely) +
           shape_energy(side, options, given.ties) + light_energy(side, options) + round_trip_energy(side, other);
}

// Takes the first of the proposals, made ever more cautious, that does not raise the energy. `propose(share, side,
// seen)` changes the side by a share of the whole step, and what is seen.
template <typename Propose>
bool improve(Layer &layer, size_t s, const Given &given, const Options &options, const Propose &propose)
{
    const Side &other = layer.side[1 - s];
    const double before = side_energy(layer.side[s], layer.seen[s], other, s, given, options);
    for (double share = 1; share > 0.1; share /= 2) {
        Side side = layer.side[s];
        Evidence seen = layer.seen[s];
        propose(share, side, seen);
        if (side_energy(side, seen, other, s, given, options) <= before) {
            layer.side[s] = std::move(side);
            layer.seen[s] = std::move(seen);
            return true;
        }
    }
    return false;
}

// Gain and offset of one channel: least squares over the layer's pixels, held together by their stiffness.
Eigen::VectorXd solve_light(const Side &side, const Evidence &seen, const LabelImage &labels, int k, size_t channel,
                            const std::shared_ptr<const Pattern> &pattern, const Options &options)
{
    const Lattice &l = side.light;
    System system(pattern);
    const Image here = side.plane_here(channel)(side.box());
    const double scale = 1 / (side.sigma[channel] * side.sigma[channel]);
    for_pixels(side, seen, labels, k, [&](int x, int y) {
        const double u = x / l.spacing, v = y / l.spacing;
        const int i = static_cast<int>(u), j = static_cast<int>(v);
        const double a = u - i, b = v - j, w = scale * seen.fits(y, x) * seen.informed(y, x);
        const double share[4] = {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b};
        const double there = seen.warped[channel](y, x), seen_here = here(y, x);
        for (int m = 0; m < 4; m++) {
            const auto p = static_cast<size_t>((j + m / 2) * l.nx + i + m % 2);
            const double own = w * share[m];
            system.right()[static_cast<Eigen::Index>(2 * p)] += own * seen_here * there;
            system.right()[static_cast<Eigen::Index>(2 * p) + 1] += own * seen_here;
            for (int n = m; n < 4; n++) {
                const double both = own * share[n];
                system.add(p, n % 2 - m % 2, n / 2 - m / 2, both * there * there, both * there, both);
            }
        }
    });
    for (size_t p = 0; p < l.points(); p++) {
        system.add(p, 0, 0, 1 / 0.09, 0, 1 / 0.01);
        system.right()[static_cast<Eigen::Index>(2 * p)] += 1 / 0.09;
        const auto columns = static_cast<size_t>(l.nx);
        for (const auto &[q, dx, dy] : {std::tuple(p + 1, 1, 0), std::tuple(p + columns, 0, 1)})
            if (q < l.points() && (dy != 0 || q % columns != 0)) {
                system.add(p, 0, 0, options.light, 0, options.light);
                system.add(q, 0, 0, options.light, 0, options.light);
                system.add(p, dx, dy, -options.light, 0, -options.light);
            }
    }
    return system.solve();
}

} // namespace

Layer layer_of(const Picture (&pictures)[2], const std::vector<Tie> &ties, const Options &options)
{
    std::vector<Tie> back = ties;
    for (Tie &t : back)
        std::swap(t.at, t.to);
    Vector2d centre[2] = {Vector2d::Zero(), Vector2d::Zero()};
    for (const Tie &t : ties)
        centre[0] += t.at, centre[1] += t.to;
    double spread[2] = {1e-9, 1e-9};
    const auto n = static_cast<double>(ties.size());
    for (const Tie &t : ties) {
        spread[0] += (t.at - centre[0] / n).squaredNorm();
        spread[1] += (t.to - centre[1] / n).squaredNorm();
    }
    const double scale = std::sqrt(spread[1] / spread[0]);
    Layer out;
    out.side[0] = side_of(pictures[0], pictures[1], ties, scale, options);
    out.side[1] = side_of(pictures[1], pictures[0], std::move(back), 1 / scale, options);
    for (Side &side : out.side) {
        for (int round = 0; round < 4; round++) {
            Normal normal(side.warp.lattice, side.similar);
            add_ties(side, 1, normal);
            normal.bend(side.warp, options.bend);
            side.warp.d += normal.solve(side.similar);
        }
    }
    for (size_t s = 0; s < 2; s++)
        out.seen[s] = look(out.side[s]);
    return out;
}

double layer_energy(const Layer &layer, const Given &given, const Options &options)
{
    double sum = round_trip_energy(layer.side[0], layer.side[1]);
    for (size_t s = 0; s < 2; s++)
        sum += data_energy(layer.seen[s], layer.side[s].box(), given.k, given.labels[s], given.labels[1 - s],
                           options.lonely) +
               shape_energy(layer.side[s], options, given.ties) + light_energy(layer.side[s], options);
    return sum;
}

void refine_light(Layer &layer, const Given &given, const Options &options)
{
    for (size_t s = 0; s < 2; s++) {
        const Side old = layer.side[s];
        const auto pattern = std::make_shared<const Pattern>(old.light.nx, old.light.ny, 1);
        std::vector<Eigen::VectorXd> gain = old.gain, offset = old.offset;
        for (size_t c = 0; c < gain.size(); c++) {
            const Eigen::VectorXd v = solve_light(old, layer.seen[s], given.labels[s], given.k, c, pattern, options);
            gain[c] = Eigen::Map<const Eigen::VectorXd, 0, Eigen::InnerStride<2>>(v.data(), v.size() / 2);
            offset[c] = Eigen::Map<const Eigen::VectorXd, 0, Eigen::InnerStride<2>>(v.data() + 1, v.size() / 2);
        }
        improve(layer, s, given, options, [&](double share, Side &side, Evidence &seen) {
            for (size_t c = 0; c < gain.size(); c++) {
                side.gain[c] += share * (gain[c] - old.gain[c]);
                side.offset[c] += share * (offset[c] - old.offset[c]);
            }
            look_relit(side, seen);
        });
    }
}

void refine_warp(Layer &layer, const Given &given, const Options &options, int steps)
{
    for (size_t s = 0; s < 2; s++) {
        for (int step = 0; step < steps; step++) {
            const Side old = layer.side[s];
            Normal normal(old.warp.lattice, old.similar);
            add_pixels(old, layer.seen[s], given.labels[s], given.k, normal);
            add_ties(old, given.ties, normal);
            add_round_trips(old, layer.side[1 - s], normal);
            normal.bend(old.warp, options.bend);
            const Eigen::VectorXd change = normal.solve(layer.side[s].similar);
            const Warp moved{old.warp.lattice, change};
            double most = 0; // where the layer is: what is far from it may swing
            for (const Tie &t : old.ties)
                most = std::max(most, (moved.to(t.at.x(), t.at.y()) - t.at).norm());
            const double limit = 2 * unit_there(old);
            const double whole = most > limit ? limit / most : 1;
            const bool better = improve(layer, s, given, options, [&](double share, Side &side, Evidence &seen) {
                side.warp.d += share * whole * change;
                seen = look(side);
            });
            if (!better || most < 0.02)
                break;
        }
    }
}

void refine_sigma(Layer &layer, const Given &given, const Options &options)
{
    for (size_t s = 0; s < 2; s++) {
        const Side old = layer.side[s];
        std::vector<double> sum(old.sigma.size(), 0);
        double weight = 0;
        for_pixels(old, layer.seen[s], given.labels[s], given.k, [&](int x, int y) {
            const double w = layer.seen[s].fits(y, x) * layer.seen[s].informed(y, x);
            weight += w;
            for (size_t c = 0; c < sum.size(); c++) {
                const double r = layer.seen[s].off[c](y, x);
                sum[c] += w * r * r;
            }
        });
        if (weight < 10)
            continue;
        improve(layer, s, given, options, [&](double share, Side &side, Evidence &seen) {
            for (size_t c = 0; c < sum.size(); c++) {
                const double best = std::clamp(std::sqrt(sum[c] / weight), kLeastNoise, 0.15);
                side.sigma[c] *= std::pow(best / old.sigma[c], share);
            }
            look_likely(side, seen);
        });
    }
}

} // namespace pipefish::segment
