#include "match/region.hpp"

#include "match/detect.hpp"
#include "match/moments.hpp"
#include "match/vec.hpp"
#include "parallel.hpp"

#include <Eigen/LU>
#include <opencv2/core.hpp>

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

using Normalised = std::array<std::array<float, kSide + 2>, kSide + 2>; // with a rim of one sample

// at + shape * v for v in [-1, 1]^2 (and a rim), from the level whose blur suits the spacing.
void normalise(const ScaleStack &stack, const Region &region, int half, Normalised &out)
{
    const Eigen::Matrix2d a = region.shape / half;
    const Image &image = stack.for_step(std::sqrt(std::abs(a.determinant())));
    for (int j = -half - 1; j <= half + 1; j++)
        for (int i = -half - 1; i <= half + 1; i++) {
            const Eigen::Vector2f p = (region.at + a * Eigen::Vector2d(i, j)).cast<float>();
            out[static_cast<size_t>(j + half + 1)][static_cast<size_t>(i + half + 1)] = bilinear(image, p.x(), p.y());
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
        const double both = std::sqrt(std::max(0.0, m.trace() * m.trace() - 4 * m.determinant()));
        if (m.trace() - both > 0.95 * (m.trace() + both)) // ratio of eigenvalues
            return true;
        Eigen::Matrix2d u = region.shape * root(m).inverse();
        u *= std::sqrt(det / std::abs(u.determinant()));
        region.shape = root(u * u.transpose());
        if (aspect(region.shape) > 6)
            return false;
    }
    return false;
}

// At most two directions of the gradient in the normalised patch.
std::vector<double> orientations(const Normalised &p)
{
    constexpr int bins = 36;
    std::array<double, bins> raw = {}, h = {};
    for (int j = 1; j <= kSide; j++)
        for (int i = 1; i <= kSide; i++) {
            const auto u = static_cast<size_t>(i), v = static_cast<size_t>(j);
            const float gx = p[v][u + 1] - p[v][u - 1], gy = p[v + 1][u] - p[v - 1][u];
            const auto at = static_cast<size_t>(cv::fastAtan2(gy, gx) * (bins / 360.0F));
            raw[at % bins] +=
                kTurnWindow[u - 1] * kTurnWindow[v - 1] * static_cast<double>(std::sqrt(gx * gx + gy * gy));
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

// Lowe's histograms: 4 x 4 places, 8 directions, each sample shared between neighbours; root of the L1-normalised.
Eigen::Matrix<float, kDescriptor, 1> descriptor(const Normalised &p)
{
    Eigen::Matrix<float, kDescriptor, 1> out = Eigen::Matrix<float, kDescriptor, 1>::Zero();
    const float cell = kSide / 4.0F;
    for (int j = 1; j <= kSide; j++)
        for (int i = 1; i <= kSide; i++) {
            const auto u = static_cast<size_t>(i), v = static_cast<size_t>(j);
            const float gx = p[v][u + 1] - p[v][u - 1], gy = p[v + 1][u] - p[v - 1][u];
            const auto x = static_cast<float>(i - kHalf - 1), y = static_cast<float>(j - kHalf - 1);
            const float w =
                std::sqrt(gx * gx + gy * gy) * static_cast<float>(kDescribeWindow[u - 1] * kDescribeWindow[v - 1]);
            const float bx = x / cell + 1.5F, by = y / cell + 1.5F;
            const float turn = cv::fastAtan2(gy, gx) * (8 / 360.0F);
            const int ix = static_cast<int>(std::floor(bx)), iy = static_cast<int>(std::floor(by));
            const int it = static_cast<int>(turn);
            const float fx = bx - static_cast<float>(ix), fy = by - static_cast<float>(iy),
                        ft = turn - static_cast<float>(it);
            for (int c = 0; c < 8; c++) {
                const int cx = ix + (c & 1), cy = iy + (c >> 1 & 1), ct = (it + (c >> 2)) % 8;
                if (cx < 0 || cy < 0 || cx > 3 || cy > 3)
                    continue;
                out((cy * 4 + cx) * 8 + ct) +=
                    w * (c & 1 ? fx : 1 - fx) * (c & 2 ? fy : 1 - fy) * (c & 4 ? ft : 1 - ft);
            }
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
