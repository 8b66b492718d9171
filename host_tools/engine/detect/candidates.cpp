#include "candidates.hpp"

#include "disc.hpp"
#include "linalg/linalg.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <array>
#include <cmath>

namespace pipefish::detect
{
namespace
{

constexpr int kRing = 32;

// Looks at a ring around a point: four sectors, dark and light by turns, opposite ones about equally wide?
bool look_around(const cv::Mat &image, double x, double y, double radius, Corner &corner)
{
    std::array<double, kRing> grey;
    double low = 255, high = 0;
    for (int k = 0; k < kRing; k++) {
        const double angle = 2 * M_PI * k / kRing;
        grey[size_t(k)] = grey_at(image, x + radius * std::cos(angle), y + radius * std::sin(angle));
        low = std::min(low, grey[size_t(k)]);
        high = std::max(high, grey[size_t(k)]);
    }
    if (high - low < 10)
        return false;
    const double middle = 0.5 * (low + high);
    double crossing[4];
    int count = 0, first_dark = -1;
    for (int k = 0; k < kRing; k++) {
        const double a = grey[size_t(k)] - middle, b = grey[size_t((k + 1) % kRing)] - middle;
        if ((a < 0) == (b < 0))
            continue;
        if (count == 4)
            return false;
        if (b < 0 && first_dark < 0)
            first_dark = count;
        crossing[count++] = 2 * M_PI * (k + a / (a - b)) / kRing;
    }
    if (count != 4)
        return false;
    double sector[4];
    for (int k = 0; k < 4; k++) {
        const double next = k < 3 ? crossing[k + 1] : crossing[0] + 2 * M_PI;
        sector[k] = next - crossing[k];
        if (sector[k] < 0.3)
            return false;
    }
    if (std::abs(sector[0] - sector[2]) > 0.6 || std::abs(sector[1] - sector[3]) > 0.6)
        return false;
    for (int e = 0; e < 2; e++) { // an edge runs through opposite crossings
        const double a = crossing[(first_dark + e) % 4], b = crossing[(first_dark + e + 2) % 4];
        corner.edge[e] =
            (Eigen::Vector2d(std::cos(a), std::sin(a)) - Eigen::Vector2d(std::cos(b), std::sin(b))).normalized();
    }
    corner.strength = high - low;
    return true;
}

// The saddle point of the grey levels' parabola, from derivatives of the blurred picture.
Eigen::Vector2d saddle_point(const cv::Mat &soft, int x, int y)
{
    const auto at = [&](int i, int j) { return double(soft.at<float>(y + j, x + i)); };
    const double gx = 0.5 * (at(1, 0) - at(-1, 0)), gy = 0.5 * (at(0, 1) - at(0, -1));
    Eigen::Matrix2d h;
    h(0, 0) = at(1, 0) - 2 * at(0, 0) + at(-1, 0);
    h(1, 1) = at(0, 1) - 2 * at(0, 0) + at(0, -1);
    h(0, 1) = h(1, 0) = 0.25 * (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1));
    Eigen::Vector2d move = -h.fullPivLu().solve(Eigen::Vector2d(gx, gy));
    if (!(move.cwiseAbs().maxCoeff() < 1.0))
        move.setZero();
    return Eigen::Vector2d(x, y) + move;
}

} // namespace

std::vector<Corner> find_corners(const cv::Mat &image, int scale)
{
    cv::Mat small = image, soft;
    if (scale > 1)
        cv::resize(image, small, cv::Size(image.cols / scale, image.rows / scale), 0, 0, cv::INTER_AREA);
    if (small.cols < 24 || small.rows < 24)
        return {};
    small.convertTo(soft, CV_32F);
    cv::GaussianBlur(soft, soft, cv::Size(), 1.2);
    cv::Mat response(small.size(), CV_32F, cv::Scalar(0));
    for (int y = 1; y < soft.rows - 1; y++) {
        const float *a = soft.ptr<float>(y - 1), *b = soft.ptr<float>(y), *c = soft.ptr<float>(y + 1);
        float *out = response.ptr<float>(y);
        for (int x = 1; x < soft.cols - 1; x++) {
            const float xx = b[x + 1] - 2 * b[x] + b[x - 1], yy = c[x] - 2 * b[x] + a[x];
            const float xy = 0.25F * (c[x + 1] - c[x - 1] - a[x + 1] + a[x - 1]);
            out[x] = xy * xy - xx * yy;
        }
    }
    cv::Mat top;
    cv::dilate(response, top, cv::Mat::ones(5, 5, CV_8U));
    std::vector<Corner> corners;
    cv::Mat bytes;
    cv::GaussianBlur(small, bytes, cv::Size(), 0.7);
    for (int y = 7; y < soft.rows - 7; y++) {
        for (int x = 7; x < soft.cols - 7; x++) {
            if (response.at<float>(y, x) < 1.0F || response.at<float>(y, x) < top.at<float>(y, x))
                continue;
            const Eigen::Vector2d p = saddle_point(soft, x, y);
            // On two rings, or it is text or foliage.
            Corner near, far;
            if (!look_around(bytes, p.x(), p.y(), 3.0, near) || !look_around(bytes, p.x(), p.y(), 4.6, far))
                continue;
            if (std::abs(near.edge[0].dot(far.edge[0])) < 0.9 || std::abs(near.edge[1].dot(far.edge[1])) < 0.9)
                continue;
            far.at = (p.array() + 0.5) * scale - 0.5;
            corners.push_back(far);
        }
    }
    return corners;
}

namespace
{

bool blob_of(const std::vector<cv::Point> &outline, const cv::Mat &image, Blob &blob)
{
    if (outline.size() < 6)
        return false;
    const cv::Moments m = cv::moments(outline);
    if (m.m00 < 8 || m.m00 > 0.1 * image.cols * image.rows)
        return false;
    blob.at = {m.m10 / m.m00, m.m01 / m.m00};
    Eigen::Matrix2d second;
    second << m.mu20, m.mu11, m.mu11, m.mu02;
    second /= m.m00;
    const linalg::SymmetricEigen<2> eigen = linalg::symmetric_eigen<2>(second);
    const Eigen::Vector2d half = 2.0 * eigen.values.cwiseMax(0.0).cwiseSqrt();
    if (half[0] < 0.9 || half[1] > 12 * half[0])
        return false;
    const double fill = m.m00 / (M_PI * half[0] * half[1]);
    // The outline runs through the middles of the outermost pixels: a small blob is larger by half a pixel around.
    const Eigen::Vector2d whole = half.array() + 0.5;
    if (std::abs(fill - 1.0) > (half[0] < 3 ? 0.2 : 0.08))
        return false;
    blob.half_axes = eigen.vectors * whole.asDiagonal();
    double outside = 0.0, inside = 0.0, least = 255.0;
    for (int k = 0; k < 16; k++) {
        const double angle = 2 * M_PI * k / 16;
        const Eigen::Vector2d ray = blob.half_axes * Eigen::Vector2d(std::cos(angle), std::sin(angle));
        const Eigen::Vector2d step = ray.normalized() * 1.5;
        const Eigen::Vector2d out = blob.at + ray + step, in = blob.at + 0.8 * ray;
        const double light = grey_at(image, out.x(), out.y()), dark = grey_at(image, in.x(), in.y());
        outside += light / 16;
        inside += dark / 16;
        least = std::min(least, light - dark);
    }
    blob.contrast = outside - inside;
    return blob.contrast > 12 && least > 0.2 * blob.contrast;
}

} // namespace

std::vector<Blob> find_blobs(const cv::Mat &image)
{
    std::vector<Blob> blobs;
    const auto collect = [&](const cv::Mat &dark) {
        std::vector<std::vector<cv::Point>> outlines;
        cv::findContours(dark, outlines, cv::RETR_LIST, cv::CHAIN_APPROX_NONE);
        for (const auto &outline : outlines) {
            Blob blob;
            if (blob_of(outline, image, blob))
                blobs.push_back(blob);
        }
    };
    const int shorter = std::min(image.cols, image.rows);
    for (const int share : {48, 16, 6}) {
        cv::Mat dark;
        const int block = std::max(5, shorter / share) | 1;
        cv::adaptiveThreshold(image, dark, 255, cv::ADAPTIVE_THRESH_MEAN_C, cv::THRESH_BINARY_INV, block, 6);
        collect(dark);
    }
    cv::Mat dark;
    cv::threshold(image, dark, 0, 255, cv::THRESH_BINARY_INV | cv::THRESH_OTSU);
    collect(dark);
    // Of several at one place the largest, unless a smaller one has much more contrast.
    std::sort(blobs.begin(), blobs.end(), [](const Blob &a, const Blob &b) {
        return a.half_axes.determinant() * a.half_axes.determinant() >
               b.half_axes.determinant() * b.half_axes.determinant();
    });
    std::vector<Blob> kept;
    for (const Blob &blob : blobs) {
        const auto same = std::find_if(kept.begin(), kept.end(), [&](const Blob &other) {
            return (other.half_axes.inverse() * (blob.at - other.at)).norm() < 0.9;
        });
        if (same == kept.end())
            kept.push_back(blob);
        else if (blob.contrast > 1.4 * same->contrast)
            *same = blob;
    }
    return kept;
}

} // namespace pipefish::detect
