#include "match/detect.hpp"

#include "match/moments.hpp"
#include "match/vec.hpp"

#include <opencv2/features2d.hpp>
#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <array>
#include <cmath>

namespace pipefish::match
{

namespace
{

constexpr double kRadius = 1.25; // of a circle, in deviations of the Gaussian that found it

Region circle(double x, double y, double sigma)
{
    return {{x, y}, Eigen::Matrix2d::Identity() * (kRadius * sigma)};
}

void sift_points(const cv::Mat1b &grey, int most, std::vector<Region> &out)
{
    std::vector<cv::KeyPoint> points;
    cv::SIFT::create(most, 3, 0.02)->detect(grey, points);
    std::stable_sort(points.begin(), points.end(),
                     [](const auto &p, const auto &q) { return p.response > q.response; });
    const cv::Point2f *last = nullptr;
    for (const cv::KeyPoint &p : points) {
        if (last && *last == p.pt)
            continue; // a second orientation: ours are found later
        last = &p.pt;
        out.push_back(
            circle(static_cast<double>(p.pt.x), static_cast<double>(p.pt.y), static_cast<double>(p.size) / 2));
        if (static_cast<int>(out.size()) >= most)
            break;
    }
}

// ---- the Hessian's determinant

struct Blob {
    float strength;
    Region region;
};

// sigma^4 (Lxx Lyy - Lxy^2) of a level; 0 on the rim.
Image hessian(const Image &level, float sigma)
{
    Image out(level.size(), 0.0F);
    const float scale = sigma * sigma * sigma * sigma;
    for (int y = 1; y + 1 < level.rows; y++) {
        const float *above = level[y - 1], *row = level[y], *below = level[y + 1];
        for (int x = 1; x + 1 < level.cols; x++) {
            const float xx = row[x - 1] - 2 * row[x] + row[x + 1], yy = above[x] - 2 * row[x] + below[x];
            const float xy = 0.25F * (below[x + 1] - below[x - 1] - above[x + 1] + above[x - 1]);
            out(y, x) = scale * (xx * yy - xy * xy);
        }
    }
    return out;
}

bool highest(const std::array<Image, 4> &levels, size_t level, int x, int y)
{
    const float v = levels[level](y, x);
    for (size_t l = level - 1; l <= level + 1; l++)
        for (int j = -1; j <= 1; j++)
            for (int i = -1; i <= 1; i++)
                if (levels[l](y + j, x + i) > v)
                    return false;
    return true;
}

// Blobs, maxima over place and scale. Levels 2 to 5 of a stack have, with the camera's own blur, sigma 1 to 2.8 a root
// of 2 apart; the two in the middle count, and larger ones come from halved images.
void blobs(const ScaleStack &stack, double pixel, std::vector<Blob> &out)
{
    constexpr float kLeast = 1e-4F; // a hundredth of contrast, squared
    std::array<Image, 4> levels;
    for (size_t k = 0; k < levels.size(); k++) {
        const double step = std::exp2(0.5 * static_cast<double>(k + 2));
        levels[k] = hessian(stack.for_step(step), static_cast<float>(0.5 * step));
    }
    for (size_t k = 1; k <= 2; k++)
        for (int y = 1; y + 1 < stack.height(); y++)
            for (int x = 1; x + 1 < stack.width(); x++) {
                const float v = levels[k](y, x);
                if (v < kLeast || !highest(levels, k, x, y))
                    continue;
                const float dx = vertex(levels[k](y, x - 1), v, levels[k](y, x + 1));
                const float dy = vertex(levels[k](y - 1, x), v, levels[k](y + 1, x));
                const float ds = vertex(levels[k - 1](y, x), v, levels[k + 1](y, x));
                const double sigma = std::exp2(0.5 * (static_cast<double>(k) + static_cast<double>(ds)));
                const double rim = (pixel - 1) / 2; // of a halved image's pixel, in the whole one's
                out.push_back({v, circle((x + static_cast<double>(dx)) * pixel + rim,
                                         (y + static_cast<double>(dy)) * pixel + rim, sigma * pixel)});
            }
}

void hessian_points(const ScaleStack &stack, int most, std::vector<Region> &out)
{
    std::vector<Blob> found;
    blobs(stack, 1, found);
    Image image = stack.image();
    for (double pixel = 2; std::min(image.rows, image.cols) >= 64; pixel *= 2) {
        Image half;
        cv::resize(image(cv::Rect(0, 0, image.cols / 2 * 2, image.rows / 2 * 2)), half, {}, 0.5, 0.5, cv::INTER_AREA);
        blobs(ScaleStack(half), pixel, found);
        image = half;
    }
    std::stable_sort(found.begin(), found.end(), [](const Blob &p, const Blob &q) { return p.strength > q.strength; });
    for (size_t k = 0; k < std::min(found.size(), static_cast<size_t>(most)); k++)
        out.push_back(found[k].region);
}

// ---- maximally stable extremal regions

// Mean step of grey level outwards over a set's rim: how much it stands out. `mark` remembers sets by number.
double standing_out(const cv::Mat1b &grey, const std::vector<cv::Point> &set, int number, cv::Mat1i &mark)
{
    for (const cv::Point &p : set)
        mark(p) = number;
    int64_t sum = 0, count = 0;
    const cv::Point around[4] = {{1, 0}, {-1, 0}, {0, 1}, {0, -1}};
    const cv::Rect inside({0, 0}, grey.size());
    for (const cv::Point &p : set)
        for (const cv::Point &d : around)
            if (inside.contains(p + d) && mark(p + d) != number) {
                sum += std::abs(grey(p + d) - grey(p));
                count++;
            }
    return count ? static_cast<double>(sum) / static_cast<double>(count) : 0;
}

// Dark and bright ones alike, those that stand out most: a picture and its negative have the same.
void extremal_regions(const cv::Mat1b &grey, int most, std::vector<Region> &out)
{
    std::vector<std::vector<cv::Point>> sets;
    std::vector<cv::Rect> boxes;
    const int area = grey.rows * grey.cols;
    cv::MSER::create(5, 40, area / 20, 0.25, 0.2)->detectRegions(grey, sets, boxes);
    cv::Mat1i mark(grey.size(), -1);
    std::vector<std::pair<double, size_t>> order;
    for (size_t k = 0; k < sets.size(); k++)
        order.emplace_back(-standing_out(grey, sets[k], static_cast<int>(k), mark), k);
    std::sort(order.begin(), order.end());
    for (size_t k = 0; k < std::min(order.size(), static_cast<size_t>(most)); k++) {
        const std::vector<cv::Point> &set = sets[order[k].second];
        Eigen::Vector2d mean = Eigen::Vector2d::Zero();
        for (const cv::Point &p : set)
            mean += Eigen::Vector2d(p.x, p.y);
        mean /= static_cast<double>(set.size());
        Eigen::Matrix2d spread = Eigen::Matrix2d::Zero();
        for (const cv::Point &p : set) {
            const Eigen::Vector2d d = Eigen::Vector2d(p.x, p.y) - mean;
            spread += d * d.transpose();
        }
        spread /= static_cast<double>(set.size());
        if (spread.determinant() > 1 && aspect(root(spread)) < 6)
            out.push_back({mean, 2 * root(spread) * 0.75}); // a filled ellipse has half axes of 2 deviations
    }
}

} // namespace

std::vector<Region> detect(const ScaleStack &stack, const RegionOptions &options)
{
    cv::Mat1b grey;
    stack.image().convertTo(grey, CV_8U, 255);
    std::vector<Region> out;
    sift_points(grey, options.most, out);
    if (options.hessian)
        hessian_points(stack, options.most, out);
    if (options.extremal)
        extremal_regions(grey, options.most / 2, out);
    return out;
}

} // namespace pipefish::match
