#include "segment/fit.hpp"

#include <Eigen/SparseCholesky>
#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <array>
#include <cmath>

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

// Value and slope of a cubic spline from its coefficients.
struct Sample {
    double value, dx, dy;
};

Sample spline_with_slope(const Image &image, float x, float y)
{
    const int i = static_cast<int>(x), j = static_cast<int>(y);
    const auto along = [](double t, double(&w)[4], double(&d)[4]) {
        const double s = 1 - t;
        w[0] = s * s * s / 6, w[1] = 2.0 / 3 - t * t * (1 - t / 2), w[2] = 2.0 / 3 - s * s * (1 - s / 2);
        w[3] = t * t * t / 6;
        d[0] = -s * s / 2, d[1] = t * (1.5 * t - 2), d[2] = -s * (1.5 * s - 2), d[3] = t * t / 2;
    };
    double wx[4], dx[4], wy[4], dy[4];
    along(static_cast<double>(x) - i, wx, dx);
    along(static_cast<double>(y) - j, wy, dy);
    Sample out{0, 0, 0};
    for (int r = 0; r < 4; r++) {
        const float *row = image[j - 1 + r] + i - 1;
        double value = 0, slope = 0;
        for (int c = 0; c < 4; c++)
            value += wx[c] * row[c], slope += dx[c] * row[c];
        out.value += wy[r] * value, out.dx += wy[r] * slope, out.dy += dy[r] * value;
    }
    return out;
}

// Calls body(x, y in the box) for the layer's pixels that can be seen in both pictures.
template <typename Body>
void for_pixels(const Side &side, const Evidence &seen, const LabelImage &labels, int k, const Body &body)
{
    const cv::Rect &box = side.box();
    for (int y = 0; y < box.height; y++)
        for (int x = 0; x < box.width; x++)
            if (labels(box.y + y, box.x + x) == k && seen.cost(y, x) < Problem::kNever)
                body(x, y);
}

void add_pixels(const Side &side, const Evidence &seen, const LabelImage &labels, int k, Normal &normal)
{
    const cv::Rect &box = side.box();
    const size_t channels = side.here->channels();
    std::vector<Image> here;
    std::vector<const Image *> there;
    for (size_t c = 0; c < channels; c++) {
        here.push_back(side.plane_here(c)(box));
        there.push_back(&side.plane_there(c));
    }
    for_pixels(side, seen, labels, k, [&](int x, int y) {
        const double weight = 2.0 * seen.fits(y, x) * seen.informed(y, x);
        if ((x + y) % 2 != 0 || weight < 1e-3) // every other pixel tells enough, and counts for two
            return;
        Matrix2d q = Matrix2d::Zero();
        Vector2d b = Vector2d::Zero();
        for (size_t c = 0; c < channels; c++) {
            const Sample s = spline_with_slope(*there[c], seen.flow(y, x)[0], seen.flow(y, x)[1]);
            const Light light = light_at(side, c, box.x + x, box.y + y);
            const Vector2d slope = light.gain * Vector2d(s.dx, s.dy);
            const double w = weight / (side.sigma[c] * side.sigma[c]);
            q += w * slope * slope.transpose();
            b += w * (here[c](y, x) - light.gain * s.value - light.offset) * slope;
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

// Takes the first of the proposals, made ever more cautious, that does not raise the energy. `propose(share)` gives
// the side changed by a share of the whole step.
template <typename Propose>
bool improve(Layer &layer, size_t s, const Given &given, const Options &options, const Propose &propose)
{
    const Side &other = layer.side[1 - s];
    const double before = side_energy(layer.side[s], layer.seen[s], other, s, given, options);
    for (double share = 1; share > 0.1; share /= 2) {
        Side side = propose(share);
        Evidence seen = look(side);
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
                            const Options &options)
{
    using Block = Eigen::Matrix<double, 8, 8>;
    using Right = Eigen::Matrix<double, 8, 1>;
    const Lattice &l = side.light;
    const auto points = static_cast<Eigen::Index>(l.points());
    std::vector<Block> block(l.points(), Block::Zero());
    std::vector<Right> right(l.points(), Right::Zero());
    const Image here = side.plane_here(channel)(side.box());
    const double scale = 1 / (side.sigma[channel] * side.sigma[channel]);
    for_pixels(side, seen, labels, k, [&](int x, int y) {
        const double u = x / l.spacing, v = y / l.spacing;
        const int i = static_cast<int>(u), j = static_cast<int>(v);
        const double a = u - i, b = v - j, w = scale * seen.fits(y, x) * seen.informed(y, x);
        const double share[4] = {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b};
        Right row;
        for (int c = 0; c < 4; c++)
            row[2 * c] = share[c] * seen.warped[channel](y, x), row[2 * c + 1] = share[c];
        const auto cell = static_cast<size_t>(j * l.nx + i);
        block[cell].noalias() += w * row * row.transpose();
        right[cell] += w * here(y, x) * row;
    });
    std::vector<Eigen::Triplet<double>> entries;
    Eigen::VectorXd b = Eigen::VectorXd::Zero(2 * points);
    for (Eigen::Index p = 0; p < points; p++) {
        const Eigen::Index corner[4] = {p, p + 1, p + l.nx, p + l.nx + 1};
        for (Eigen::Index m = 0; m < 8; m++) {
            const Eigen::Index row = 2 * corner[m / 2] + m % 2;
            if (right[static_cast<size_t>(p)].isZero(0) && block[static_cast<size_t>(p)].isZero(0))
                continue;
            b[row] += right[static_cast<size_t>(p)][m];
            for (Eigen::Index n = 0; n < 8; n++)
                entries.emplace_back(row, 2 * corner[n / 2] + n % 2, block[static_cast<size_t>(p)](m, n));
        }
        entries.emplace_back(2 * p, 2 * p, 1 / 0.09);
        entries.emplace_back(2 * p + 1, 2 * p + 1, 1 / 0.01);
        b[2 * p] += 1 / 0.09;
        for (const Eigen::Index q : {p + 1, p + l.nx})
            if (q < points && (q != p + 1 || q % l.nx != 0))
                for (const Eigen::Index c : {0, 1}) {
                    entries.emplace_back(2 * p + c, 2 * p + c, options.light);
                    entries.emplace_back(2 * q + c, 2 * q + c, options.light);
                    entries.emplace_back(2 * p + c, 2 * q + c, -options.light);
                    entries.emplace_back(2 * q + c, 2 * p + c, -options.light);
                }
    }
    Eigen::SparseMatrix<double> matrix(2 * points, 2 * points);
    matrix.setFromTriplets(entries.begin(), entries.end());
    return Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>(matrix).solve(b);
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
        const Eigen::SparseMatrix<double> k = bending(side.warp.lattice);
        for (int round = 0; round < 4; round++) {
            Normal normal(side.warp.lattice);
            add_ties(side, 1, normal);
            normal.bend(k, options.bend, side.warp.d);
            side.warp.d += normal.solve();
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
        std::vector<Eigen::VectorXd> gain = old.gain, offset = old.offset;
        for (size_t c = 0; c < gain.size(); c++) {
            const Eigen::VectorXd v = solve_light(old, layer.seen[s], given.labels[s], given.k, c, options);
            gain[c] = Eigen::Map<const Eigen::VectorXd, 0, Eigen::InnerStride<2>>(v.data(), v.size() / 2);
            offset[c] = Eigen::Map<const Eigen::VectorXd, 0, Eigen::InnerStride<2>>(v.data() + 1, v.size() / 2);
        }
        improve(layer, s, given, options, [&](double share) {
            Side side = old;
            for (size_t c = 0; c < gain.size(); c++) {
                side.gain[c] += share * (gain[c] - old.gain[c]);
                side.offset[c] += share * (offset[c] - old.offset[c]);
            }
            return side;
        });
    }
}

void refine_warp(Layer &layer, const Given &given, const Options &options, int steps)
{
    for (size_t s = 0; s < 2; s++) {
        const Eigen::SparseMatrix<double> k = bending(layer.side[s].warp.lattice);
        for (int step = 0; step < steps; step++) {
            const Side old = layer.side[s];
            Normal normal(old.warp.lattice);
            add_pixels(old, layer.seen[s], given.labels[s], given.k, normal);
            add_ties(old, given.ties, normal);
            add_round_trips(old, layer.side[1 - s], normal);
            normal.bend(k, options.bend, old.warp.d);
            const Eigen::VectorXd change = normal.solve();
            const Warp moved{old.warp.lattice, change};
            double most = 0; // where the layer is: what is far from it may swing
            for (const Tie &t : old.ties)
                most = std::max(most, (moved.to(t.at.x(), t.at.y()) - t.at).norm());
            const double limit = 2 * unit_there(old);
            const double whole = most > limit ? limit / most : 1;
            const bool better = improve(layer, s, given, options, [&](double share) {
                Side side = old;
                side.warp.d += share * whole * change;
                return side;
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
                const Light light = light_at(old, c, old.box().x + x, old.box().y + y);
                const double r = old.plane_here(c)(old.box().y + y, old.box().x + x) -
                                 light.gain * layer.seen[s].warped[c](y, x) - light.offset;
                sum[c] += w * r * r;
            }
        });
        if (weight < 10)
            continue;
        improve(layer, s, given, options, [&](double share) {
            Side side = old;
            for (size_t c = 0; c < sum.size(); c++) {
                const double best = std::clamp(std::sqrt(sum[c] / weight), kLeastNoise, 0.15);
                side.sigma[c] *= std::pow(best / old.sigma[c], share);
            }
            return side;
        });
    }
}

} // namespace pipefish::segment
