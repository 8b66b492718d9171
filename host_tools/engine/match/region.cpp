#include "match/region.hpp"

#include "match/detect.hpp"
#include "match/moments.hpp"
#include "match/vec.hpp"
#include "parallel.hpp"

#include <Eigen/LU>
#include <opencv2/core.hpp>
#include <opencv2/core/hal/hal.hpp>

#include <algorithm>
#include <cmath>
#include <numbers>

namespace pipefish::match
{

namespace
{

constexpr double kLarger = 3; // the described region against the detected one
constexpr int kHalf = 20;     // normalised patches are 41 x 41
constexpr int kSide = 2 * kHalf + 1;

constexpr int kAdaptHalf = 9;

// exp(-i^2 / 2 sigma^2), -half <= i <= half
template <size_t Size> std::array<double, Size> gaussian(double sigma)
{
    std::array<double, Size> out = {};
    for (size_t i = 0; i < Size; i++) {
        const double t = (static_cast<double>(i) - static_cast<double>(Size / 2)) / sigma;
        out[i] = std::exp(-0.5 * t * t);
    }
    return out;
}
const auto kAdaptWindow = gaussian<2 * kAdaptHalf + 1>(4.5);
const auto kTurnWindow = gaussian<kSide>(8);
const auto kDescribeWindow = gaussian<kSide>(kHalf);

// With a rim of one sample; rows in whole Float4s.
using Normalised = std::array<std::array<float, (kSide + 2 + 3) / 4 * 4>, kSide + 2>;

// at + shape * v for v in [-1, 1]^2 (and a rim), from the level whose blur suits the spacing.
void normalise(const ScaleStack &stack, const Region &region, int half, Normalised &out)
{
    const Eigen::Matrix2d a = region.shape / half;
    const Image &image = stack.for_step(std::sqrt(std::abs(a.determinant())));
    for (int j = -half - 1; j <= half + 1; j++) {
        const Eigen::Vector2f start = (region.at + a.col(1) * j).cast<float>(), along = a.col(0).cast<float>();
        float *row = out[static_cast<size_t>(j + half + 1)].data();
        for (int i = 0; i < 2 * half + 3; i += 4) {
            const Float4 t = counted(i - half - 1);
            store(row + i, bilinear(image, start.x() + along.x() * t, start.y() + along.y() * t));
        }
    }
}

bool within(const ScaleStack &stack, const Region &region)
{
    return inside(stack.image(), region.at.cast<float>(), region.shape.cast<float>(), 1.0F);
}

// Lindeberg's and Mikolajczyk's iteration: the shape in which the gradient's second moments are round. False when it
// does not settle, or on a shape longer than 6 times its width.
bool adapt_shape(const ScaleStack &stack, Region &region)
{
    const double det = region.shape.determinant();
    Normalised p;
    for (int step = 0; step < 12; step++) {
        if (!within(stack, region))
            return false;
        normalise(stack, region, kAdaptHalf, p);
        Eigen::Matrix2d m = Eigen::Matrix2d::Zero();
        for (int j = -kAdaptHalf; j <= kAdaptHalf; j++)
            for (int i = -kAdaptHalf; i <= kAdaptHalf; i++) {
                const auto at = [&](int di, int dj) {
                    return static_cast<double>(
                        p[static_cast<size_t>(j + dj + kAdaptHalf + 1)][static_cast<size_t>(i + di + kAdaptHalf + 1)]);
                };
                const Eigen::Vector2d g(at(1, 0) - at(-1, 0), at(0, 1) - at(0, -1));
                const double w = kAdaptWindow[static_cast<size_t>(i + kAdaptHalf)] *
                                 kAdaptWindow[static_cast<size_t>(j + kAdaptHalf)];
                m += w * g * g.transpose();
            }
        if (!(m.determinant() > 1e-6 * m.trace() * m.trace()))
            return false;
        if (0.95 * aspect(m) < 1)
            return true;
        Eigen::Matrix2d u = region.shape * root(m).inverse();
        u *= std::sqrt(det / std::abs(u.determinant()));
        region.shape = root(u * u.transpose());
        if (aspect(region.shape) > 6)
            return false;
    }
    return false;
}

// Of a normalised patch without its rim, row by row: length and direction (degrees) of the gradient.
struct Gradients {
    std::array<float, kSide * kSide> size, turn;

    explicit Gradients(const Normalised &p)
    {
        std::array<float, kSide * kSide> x, y;
        for (size_t j = 1, k = 0; j <= kSide; j++)
            for (size_t i = 1; i <= kSide; i++, k++) {
                x[k] = p[j][i + 1] - p[j][i - 1];
                y[k] = p[j + 1][i] - p[j - 1][i];
            }
        cv::hal::magnitude32f(x.data(), y.data(), size.data(), kSide * kSide);
        cv::hal::fastAtan32f(y.data(), x.data(), turn.data(), kSide * kSide, true);
    }
};

// At most two directions of the gradient in the normalised patch.
std::vector<double> orientations(const Normalised &p)
{
    constexpr int bins = 36;
    std::array<double, bins> raw = {}, h = {};
    const Gradients g(p);
    for (size_t j = 0, k = 0; j < kSide; j++)
        for (size_t i = 0; i < kSide; i++, k++) {
            const auto at = static_cast<size_t>(g.turn[k] * (bins / 360.0F));
            raw[at % bins] += kTurnWindow[i] * kTurnWindow[j] * static_cast<double>(g.size[k]);
        }
    for (size_t k = 0; k < bins; k++)
        h[k] = 6 * raw[k] + 4 * (raw[(k + 1) % bins] + raw[(k + bins - 1) % bins]) + raw[(k + 2) % bins] +
               raw[(k + bins - 2) % bins];
    const double most = *std::max_element(h.begin(), h.end());
    std::vector<std::pair<double, double>> found;
    for (size_t k = 0; k < bins; k++) {
        const double left = h[(k + bins - 1) % bins], right = h[(k + 1) % bins];
        if (h[k] >= 0.8 * most && h[k] > left && h[k] >= right) {
            const double peak = static_cast<double>(k) + 0.5 + vertex(left, h[k], right);
            found.emplace_back(-h[k], peak * 2 * std::numbers::pi / bins);
        }
    }
    std::sort(found.begin(), found.end());
    std::vector<double> out;
    for (size_t k = 0; k < std::min<size_t>(found.size(), 2); k++)
        out.push_back(found[k].second);
    return out;
}

// Where a column or row of the patch lies among the 4 histograms: between the `first` and the next, counted from one
// before them, the next one's share being `part`.
struct Place {
    size_t first;
    float part;
};
constexpr auto kPlaces = [] {
    std::array<Place, kSide> out = {};
    for (size_t i = 0; i < kSide; i++) {
        const float at = (static_cast<float>(i) - kHalf) * (4.0F / kSide) + 2.5F;
        out[i] = {static_cast<size_t>(at), at - static_cast<float>(static_cast<size_t>(at))};
    }
    return out;
}();

// Lowe's histograms: 4 x 4 places, 8 directions, each sample shared between neighbours; root of the L1-normalised.
Eigen::Matrix<float, kDescriptor, 1> descriptor(const Normalised &p)
{
    float sums[6][6][9] = {}; // with a place beside the first and the last, and the first direction again
    const Gradients g(p);
    for (size_t j = 0, k = 0; j < kSide; j++)
        for (size_t i = 0; i < kSide; i++, k++) {
            const float turn = g.turn[k] * (8 / 360.0F);
            const auto t = static_cast<size_t>(turn);
            const float ft = turn - static_cast<float>(t);
            const float w = g.size[k] * static_cast<float>(kDescribeWindow[i] * kDescribeWindow[j]);
            const Place x = kPlaces[i], y = kPlaces[j];
            const float low = w * (1 - y.part), high = w * y.part;
            const float share[4] = {low * (1 - x.part), low * x.part, high * (1 - x.part), high * x.part};
            for (size_t c = 0; c < 4; c++) {
                float *bin = &sums[y.first + c / 2][x.first + c % 2][t % 8];
                bin[0] += share[c] * (1 - ft);
                bin[1] += share[c] * ft;
            }
        }
    Eigen::Matrix<float, kDescriptor, 1> out;
    for (int k = 0; k < kDescriptor; k++) {
        const float *bin = sums[k / 32 + 1][k / 8 % 4 + 1];
        out(k) = bin[k % 8] + (k % 8 ? 0 : bin[8]);
    }
    for (int pass = 0; pass < 2; pass++) {
        out /= std::max(out.norm(), 1e-12F);
        out = pass ? out : Eigen::Matrix<float, kDescriptor, 1>(out.cwiseMin(0.2F));
    }
    return (out / std::max(out.sum(), 1e-12F)).cwiseSqrt();
}

} // namespace

Described describe_regions(const ScaleStack &stack, const RegionOptions &options)
{
    const std::vector<Region> found = detect(stack, options);
    struct Made {
        std::vector<Region> regions;
        std::vector<Eigen::Matrix<float, kDescriptor, 1>> descriptors;
    };
    std::vector<Made> made(found.size());
    parallel_for(static_cast<int>(found.size()), options.threads, [&](int k) {
        Made &out = made[static_cast<size_t>(k)];
        Region region = found[static_cast<size_t>(k)];
        region.shape *= kLarger;
        const bool round = std::abs(region.shape(0, 1)) < 1e-12;
        std::vector<Region> shapes = {region};
        if (options.adapt && round && adapt_shape(stack, region) && aspect(region.shape) > 1.2)
            shapes.push_back(region);
        Normalised p;
        for (const Region &shape : shapes) {
            if (!within(stack, shape))
                continue;
            normalise(stack, shape, kHalf, p);
            for (const double turn : orientations(p)) {
                Eigen::Matrix2d r;
                r << std::cos(turn), -std::sin(turn), std::sin(turn), std::cos(turn);
                const Region turned = {shape.at, shape.shape * r};
                normalise(stack, turned, kHalf, p);
                out.regions.push_back(turned);
                out.descriptors.push_back(descriptor(p));
            }
        }
    });
    Described all;
    size_t count = 0;
    for (const Made &m : made)
        count += m.regions.size();
    all.descriptors.resize(kDescriptor, static_cast<Eigen::Index>(count));
    for (const Made &m : made)
        for (size_t k = 0; k < m.regions.size(); k++) {
            all.descriptors.col(static_cast<Eigen::Index>(all.regions.size())) = m.descriptors[k];
            all.regions.push_back(m.regions[k]);
        }
    return all;
}

} // namespace pipefish::match
