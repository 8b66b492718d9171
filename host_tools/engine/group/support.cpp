#include "group/support.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>

namespace pipefish::group
{

namespace
{

cv::Mat disc(int radius)
{
    return cv::getStructuringElement(cv::MORPH_ELLIPSE, {2 * radius + 1, 2 * radius + 1});
}

} // namespace

Mask support(const std::vector<match::Match> &matches, const Groups &groups, int group, Side side, cv::Size size,
             double reach)
{
    constexpr int bits = 4; // of the fraction of a pixel
    Mask out(size, 0);
    for (const Triangle &t : groups.triangles) {
        if (t.group != group)
            continue;
        std::array<cv::Point, 3> corner;
        for (size_t k = 0; k < 3; k++) {
            const match::Match &m = matches[static_cast<size_t>(t.vertex[k])];
            const Eigen::Vector2f at = side == Side::kFirst ? Eigen::Vector2f(m.x, m.y) : m.centre;
            corner[k] = {static_cast<int>(std::lround(at.x() * (1 << bits))),
                         static_cast<int>(std::lround(at.y() * (1 << bits)))};
        }
        cv::fillConvexPoly(out, corner.data(), 3, 255, cv::LINE_8, bits);
    }
    cv::morphologyEx(out, out, cv::MORPH_CLOSE, disc(3));
    const int grown = static_cast<int>(std::lround(std::min(reach, 50.0)));
    if (grown > 0)
        cv::dilate(out, out, disc(grown));
    return out;
}

std::vector<Outline> outlines(const Mask &mask)
{
    std::vector<Outline> found;
    cv::findContours(mask, found, cv::RETR_EXTERNAL, cv::CHAIN_APPROX_NONE);
    for (Outline &line : found) {
        Outline simple;
        cv::approxPolyDP(line, simple, 1.0, true);
        line = std::move(simple);
    }
    std::erase_if(found, [](const Outline &line) { return line.size() < 3; });
    std::stable_sort(found.begin(), found.end(),
                     [](const Outline &a, const Outline &b) { return cv::contourArea(a) > cv::contourArea(b); });
    return found;
}

} // namespace pipefish::group
