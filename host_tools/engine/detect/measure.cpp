#include "measure.hpp"

#include "saddle.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::detect
{

Eigen::Vector3d Board::place(const Eigen::Vector2d &on_sheet) const
{
    if (diameter == 0.0)
        return {on_sheet.x(), on_sheet.y(), 0.0};
    const double r = diameter / 2, clock = on_sheet.x() / r;
    return {r * std::sin(clock), -r * std::cos(clock), on_sheet.y()};
}

Eigen::Vector2d Board::between(const Eigen::Vector2d &from, const Eigen::Vector2d &to) const
{
    Eigen::Vector2d way = to - from;
    if (diameter > 0.0)
        way.x() = std::remainder(way.x(), M_PI * diameter);
    return way;
}

DiscSetup disc_setup(const Board &board, const Eigen::Matrix2d &cell)
{
    Eigen::Matrix2d steps;
    steps << board.step_i, board.step_j;
    DiscSetup setup;
    setup.half_axes = cell * steps.inverse() * board.radius;
    const double gap = std::min(board.step_i.norm(), board.step_j.norm()) / board.radius - 1.0;
    setup.free = std::clamp(0.95 * gap, 1.15, 2.0);
    return setup;
}

namespace
{

SaddleSetup saddle_setup(const Board &board, const Eigen::Matrix2d &cell, int code)
{
    SaddleSetup setup;
    setup.cell = cell;
    setup.dark = code < 0 ? 0 : code ? 1 : -1;
    if (board.kind == Kind::charuco) { // markers begin so far from the edges
        const double white = 0.5 * (1.0 - board.marker_side / board.step_i.norm());
        setup.white_free = std::max(0.05, white - 1.0 / cell.colwise().norm().minCoeff());
    }
    return setup;
}

} // namespace

std::optional<Point> measure_point(const cv::Mat &image, const Board &board, const Eigen::Vector2d &at,
                                   const Eigen::Matrix2d &cell, int code)
{
    Point p;
    if (board.discs()) {
        const Disc d = measure_disc(image, at, disc_setup(board, cell));
        if (!d.found || (board.kind == Kind::sleeve && code >= 0 && d.hole != (code == 1)))
            return std::nullopt;
        p.at = d.at;
        p.covariance = d.covariance;
        p.code = d.hole;
        return p;
    }
    const Saddle s = fit_saddle(image, at, saddle_setup(board, cell, code));
    if (!s.found)
        return std::nullopt;
    p.at = s.at;
    p.covariance = s.covariance;
    p.code = s.contrast > 0;
    return p;
}

std::optional<Point> search_point(const cv::Mat &image, const Board &board, const Eigen::Vector2d &at,
                                  const Eigen::Matrix2d &cell, int code)
{
    if (const auto direct = measure_point(image, board, at, cell, code))
        return direct;
    // The patch: 0.85 steps around, its unit 1/20 of a step. The pattern that is looked for is 0.4 steps around.
    constexpr int unit = 20, half = 17, pattern = 8, size = 2 * half + 1, most = half - pattern;
    double patch[size][size];
    for (int j = -half; j <= half; j++)
        for (int i = -half; i <= half; i++) {
            const Eigen::Vector2d p = at + cell * Eigen::Vector2d(i, j) / unit;
            if (p.x() < 0 || p.y() < 0 || p.x() > image.cols - 1 || p.y() > image.rows - 1) {
                if (std::max(std::abs(i), std::abs(j)) <= pattern)
                    return std::nullopt;
            }
            patch[j + half][i + half] = grey_at(image, p.x(), p.y());
        }
    const double steps[2] = {board.step_i.norm() / unit, board.step_j.norm() / unit};
    double sign[2 * pattern + 1][2 * pattern + 1];
    double total = 0.0, count = 0.0;
    for (int j = -pattern; j <= pattern; j++)
        for (int i = -pattern; i <= pattern; i++) {
            double s = 0.0;
            if (board.discs()) {
                const double far = std::hypot(i * steps[0], j * steps[1]) / board.radius;
                s = far > 0.55 && far < 0.95 ? -1.0 : far > 1.05 && far < 1.5 ? 1.0 : 0.0;
            } else if (i != 0 && j != 0) {
                s = (i > 0) == (j > 0) ? -1.0 : 1.0;
                s = code == 0 ? -s : s;
                const double white = 0.5 * (1.0 - board.marker_side / board.step_i.norm()) * unit;
                if (board.kind == Kind::charuco && s > 0 && std::min(std::abs(i), std::abs(j)) > white)
                    s = 0.0;
            }
            sign[j + pattern][i + pattern] = s;
            total += s;
            count += s != 0.0;
        }
    double best = 0.55;
    Eigen::Vector2d found;
    bool any = false;
    for (int dj = -most; dj <= most; dj++)
        for (int di = -most; di <= most; di++) {
            double product = 0.0, sum = 0.0, square = 0.0;
            for (int j = -pattern; j <= pattern; j++)
                for (int i = -pattern; i <= pattern; i++) {
                    const double s = sign[j + pattern][i + pattern];
                    if (s == 0.0)
                        continue;
                    const double g = patch[j + dj + half][i + di + half];
                    product += s * g;
                    sum += g;
                    square += g * g;
                }
            const double spread = (square - sum * sum / count) * (count - total * total / count);
            const double match = (product - total * sum / count) / std::sqrt(std::max(spread, 1e-9));
            if (match > best) {
                best = match;
                found = at + cell * Eigen::Vector2d(di, dj) / unit;
                any = true;
            }
        }
    if (!any)
        return std::nullopt;
    return measure_point(image, board, found, cell, code);
}

void report(const cv::Mat &image, const Board &board, const std::vector<Measured> &points, Detection &out)
{
    std::vector<Measured> sorted = points;
    std::sort(sorted.begin(), sorted.end(), [](const Measured &a, const Measured &b) { return a.id < b.id; });
    for (const Measured &m : sorted) {
        out.ids.push_back(m.id);
        out.pixels.push_back(m.point.at);
        out.covariance.push_back(m.point.covariance);
        if (board.discs()) {
            const DiscSetup setup = disc_setup(board, m.cell);
            out.outlines.push_back(disc_outline(image, measure_disc(image, m.point.at, setup), setup, kOutlinePoints));
        }
    }
}

} // namespace pipefish::detect
