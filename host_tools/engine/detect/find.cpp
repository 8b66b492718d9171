#include "find.hpp"

#include "candidates.hpp"
#include "lattice.hpp"
#include "measure.hpp"

#include <opencv2/aruco.hpp>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>

namespace pipefish::detect
{
namespace
{

// A size as people count it: a checkerboard by its squares too.
std::string size_text(const std::array<int, 2> &size, const Board &board)
{
    const auto by = [&](int more) { return std::to_string(size[0] + more) + " x " + std::to_string(size[1] + more); };
    if (board.discs())
        return by(0) + " circles";
    return by(0) + " inner corners (" + by(1) + " squares)";
}

cv::Mat evened(const cv::Mat &image)
{
    cv::Mat out;
    cv::createCLAHE(4.0, cv::Size(8, 8))->apply(image, out);
    return out;
}

Grid grid_of(const std::vector<cv::Point2f> &points, int columns)
{
    Grid grid;
    for (size_t k = 0; k < points.size(); k++) {
        Point p;
        p.at = {points[k].x, points[k].y};
        grid[{static_cast<int>(k) % columns, static_cast<int>(k) / columns}] = p;
    }
    return grid;
}

// OpenCV gives a checkerboard's rows in either direction; ours turn from x to y on the screen.
void make_right_handed(Grid &grid)
{
    const auto f = forecast(grid, grid.begin()->first, 0, true);
    if (!f || f->cell.determinant() > 0)
        return;
    Grid other;
    for (const auto &[site, point] : grid)
        other[{-site[0], site[1]}] = point;
    grid = std::move(other);
}

// Measures each corner of a grid and drops what is none.
Grid refined(const cv::Mat &image, const Board &board, const Grid &grid, int columns, bool coded)
{
    Grid out;
    for (const auto &[site, point] : grid) {
        const auto f = forecast(grid, site, columns, true);
        if (!f)
            continue;
        if (const auto p = measure_point(image, board, point.at, f->cell, coded ? point.code : -1))
            out[site] = *p;
    }
    return out;
}

// ---- checkerboards

bool opencv_checkerboard(const cv::Mat &image, const Board &board, Grid &grid)
{
    const cv::Size size(board.size[0], board.size[1]);
    if (size.width < 3 || size.height < 3)
        return false;
    std::vector<cv::Point2f> points;
    if (!cv::findChessboardCornersSB(image, size, points, cv::CALIB_CB_NORMALIZE_IMAGE) &&
        !cv::findChessboardCorners(
            image, size, points, cv::CALIB_CB_ADAPTIVE_THRESH | cv::CALIB_CB_NORMALIZE_IMAGE | cv::CALIB_CB_FAST_CHECK))
        return false;
    grid = grid_of(points, size.width);
    make_right_handed(grid);
    return true;
}

// The largest grid of corners at any of three scales, in the picture as it is and with its contrast evened out.
Grid own_checkerboard(const cv::Mat &image, size_t wanted)
{
    Grid best;
    for (const bool even : {false, true}) {
        const cv::Mat look = even ? evened(image) : image;
        for (const int scale : {1, 2, 4}) {
            if (scale > 1 && std::min(image.cols, image.rows) / scale < 150)
                break;
            Grid grid = grid_of_corners(look, find_corners(look, scale));
            if (grid.size() > best.size())
                best = std::move(grid);
            if (best.size() >= wanted)
                return best;
        }
    }
    return best;
}

// ---- from a grid on its own lattice to the board's

struct Placed {
    Grid grid; // by the board's sites
    Placement placement;
};

Placed onto_board(const Grid &grid, const Placement &placement, const Board &board)
{
    Placed placed{{}, placement};
    for (const auto &[site, point] : grid) {
        Site s = placement(site);
        if (board.columns)
            s[0] = (s[0] % board.columns + board.columns) % board.columns;
        if (std::find(board.at.begin(), board.at.end(), s) != board.at.end())
            placed.grid[s] = point;
    }
    return placed;
}

int id_at(const Board &board, const Site &site)
{
    const auto found = std::find(board.at.begin(), board.at.end(), site);
    return found == board.at.end() ? -1 : static_cast<int>(found - board.at.begin());
}

// Where the picture shows no point beside the grid though it could: a place well inside the picture and the field.
std::vector<Site> absent_sites(const cv::Mat &image, const Board &board, Grid &grid)
{
    const auto inside = [&](const Forecast &f) {
        const double room = 0.6 * f.cell.colwise().norm().maxCoeff();
        return f.at.x() > room && f.at.y() > room && f.at.x() < image.cols - 1 - room &&
               f.at.y() < image.rows - 1 - room;
    };
    // Where no light falls (beyond the lens's field) there is nothing to be seen: some white must be near.
    const auto brightest = [&](const Forecast &f) {
        double most = 0.0;
        for (int j = -2; j <= 2; j++)
            for (int i = -2; i <= 2; i++) {
                const Eigen::Vector2d p = f.at + 0.2 * f.cell * Eigen::Vector2d(i, j);
                most = std::max(most, grey_at(image, p.x(), p.y()));
            }
        return most;
    };
    const auto lit = [&](const Forecast &f, const Site &site) {
        const Point *near = nullptr;
        for (const auto &[other, point] : grid)
            if (std::abs(other[0] - site[0]) + std::abs(other[1] - site[1]) == 1)
                near = &point;
        return near && brightest(f) > 0.4 * brightest({near->at, f.cell});
    };
    std::map<Site, bool> tested;
    const auto sites = grow(
        grid, 0, [](const Site &) { return true; },
        [&](const Forecast &f, const Site &site) -> std::optional<Point> {
            tested[site] = inside(f) && lit(f, site);
            if (!tested[site] || grid.size() > 4 * board.at.size())
                return std::nullopt;
            return measure_point(image, board, f.at, f.cell, -1);
        });
    std::vector<Site> absent;
    for (const Site &s : sites)
        if (tested[s])
            absent.push_back(s);
    return absent;
}

void finish(const cv::Mat &image, const Board &board, Placed placed, Detection &out)
{
    // Points that OpenCV or the graph missed, then a last look at each with what is now known around it.
    // A checkerboard's colours may be exchanged, so they are not asked for here.
    const auto code_of = [&](const Site &s) {
        const bool known = board.kind == Kind::sleeve || board.kind == Kind::charuco;
        return known ? int(board.code[size_t(id_at(board, s))]) : -1;
    };
    grow(
        placed.grid, board.columns, [&](const Site &s) { return id_at(board, s) >= 0; },
        [&](const Forecast &f, const Site &s) -> std::optional<Point> {
            return measure_point(image, board, f.at, f.cell, code_of(s));
        });
    std::vector<Measured> points;
    for (const auto &[site, point] : placed.grid) {
        const auto f = forecast(placed.grid, site, board.columns, true);
        if (!f)
            continue;
        const auto p = measure_point(image, board, point.at, f->cell, code_of(site));
        const auto others = forecast(placed.grid, site, board.columns, false);
        if (!p || (others && (f->cell.inverse() * (p->at - others->at)).norm() > 0.25))
            continue;
        points.push_back({id_at(board, site), *p, f->cell});
    }
    report(image, board, points, out);
    out.turns = placed.placement.turns;
    out.mirrored = placed.placement.mirrored;
    const size_t count = out.ids.size();
    if (count < std::min<size_t>(6, board.flat.size())) {
        const auto seen = out.seen;
        out = Detection{};
        out.seen = seen;
        out.reason = "too few points could be measured: " + std::to_string(count);
        return;
    }
    out.status = count == board.flat.size() ? Status::complete : Status::partial;
    if (count < board.flat.size())
        out.reason = std::to_string(count) + " of " + std::to_string(board.flat.size()) + " points";
    if (placed.placement.ways > placed.placement.turns) {
        out.status = Status::ambiguous;
        out.reason += ": board ordering ambiguous, " + std::to_string(placed.placement.ways) +
                      " places on the board look the same; show more of its edge";
    } else if (out.turns > 1) {
        out.reason += (out.reason.empty() ? "" : "; ");
        out.reason += "the target looks the same when turned (" + std::to_string(out.turns) +
                      " ways): the order that reads like text was taken";
    }
    if (out.mirrored)
        out.reason += (out.reason.empty() ? "" : "; ") + std::string("seen as in a mirror");
}

Detection from_grid(const cv::Mat &image, const Board &board, Grid grid, const std::vector<Site> &absent)
{
    Detection out;
    const size_t least = std::min<size_t>(board.flat.size(), 6);
    if (grid.size() < least) {
        out.reason = "no target found";
        return out;
    }
    out.seen = extent(grid, board);
    const auto placement = place_grid(grid, absent, board);
    const double share = board.kind == Kind::sleeve ? 0.8 : 0.9;
    if (!placement || placement->hits < share * static_cast<double>(grid.size())) {
        out.reason = "another target: " + size_text(out.seen, board) + " are seen, described are " +
                     size_text(board.size, board);
        return out;
    }
    finish(image, board, onto_board(grid, *placement, board), out);
    return out;
}

// The size of the board that a grid may be only a part of: OpenCV finds the size that it is asked for inside a larger
// board too. Looked for at the middles of the four sides first: on a whole board there is nothing.
std::array<int, 2> size_around(const cv::Mat &image, const Board &board, const Grid &grid)
{
    Site low = grid.begin()->first, high = low;
    for (const auto &[site, point] : grid)
        for (size_t k = 0; k < 2; k++) {
            low[k] = std::min(low[k], site[k]);
            high[k] = std::max(high[k], site[k]);
        }
    bool larger = false;
    for (size_t k = 0; k < 2; k++)
        for (const int beside : {low[k] - 1, high[k] + 1}) {
            int found = 0;
            for (const int step : {-1, 0, 1}) {
                Site site;
                site[k] = beside;
                site[1 - k] = (low[1 - k] + high[1 - k]) / 2 + step;
                const auto f = forecast(grid, site, 0, false);
                found += f && search_point(image, board, f->at, f->cell, -1);
            }
            larger |= found >= 2;
        }
    return extent(larger ? own_checkerboard(image, 4 * board.at.size()) : grid, board);
}

Detection find_checkerboard(const cv::Mat &image, const Board &board)
{
    Grid grid;
    if (opencv_checkerboard(image, board, grid)) {
        Grid better = refined(image, board, grid, 0, false);
        if (10 * better.size() > 9 * board.flat.size()) {
            const auto seen = size_around(image, board, better);
            Detection out = from_grid(image, board, better, {});
            out.seen = seen;
            return out;
        }
    }
    grid = own_checkerboard(image, board.flat.size());
    grid = refined(image, board, grid, 0, true);
    const auto absent = absent_sites(image, board, grid);
    return from_grid(image, board, grid, absent);
}

// The discs' radius by the blobs' size beside the lattice's steps, metres: the median of the grid. 0: not known.
double seen_radius(const Board &board, const Grid &grid, const std::vector<Blob> &blobs)
{
    std::vector<double> ratios;
    for (const auto &[site, point] : grid) {
        const auto f = forecast(grid, site, 0, true);
        for (const Blob &b : blobs)
            if (f && (b.at - point.at).norm() < 1.0)
                ratios.push_back(std::sqrt(std::abs(b.half_axes.determinant() / f->cell.determinant())));
    }
    if (ratios.size() < 6)
        return 0.0;
    std::nth_element(ratios.begin(), ratios.begin() + static_cast<std::ptrdiff_t>(ratios.size() / 2), ratios.end());
    Eigen::Matrix2d steps;
    steps << board.step_i, board.step_j;
    return ratios[ratios.size() / 2] * std::sqrt(std::abs(steps.determinant()));
}

// Whether the blob at a place is lighter in the middle than in the ring around it.
bool has_hole(const cv::Mat &image, const std::vector<Blob> &blobs, const Eigen::Vector2d &at)
{
    const Blob &b = *std::min_element(blobs.begin(), blobs.end(), [&](const Blob &one, const Blob &two) {
        return (one.at - at).squaredNorm() < (two.at - at).squaredNorm();
    });
    double ring = 0.0;
    for (int k = 0; k < 16; k++) {
        const double angle = 2 * M_PI * k / 16;
        const Eigen::Vector2d p = b.at + 0.75 * b.half_axes * Eigen::Vector2d(std::cos(angle), std::sin(angle));
        ring += grey_at(image, p.x(), p.y()) / 16;
    }
    return grey_at(image, b.at.x(), b.at.y()) - ring > 0.4 * b.contrast;
}

Detection find_discs(const cv::Mat &image, const Board &board)
{
    std::vector<Blob> blobs = find_blobs(image);
    Grid grid = grid_of_blobs(blobs);
    if (board.kind != Kind::sleeve && grid.size() < board.flat.size() && blobs.size() >= board.flat.size() &&
        blobs.size() < 3 * board.flat.size()) {
        std::vector<cv::Point2f> points, found;
        for (const Blob &b : blobs)
            points.emplace_back(static_cast<float>(b.at.x()), static_cast<float>(b.at.y()));
        const bool symmetric = board.kind == Kind::circles;
        const int flags = (symmetric ? cv::CALIB_CB_SYMMETRIC_GRID : cv::CALIB_CB_ASYMMETRIC_GRID);
        if (cv::findCirclesGrid(points, cv::Size(board.size[0], board.size[1]), found, flags,
                                cv::Ptr<cv::Feature2D>())) {
            grid.clear();
            for (size_t k = 0; k < found.size(); k++) {
                Point p;
                p.at = {found[k].x, found[k].y};
                grid[board.at[k]] = p;
            }
            make_right_handed(grid);
        }
    }
    if (board.kind == Kind::sleeve)
        for (auto &[site, point] : grid)
            point.code = has_hole(image, blobs, point.at);
    // Printed with another radius than the target says, or described with a guessed one: measure what is there, and
    // tell.
    Board real = board;
    const double radius = seen_radius(board, grid, blobs);
    const bool other = radius > 0 && std::abs(radius / board.radius - 1.0) > 0.15;
    if (radius > 0)
        real.radius = radius;
    Detection out = from_grid(image, real, grid, {});
    if (other && out.status != Status::none) {
        char text[96];
        std::snprintf(text, sizeof text, "the discs' radius is about %.2g mm, not %.2g mm", 1e3 * radius,
                      1e3 * board.radius);
        out.reason += (out.reason.empty() ? "" : "; ") + std::string(text);
    }
    return out;
}

Detection find_charuco(const cv::Mat &image, const Board &board)
{
    Detection out;
    const int side = board.marker_bits;
    cv::Mat bytes;
    for (const Marker &m : board.markers) {
        const cv::Mat bits(side, side, CV_8U, const_cast<uint8_t *>(m.bits.data()));
        bytes.push_back(cv::aruco::Dictionary::getByteListFromBits(bits));
    }
    const auto dictionary = cv::makePtr<cv::aruco::Dictionary>(bytes, side, board.marker_errors);
    const auto parameters = cv::aruco::DetectorParameters::create();
    parameters->adaptiveThreshWinSizeMax = 53;
    parameters->minMarkerPerimeterRate = 0.01;
    parameters->polygonalApproxAccuracyRate = 0.06;
    std::vector<std::vector<cv::Point2f>> quads;
    std::vector<int> ids;
    cv::aruco::detectMarkers(image, dictionary, quads, ids, parameters);
    if (ids.empty()) {
        out.reason = "no target found: none of its markers is seen (is the dictionary right?)";
        return out;
    }
    // A marker's corners carry the corners of the squares around it: its four diagonal neighbours' shared corners are
    // those of its own square, a bit further out.
    const double half = board.step_i.norm() / 2;
    std::map<Site, std::pair<Eigen::Vector2d, int>> sums;
    for (size_t k = 0; k < ids.size(); k++) {
        const Eigen::Vector2d middle = board.markers[size_t(ids[k])].middle;
        const double m = board.marker_side / 2;
        const std::vector<cv::Point2f> flat = {
            {float(-m), float(-m)}, {float(m), float(-m)}, {float(m), float(m)}, {float(-m), float(m)}};
        const cv::Matx33d h = cv::getPerspectiveTransform(flat, quads[k]);
        const double x = h(0, 0) * h(1, 1) - h(0, 1) * h(1, 0);
        if (x == 0.0)
            continue;
        for (const double sy : {-1.0, 1.0})
            for (const double sx : {-1.0, 1.0}) {
                const Eigen::Vector2d on = middle + half * Eigen::Vector2d(sx, sy);
                const cv::Vec3d q = h * cv::Vec3d(sx * half, sy * half, 1.0);
                for (size_t p = 0; p < board.flat.size(); p++)
                    if ((board.flat[p] - on).norm() < 0.1 * half) {
                        auto &[sum, count] = sums[board.at[p]];
                        sum = count ? Eigen::Vector2d(sum + Eigen::Vector2d(q[0] / q[2], q[1] / q[2]))
                                    : Eigen::Vector2d(q[0] / q[2], q[1] / q[2]);
                        count++;
                    }
            }
    }
    Placed placed;
    Grid rough;
    for (const auto &[site, value] : sums)
        rough[site].at = value.first / value.second;
    for (const auto &[site, point] : rough) {
        const auto f = forecast(rough, site, 0, true);
        if (!f)
            continue;
        if (const auto p = measure_point(image, board, point.at, f->cell, board.code[size_t(id_at(board, site))]))
            placed.grid[site] = *p;
    }
    if (rough.size() >= 6 && 4 * placed.grid.size() < rough.size()) {
        out.reason = "its markers are seen, but no squares' corners where the target has them: another grid, or legacy "
                     "(OpenCV before 4.6) is the other way";
        return out;
    }
    finish(image, board, placed, out);
    return out;
}

} // namespace

Detection find_target(const cv::Mat &image, const Board &board)
{
    if (board.kind == Kind::charuco)
        return find_charuco(image, board);
    return board.discs() ? find_discs(image, board) : find_checkerboard(image, board);
}

} // namespace pipefish::detect
