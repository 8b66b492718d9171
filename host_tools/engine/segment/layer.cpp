#include "segment/layer.hpp"

#include <opencv2/imgproc.hpp>

#include <cmath>
#include <limits>

namespace pipefish::segment
{

namespace
{

constexpr double kHidden = 0.05;  // share of a layer's pixels that are hidden or shine in one picture
constexpr double kTexture = 0.02; // deviation within a window from which texture tells motions apart, of 1
constexpr double kDissimilar = 1; // cost of a correlation of -1, nats
constexpr double kGround = 0.03;  // cost of a layer's pixel where nothing speaks for it, nats
constexpr int kWindow = 7;        // of variance and correlation, pixels
constexpr double kHalfLog2Pi = 0.91893853320467274;

double square(double v)
{
    return v * v;
}

// Where the other picture has each pixel, and whether that is a place at all.
cv::Mat_<uint8_t> carry(const Side &side, Evidence &out)
{
    const cv::Rect &box = side.box();
    const cv::Size there = side.there->size();
    const double least = 0.1 * side.scale * side.scale;
    out.flow.create(box.size());
    cv::Mat_<uint8_t> valid(box.size(), uint8_t{0});
    const Lattice &lattice = side.warp.lattice;
    std::vector<Lattice::Spot> column;
    for (int x = 0; x < box.width; x++)
        column.push_back(lattice.at(box.x + x, box.y));
    std::vector<Vector2d> row(static_cast<size_t>(lattice.nx)); // of the field along a row of pixels
    for (int y = 0; y < box.height; y++) {
        const Lattice::Spot across = lattice.at(box.x, box.y + y);
        for (size_t i = 0; i < row.size(); i++) {
            row[i].setZero();
            for (size_t j = 0; j < 4; j++)
                row[i] += across.wy[j] * side.warp.d.segment<2>(static_cast<Eigen::Index>(
                                             2 * (across.first + j * static_cast<size_t>(lattice.nx) + i)));
        }
        for (int x = 0; x < box.width; x++) {
            if (!side.reach(y, x))
                continue;
            const Lattice::Spot &along = column[static_cast<size_t>(x)];
            Vector2d to(box.x + x, box.y + y);
            for (size_t i = 0; i < 4; i++)
                to += along.wx[i] * row[along.first + i];
            out.flow(y, x) = {static_cast<float>(to.x()), static_cast<float>(to.y())};
            valid(y, x) = to.x() >= 1 && to.y() >= 1 && to.x() < there.width - 2.01 && to.y() < there.height - 2.01;
        }
    }
    for (int y = 0; y + 1 < box.height; y++)
        for (int x = 0; x + 1 < box.width; x++)
            if (side.reach(y, x) && side.reach(y, x + 1) && side.reach(y + 1, x)) {
                const cv::Vec2f a = out.flow(y, x + 1) - out.flow(y, x), b = out.flow(y + 1, x) - out.flow(y, x);
                if (static_cast<double>(a[0] * b[1] - a[1] * b[0]) < least) {
                    out.folds++;
                    valid(y, x) = 0;
                }
            }
    return valid;
}

// Sums over windows around each pixel.
Image summed(const Image &image)
{
    Image out;
    cv::boxFilter(image, out, CV_32F, {kWindow, kWindow}, {-1, -1}, false, cv::BORDER_CONSTANT);
    return out;
}

// Correlation of the grey pictures, and how much texture either has, from sums over the valid part of windows.
void correlate(const Image &mask, const Image &one, const Image &two, Evidence &out)
{
    const Image count = summed(mask), a = summed(one), b = summed(two), aa = summed(Image(one.mul(one))),
                bb = summed(Image(two.mul(two))), ab = summed(Image(one.mul(two)));
    out.zncc.create(mask.size());
    out.informed.create(mask.size());
    const double level = square(square(kTexture));
    for (int y = 0; y < mask.rows; y++)
        for (int x = 0; x < mask.cols; x++) {
            const double n = std::max(1.0F, count(y, x)), ma = a(y, x) / n, mb = b(y, x) / n;
            const double va = std::max(0.0, aa(y, x) / n - ma * ma), vb = std::max(0.0, bb(y, x) / n - mb * mb);
            const double cov = ab(y, x) / n - ma * mb, most = square(std::max(va, vb));
            out.informed(y, x) = static_cast<float>(most / (most + level));
            out.zncc(y, x) = static_cast<float>(std::clamp(cov / std::sqrt(va * vb + 1e-10), -1.0, 1.0));
        }
}

} // namespace

Light light_at(const Side &side, size_t channel, int x, int y)
{
    const Lattice &l = side.light;
    const double u = (x - l.box.x) / l.spacing, v = (y - l.box.y) / l.spacing;
    const int i = static_cast<int>(u), j = static_cast<int>(v);
    const double a = u - i, b = v - j;
    const Eigen::Index p = static_cast<Eigen::Index>(j) * l.nx + i, q = p + l.nx;
    const auto mix = [&](const Eigen::VectorXd &f) {
        return (1 - b) * ((1 - a) * f[p] + a * f[p + 1]) + b * ((1 - a) * f[q] + a * f[q + 1]);
    };
    return {mix(side.gain[channel]), mix(side.offset[channel])};
}

Evidence look(const Side &side)
{
    Evidence out;
    const cv::Rect &box = side.box();
    const cv::Mat_<uint8_t> valid = carry(side, out);
    const size_t channels = side.here->channels();
    Image mask(box.size(), 0.0F), one(box.size(), 0.0F), two(box.size(), 0.0F), log_ratio(box.size(), 0.0F);
    const Image rarity = side.here->rarity()(box);
    double constant = std::log(1 - kHidden);
    for (size_t c = 0; c < channels; c++) {
        constant -= std::log(side.sigma[c]) + kHalfLog2Pi;
        out.warped.emplace_back(box.size(), std::numeric_limits<float>::quiet_NaN());
        const Image here = side.plane_here(c)(box), &there = side.plane_there(c);
        const double grey = side.here->grey(c), scale = 1 / (2 * square(side.sigma[c]));
        for (int y = 0; y < box.height; y++)
            for (int x = 0; x < box.width; x++) {
                if (!valid(y, x))
                    continue;
                const float w = match::spline(there, out.flow(y, x)[0], out.flow(y, x)[1]);
                out.warped[c](y, x) = w;
                const Light light = light_at(side, c, box.x + x, box.y + y);
                const double lit = light.gain * w + light.offset;
                mask(y, x) = 1;
                one(y, x) += static_cast<float>(grey * here(y, x));
                two(y, x) += static_cast<float>(grey * lit);
                log_ratio(y, x) -= static_cast<float>(scale * square(here(y, x) - lit));
            }
    }
    correlate(mask, one, two, out);
    out.fits.create(box.size());
    out.cost = cv::Mat_<int32_t>(box.size(), Problem::kNever);
    for (int y = 0; y < box.height; y++)
        for (int x = 0; x < box.width; x++) {
            if (!valid(y, x))
                continue;
            const double ratio = std::exp(std::min(50.0, log_ratio(y, x) + constant + rarity(y, x)));
            out.fits(y, x) = static_cast<float>(ratio / (ratio + kHidden));
            const double t = out.informed(y, x);
            const double nats = t * (-std::log(ratio + kHidden) + kDissimilar * (1 - out.zncc(y, x)) / 2) + kGround;
            out.cost(y, x) = static_cast<int32_t>(std::lround(kUnit * nats));
        }
    return out;
}

double data_energy(const Evidence &seen, const cv::Rect &box, int k, const LabelImage &here, const LabelImage &there,
                   double lonely)
{
    int64_t sum = 0, alone = 0;
    for (int y = 0; y < box.height; y++)
        for (int x = 0; x < box.width; x++) {
            if (here(box.y + y, box.x + x) != k)
                continue;
            sum += seen.cost(y, x);
            if (seen.cost(y, x) < Problem::kNever) {
                const cv::Vec2f to = seen.flow(y, x);
                alone += there(static_cast<int>(std::lround(to[1])), static_cast<int>(std::lround(to[0]))) != k;
            }
        }
    return static_cast<double>(sum) / kUnit + lonely * static_cast<double>(alone);
}

double huber(double distance)
{
    return distance <= 1 ? distance * distance / 2 : distance - 0.5;
}

double huber_weight(double distance)
{
    return distance <= 1 ? 1 : 1 / distance;
}

double shape_energy(const Side &side, const Options &options, double ties)
{
    const Eigen::SparseMatrix<double> k = bending(side.warp.lattice);
    const Eigen::Map<const Eigen::Matrix<double, 2, Eigen::Dynamic>> d(side.warp.d.data(), 2, side.warp.d.size() / 2);
    double sum = 0;
    for (Eigen::Index c = 0; c < 2; c++) {
        const Eigen::VectorXd v = d.row(c).transpose();
        sum += options.bend / 2 * v.dot(k * v);
    }
    for (const Tie &t : side.ties)
        sum += ties * t.weight * huber((side.warp.to(t.at.x(), t.at.y()) - t.to).norm() / unit_there(side));
    return sum;
}

double light_energy(const Side &side, const Options &options)
{
    double sum = 0;
    const Eigen::Index nx = side.light.nx;
    for (size_t c = 0; c < side.gain.size(); c++) {
        const Eigen::VectorXd &g = side.gain[c], &o = side.offset[c];
        for (Eigen::Index p = 0; p < g.size(); p++) {
            sum += (square((g[p] - 1) / 0.3) + square(o[p] / 0.1)) / 2;
            for (const Eigen::Index q : {p + 1, p + nx})
                if (q < g.size() && (q != p + 1 || q % nx != 0))
                    sum += options.light / 2 * (square(g[p] - g[q]) + square(o[p] - o[q]));
        }
    }
    return sum;
}

double round_trip_energy(const Side &one, const Side &other)
{
    double sum = 0;
    for (const auto &[a, b] : {std::pair(&one, &other), std::pair(&other, &one)})
        for (const Tie &t : a->ties) {
            const Vector2d to = a->warp.to(t.at.x(), t.at.y());
            sum += kRoundTrip * t.weight * huber((b->warp.to(to.x(), to.y()) - t.at).norm() / unit_here(*a));
        }
    return sum;
}

double tie_energy(const Layer &layer, const Tie &tie, double ties)
{
    double sum = 0;
    for (size_t s = 0; s < 2; s++) {
        const Side &one = layer.side[s], &other = layer.side[1 - s];
        const Vector2d &from = s == 0 ? tie.at : tie.to, &target = s == 0 ? tie.to : tie.at;
        const cv::Point at(static_cast<int>(std::lround(from.x())), static_cast<int>(std::lround(from.y())));
        if (!one.box().contains(at) || !one.reach(at - one.box().tl()))
            return std::numeric_limits<double>::infinity();
        const Vector2d to = one.warp.to(from.x(), from.y());
        sum += ties * tie.weight * huber((to - target).norm() / unit_there(one)) +
               kRoundTrip * tie.weight * huber((other.warp.to(to.x(), to.y()) - from).norm() / unit_here(one));
    }
    return sum;
}

} // namespace pipefish::segment
