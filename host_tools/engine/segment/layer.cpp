#include "segment/layer.hpp"

#include <algorithm>
#include <array>
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
constexpr double kMatched = 1;    // what each match of a layer speaks for its being there, nats
constexpr int kWindow = 7;        // of variance and correlation, pixels
constexpr double kHalfLog2Pi = 0.91893853320467274;

double square(double v)
{
    return v * v;
}

cv::Point nearest(const Vector2d &at)
{
    return {static_cast<int>(std::lround(at.x())), static_cast<int>(std::lround(at.y()))};
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

// Planes of the other picture, where valid.
void bring(const Side &side, const cv::Mat_<uint8_t> &valid, Evidence &out)
{
    const cv::Size size = side.box().size();
    for (size_t c = 0; c < side.here->channels(); c++) {
        Image warped(size, 0.0F);
        const Image &there = side.plane_there(c);
        for (int y = 0; y < size.height; y++)
            for (int x = 0; x < size.width; x += 4) {
                const int count = std::min(4, size.width - x);
                match::Float4 u = match::counted(0) * 0 + 1, v = u;
                bool any = false;
                for (int k = 0; k < count; k++)
                    if (valid(y, x + k)) {
                        u[k] = out.flow(y, x + k)[0], v[k] = out.flow(y, x + k)[1];
                        any = true;
                    }
                if (!any)
                    continue;
                const match::Float4 w = match::spline(there, u, v);
                for (int k = 0; k < count; k++)
                    if (valid(y, x + k))
                        warped(y, x + k) = w[k];
            }
        out.warped.push_back(warped);
    }
}

// Gain and offset of a channel along a row of the box.
void light_along(const Side &side, size_t channel, int y, float *gain, float *offset)
{
    const Lattice &l = side.light;
    const auto h = static_cast<int>(l.spacing);
    const double b = static_cast<double>(y % h) / h;
    const Eigen::Index row = static_cast<Eigen::Index>(y / h) * l.nx;
    const auto along = [&](const Eigen::VectorXd &f, float *to) {
        for (int i = 0; i * h < l.box.width; i++) {
            const Eigen::Index p = row + i, q = p + l.nx;
            const auto left = static_cast<float>((1 - b) * f[p] + b * f[q]);
            const auto right = static_cast<float>((1 - b) * f[p + 1] + b * f[q + 1]);
            const float step = (right - left) / static_cast<float>(h);
            for (int x = i * h, k = 0; k < h && x < l.box.width; k++, x++)
                to[x] = left + static_cast<float>(k) * step;
        }
    };
    along(side.gain[channel], gain);
    along(side.offset[channel], offset);
}

// Sums over windows around the pixels of a picture, row by row: of its weight, of two greys, of their squares and of
// their product.
class Windows
{
public:
    explicit Windows(int width) : width_(width), line_(static_cast<size_t>(width + kWindow - 1), 0.0F)
    {
        for (auto &row : ring_)
            for (auto &sums : row)
                sums.assign(static_cast<size_t>(width), 0.0F);
        for (auto &sums : total_)
            sums.assign(static_cast<size_t>(width), 0.0F);
    }

    // The next row; nothing for one below the last. The rows' sums are then of the windows around kWindow / 2 rows up.
    void push(const float *weight, const float *one, const float *two)
    {
        auto &row = ring_[next_++ % kWindow];
        const auto put = [&](std::vector<float> &sums, const auto &value) {
            for (int x = 0; x < width_; x++)
                line_[static_cast<size_t>(x + kWindow / 2)] = value(x);
            const float *from = line_.data();
            for (int x = 0; x < width_; x++)
                sums[static_cast<size_t>(x)] = ((from[x] + from[x + 1]) + (from[x + 2] + from[x + 3])) +
                                               ((from[x + 4] + from[x + 5]) + from[x + 6]);
        };
        put(row[0], [&](int x) { return weight[x]; });
        put(row[1], [&](int x) { return one[x]; });
        put(row[2], [&](int x) { return two[x]; });
        put(row[3], [&](int x) { return one[x] * one[x]; });
        put(row[4], [&](int x) { return two[x] * two[x]; });
        put(row[5], [&](int x) { return one[x] * two[x]; });
        for (size_t k = 0; k < total_.size(); k++)
            for (size_t x = 0; x < total_[k].size(); x++) {
                const auto at = [&](size_t r) { return ring_[(next_ + r) % kWindow][k][x]; }; // the oldest first
                total_[k][x] = ((at(0) + at(1)) + (at(2) + at(3))) + ((at(4) + at(5)) + at(6));
            }
    }

    // Of the windows' valid parts: how much texture either grey has, and their correlation.
    void correlate(float *informed, float *zncc) const
    {
        static_assert(kWindow == 7);
        const auto level = static_cast<float>(square(square(kTexture)));
        const auto &[count, a, b, aa, bb, ab] = total_;
        for (size_t x = 0; x < count.size(); x++) {
            const float n = 1 / std::max(1.0F, count[x]), ma = n * a[x], mb = n * b[x];
            const float va = std::max(0.0F, n * aa[x] - ma * ma), vb = std::max(0.0F, n * bb[x] - mb * mb);
            const float cov = n * ab[x] - ma * mb, more = std::max(va, vb), most = more * more;
            informed[x] = most / (most + level);
            zncc[x] = std::min(1.0F, std::max(-1.0F, cov / std::sqrt(va * vb + 1e-10F)));
        }
    }

private:
    using Row = std::array<std::vector<float>, 6>;
    int width_;
    size_t next_ = 0;
    std::array<Row, kWindow> ring_; // of the last rows, sums along them
    Row total_;
    std::vector<float> line_; // zeros on either side
};

// A match speaks for its pixel, as far as the layer carries it where the match says; of several there the best one.
void count_matches(const Side &side, const cv::Mat_<cv::Vec2f> &flow, cv::Mat_<int32_t> &cost)
{
    cv::Mat_<int32_t> said(cost.size(), 0);
    for (const Tie &tie : side.ties) {
        const cv::Point at = nearest(tie.at) - side.box().tl();
        if (!cv::Rect({0, 0}, cost.size()).contains(at) || cost(at) >= Problem::kNever)
            continue;
        const Vector2d to(static_cast<double>(flow(at)[0]), static_cast<double>(flow(at)[1]));
        const double off = (to - tie.to).norm() / unit_there(side);
        said(at) =
            std::max(said(at), static_cast<int32_t>(std::lround(kUnit * kMatched * tie.weight / (1 + square(off)))));
    }
    cost -= said;
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
    const cv::Mat_<uint8_t> valid = carry(side, out);
    bring(side, valid, out);
    out.cost = cv::Mat_<int32_t>(side.box().size(), Problem::kNever);
    out.cost.setTo(0, valid);
    look_relit(side, out);
    return out;
}

void look_relit(const Side &side, Evidence &seen)
{
    const cv::Size size = side.box().size();
    const size_t channels = side.here->channels(), width = static_cast<size_t>(size.width);
    seen.off.assign(channels, Image());
    for (Image &off : seen.off)
        off = Image(size);
    seen.informed = Image(size);
    seen.zncc = Image(size);
    std::vector<Image> here;
    for (size_t c = 0; c < channels; c++)
        here.push_back(side.plane_here(c)(side.box()));
    std::vector<float> gain(width), offset(width), valid(width), one(width), two(width);
    Windows windows(size.width);
    for (int y = 0; y < size.height + kWindow / 2; y++) {
        for (std::vector<float> *row : {&valid, &one, &two})
            std::fill(row->begin(), row->end(), 0.0F);
        if (y < size.height) {
            for (int x = 0; x < size.width; x++)
                valid[static_cast<size_t>(x)] = seen.possible(y, x) ? 1.0F : 0.0F;
            for (size_t c = 0; c < channels; c++) {
                light_along(side, c, y, gain.data(), offset.data());
                const float *from = here[c][y], *warped = seen.warped[c][y];
                float *off = seen.off[c][y];
                const auto grey = static_cast<float>(side.here->grey(c));
                for (size_t x = 0; x < width; x++) {
                    const float lit = gain[x] * warped[x] + offset[x];
                    off[x] = valid[x] * (from[x] - lit);
                    one[x] += grey * valid[x] * from[x];
                    two[x] += grey * valid[x] * lit;
                }
            }
        }
        windows.push(valid.data(), one.data(), two.data());
        if (const int row = y - kWindow / 2; row >= 0)
            windows.correlate(seen.informed[row], seen.zncc[row]);
    }
    look_likely(side, seen);
}

void look_likely(const Side &side, Evidence &seen)
{
    const cv::Size size = side.box().size();
    const Image rarity = side.here->rarity()(side.box());
    double constant = std::log(1 - kHidden);
    std::vector<float> scale;
    for (const double sigma : side.sigma) {
        constant -= std::log(sigma) + kHalfLog2Pi;
        scale.push_back(static_cast<float>(1 / (2 * square(sigma))));
    }
    Image fits(size, 0.0F);
    cv::Mat_<int32_t> cost(size, Problem::kNever);
    constexpr auto hidden = static_cast<float>(kHidden);
    for (int y = 0; y < size.height; y++)
        for (int x = 0; x < size.width; x++) {
            if (!seen.possible(y, x))
                continue;
            float sum = static_cast<float>(constant) + rarity(y, x);
            for (size_t c = 0; c < scale.size(); c++)
                sum -= scale[c] * seen.off[c](y, x) * seen.off[c](y, x);
            const float ratio = std::exp(std::min(50.0F, sum));
            fits(y, x) = ratio / (ratio + hidden);
            const float unlike = static_cast<float>(kDissimilar) * (1 - seen.zncc(y, x)) / 2;
            const float nats = seen.informed(y, x) * (unlike - std::log(ratio + hidden)) + static_cast<float>(kGround);
            cost(y, x) = static_cast<int32_t>(std::lround(static_cast<float>(kUnit) * nats));
        }
    count_matches(side, seen.flow, cost);
    seen.fits = fits;
    seen.cost = cost;
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
    double sum = options.bend * bending(side.warp);
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
