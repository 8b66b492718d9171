#include "disc.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>

namespace pipefish::detect
{
namespace
{

struct Levels { // light around the disc: a plane over the offset from `middle`; dark within
    Eigen::Vector2d middle;
    Eigen::Vector3d light = Eigen::Vector3d::Zero();
    double dark = 0.0, noise = 1.0;
    double saturated = 0.0; // share of the clear ground

    double light_at(double x, double y) const
    {
        return light[0] + light[1] * (x - middle.x()) + light[2] * (y - middle.y());
    }
    // How much of a pixel the disc covers. Dark follows the light: it is a share of it.
    double cover(double x, double y, double grey) const
    {
        const double white = std::max(light_at(x, y), 1.0);
        return (white - grey) / std::max(white * (1.0 - dark / light[0]), 1.0);
    }
    bool good() const { return light[0] - dark > std::max(8.0, 4.0 * noise); }
};

double median(std::vector<double> &values)
{
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

// The window around a place, and what is where in it. Masks are 255 or 0.
struct Cut {
    int x0 = 0, y0 = 0;
    cv::Mat grey;
    cv::Mat disc, ring, core, clear; // the disc with a hole filled; with two pixels more; with two less; light ground
};

// The levels by a cut: a plane through the clear ground, the median of the disc's dark core.
Levels levels_of(const Cut &cut, const Levels &before)
{
    Levels l = before;
    Eigen::Matrix3d n = 1e-6 * Eigen::Matrix3d::Identity();
    Eigen::Vector3d r = Eigen::Vector3d::Zero();
    std::vector<double> within, rim;
    double square = 0.0;
    int count = 0, full = 0;
    for (int y = 0; y < cut.grey.rows; y++)
        for (int x = 0; x < cut.grey.cols; x++) {
            const double grey = cut.grey.at<uint8_t>(y, x), u = x + cut.x0, v = y + cut.y0;
            if (cut.clear.at<uint8_t>(y, x)) {
                full += grey >= 254;
                const Eigen::Vector3d row(1, u - l.middle.x(), v - l.middle.y());
                n += row * row.transpose();
                r += row * grey;
                square += std::pow(grey - before.light_at(u, v), 2);
                count++;
            } else if (cut.disc.at<uint8_t>(y, x) && before.cover(u, v, grey) > 0.5) {
                (cut.core.at<uint8_t>(y, x) ? within : rim).push_back(grey);
            }
        }
    if (count < 8 || within.size() + rim.size() == 0)
        return l;
    l.light = n.ldlt().solve(r);
    l.saturated = double(full) / count;
    l.noise = std::max(std::sqrt(square / count), 0.3);
    // A disc of a few pixels has no core: its darkest pixel must do.
    l.dark = within.size() < 5 ? *std::min_element(rim.begin(), rim.end()) : median(within);
    return l;
}

// First levels, before anything is cut out: what is bright and what is dark around the start.
Levels first_levels(const cv::Mat &grey, const Eigen::Vector2d &start)
{
    std::vector<double> all;
    for (int y = 0; y < grey.rows; y++)
        all.insert(all.end(), grey.ptr<uint8_t>(y), grey.ptr<uint8_t>(y) + grey.cols);
    std::sort(all.begin(), all.end());
    Levels l;
    l.middle = start;
    l.light[0] = std::max(all[all.size() * 3 / 4], 1.0);
    l.dark = all[all.size() / 50];
    l.noise = 0.3;
    return l;
}

// Cuts the disc nearest to the start out of the window. False: none, or it runs out of the window.
bool cut_out(Cut &cut, const Levels &levels, const Eigen::Vector2d &start, double off)
{
    cv::Mat dark(cut.grey.size(), CV_8U);
    for (int y = 0; y < dark.rows; y++)
        for (int x = 0; x < dark.cols; x++)
            dark.at<uint8_t>(y, x) = levels.cover(x + cut.x0, y + cut.y0, cut.grey.at<uint8_t>(y, x)) > 0.5 ? 255 : 0;
    std::vector<std::vector<cv::Point>> outlines;
    cv::findContours(dark, outlines, cv::RETR_EXTERNAL, cv::CHAIN_APPROX_NONE);
    const cv::Point2f at(static_cast<float>(start.x() - cut.x0), static_cast<float>(start.y() - cut.y0));
    int best = -1;
    double depth = -off;
    for (size_t k = 0; k < outlines.size(); k++) {
        const double inside = cv::pointPolygonTest(outlines[k], at, true);
        if (outlines[k].size() >= 4 && inside > depth) {
            best = static_cast<int>(k);
            depth = inside;
        }
    }
    if (best < 0)
        return false;
    const cv::Rect box = cv::boundingRect(outlines[size_t(best)]);
    if (box.x < 2 || box.y < 2 || box.x + box.width > dark.cols - 2 || box.y + box.height > dark.rows - 2)
        return false;
    cut.disc = cv::Mat::zeros(dark.size(), CV_8U);
    cv::drawContours(cut.disc, outlines, best, 255, cv::FILLED);
    const cv::Mat two = cv::getStructuringElement(cv::MORPH_ELLIPSE, {5, 5});
    cv::Mat busy;
    cv::dilate(cut.disc, cut.ring, two);
    cv::erode(cut.disc, cut.core, two);
    cv::dilate(dark | cut.disc, busy, two);
    cut.clear = 255 - busy;
    return true;
}

} // namespace

double grey_at(const cv::Mat &image, double x, double y)
{
    x = std::clamp(x, 0.0, image.cols - 1.0);
    y = std::clamp(y, 0.0, image.rows - 1.0);
    const int x0 = std::min(static_cast<int>(x), image.cols - 2), y0 = std::min(static_cast<int>(y), image.rows - 2);
    const double a = x - x0, b = y - y0;
    const uint8_t *upper = image.ptr<uint8_t>(y0) + x0, *lower = image.ptr<uint8_t>(y0 + 1) + x0;
    return (1 - b) * ((1 - a) * upper[0] + a * upper[1]) + b * ((1 - a) * lower[0] + a * lower[1]);
}

Disc measure_disc(const cv::Mat &image, const Eigen::Vector2d &start, const DiscSetup &setup)
{
    Disc d;
    const Eigen::Vector2d sizes = setup.half_axes.jacobiSvd().singularValues();
    if (!(sizes[1] > 1.2) || !start.allFinite() || start.cwiseAbs().maxCoeff() > 1e5)
        return d;
    Cut cut;
    const Eigen::Vector2d reach = setup.free * setup.half_axes.rowwise().norm();
    const int margin = 3;
    cut.x0 = std::max(0, static_cast<int>(std::floor(start.x() - reach.x())) - margin);
    cut.y0 = std::max(0, static_cast<int>(std::floor(start.y() - reach.y())) - margin);
    const int x1 = std::min(image.cols - 1, static_cast<int>(std::ceil(start.x() + reach.x())) + margin);
    const int y1 = std::min(image.rows - 1, static_cast<int>(std::ceil(start.y() + reach.y())) + margin);
    if (x1 - cut.x0 < 6 || y1 - cut.y0 < 6)
        return d;
    cut.grey = image(cv::Rect(cut.x0, cut.y0, x1 - cut.x0 + 1, y1 - cut.y0 + 1));
    Levels levels = first_levels(cut.grey, start);
    for (int pass = 0; pass < 3; pass++) {
        if (!levels.good() || !cut_out(cut, levels, start, 0.6 * sizes[1]))
            return d;
        levels = levels_of(cut, levels);
    }
    if (!levels.good())
        return d;
    // Moments over the disc and two pixels around it; a hole counts as covered.
    Eigen::Vector2d sum = Eigen::Vector2d::Zero();
    Eigen::Matrix2d spread = Eigen::Matrix2d::Zero();
    for (int y = 0; y < cut.grey.rows; y++)
        for (int x = 0; x < cut.grey.cols; x++) {
            if (!cut.ring.at<uint8_t>(y, x))
                continue;
            const double u = x + cut.x0, v = y + cut.y0;
            const bool deep = cut.core.at<uint8_t>(y, x) != 0;
            const double share = deep ? 1.0 : levels.cover(u, v, cut.grey.at<uint8_t>(y, x));
            const Eigen::Vector2d off(u - start.x(), v - start.y());
            d.area += share;
            sum += share * off;
            if (!deep)
                spread += off * off.transpose();
        }
    const Eigen::Vector2d mean = sum / d.area;
    d.at = start + mean;
    d.contrast = levels.light[0] - levels.dark;
    d.covariance = std::pow(levels.noise / d.contrast / d.area, 2) * spread;
    // Where the light is clipped the shares are wrong: measured, up to 5 % of the disc's size in a lamp's reflection.
    if (levels.saturated > 0.05)
        d.covariance += std::pow(0.04 * sizes[1], 2) * Eigen::Matrix2d::Identity();
    // Of the expected size and shape, and full? By the pixels at least half covered: an ellipse's second moments are
    // those of its half axes / 4.
    const cv::Moments m = cv::moments(cut.disc, true);
    Eigen::Matrix2d own;
    own << m.mu20, m.mu11, m.mu11, m.mu02;
    own *= 4.0 / m.m00;
    const Eigen::Matrix2d to_unit = setup.half_axes.inverse();
    const Eigen::Matrix2d shape = to_unit * own * to_unit.transpose();
    const Eigen::Vector2d stretch = shape.selfadjointView<Eigen::Lower>().eigenvalues();
    const double loose = 0.35 + 0.8 / sizes[1], expected = M_PI * std::abs(setup.half_axes.determinant());
    const double fill = m.m00 / (M_PI * std::sqrt(std::max(own.determinant(), 1e-9)));
    d.found = std::abs(m.m00 / expected - 1.0) < loose && stretch[0] > 1.0 - loose && stretch[1] < 1.0 + 1.5 * loose &&
              std::abs(fill - 1.0) < 0.08 + 0.3 / sizes[1] && (to_unit * mean).norm() < 0.6;
    d.hole = grey_at(image, d.at.x(), d.at.y()) > 0.5 * (levels.light[0] + levels.dark);
    d.light = levels.light;
    d.dark = levels.dark;
    d.light_from = levels.middle;
    return d;
}

std::vector<Eigen::Vector2d> disc_outline(const cv::Mat &image, const Disc &disc, const DiscSetup &setup, int count)
{
    Levels levels;
    levels.middle = disc.light_from;
    levels.light = disc.light;
    levels.dark = disc.dark;
    std::vector<Eigen::Vector2d> points;
    const double step = std::min(0.1, 0.25 / setup.half_axes.colwise().norm().maxCoeff());
    for (int k = 0; k < count; k++) {
        const double angle = 2 * M_PI * k / count;
        const Eigen::Vector2d ray = setup.half_axes * Eigen::Vector2d(std::cos(angle), std::sin(angle));
        const double first = 0.65;
        double before = 1.0;
        for (double t = first; t < setup.free + 0.2; t += step) {
            const Eigen::Vector2d p = disc.at + t * ray;
            const double share = levels.cover(p.x(), p.y(), grey_at(image, p.x(), p.y()));
            if (share < 0.5) {
                if (t > first)
                    points.push_back(disc.at + (t - step * (0.5 - share) / std::max(before - share, 1e-6)) * ray);
                break;
            }
            before = share;
        }
    }
    return points;
}

} // namespace pipefish::detect
