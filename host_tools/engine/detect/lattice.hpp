// Candidates become a grid: who is whose neighbour, which point of the target each one is, and where the next must be.
#pragma once

#include "board.hpp"
#include "candidates.hpp"

#include <array>
#include <functional>
#include <map>
#include <optional>
#include <vector>

namespace pipefish::detect
{

using Site = std::array<int, 2>; // a place on a lattice

struct Point { // measured, or good enough to start measuring from
    Eigen::Vector2d at = Eigen::Vector2d::Zero();
    Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();
    int code = 0; // as Board::code
};

using Grid = std::map<Site, Point>;

// The largest grid among corners: neighbours lie along each other's edges with dark and light on the right sides. From
// a site's +i to its +j one turns from x to y on the screen.
Grid grid_of_corners(const cv::Mat &image, const std::vector<Corner> &corners);

// The largest grid among blobs, grown from a blob and its nearest neighbours. The lattice's base may be any that spans
// the same lattice.
Grid grid_of_blobs(const std::vector<Blob> &blobs);

// Where a grid lies on a board.
struct Placement {
    std::array<int, 4> matrix = {1, 0, 0, 1}; // site on the board = matrix * site + shift
    Site shift = {0, 0};
    int hits = 0;  // sites that are points of the board, in the right colours or marks
    int turns = 1; // in which the whole board looks the same
    int ways = 1;  // to lay the grid that explain the picture as well, these turns included
    bool mirrored = false;

    Site operator()(const Site &s) const
    {
        return {matrix[0] * s[0] + matrix[1] * s[1] + shift[0], matrix[2] * s[0] + matrix[3] * s[1] + shift[1]};
    }
};

// The placement with the most hits; of several the one that reads most like text. What counts against one
// are points of the board at `absent` sites: those beside the grid where the picture shows no point though it could.
// None without a hit.
std::optional<Placement> place_grid(const Grid &grid, const std::vector<Site> &absent, const Board &board);

// How many points a row of the grid has, and how many rows there are, in the base in which it fills its rows best, and
// without outer rows that are not half filled: the size of the target that is seen, or of the part of it.
std::array<int, 2> extent(const Grid &grid, const Board &board);

// Where a site is, from its neighbours within three steps: quadratic as far as they determine it.
struct Forecast {
    Eigen::Vector2d at;
    Eigen::Matrix2d cell; // pixels by one step along i (column 0) and j
};
// columns: where the lattice closes along i; 0: nowhere.
std::optional<Forecast> forecast(const Grid &grid, const Site &site, int columns, bool with_itself);

// Measures what lies beside the grid, again and again, until nothing more is found. `wanted` tells which sites may be
// points; `measure` looks there. Returns the sites where it found nothing.
std::vector<Site> grow(Grid &grid, int columns, const std::function<bool(const Site &)> &wanted,
                       const std::function<std::optional<Point>(const Forecast &, const Site &)> &measure);

} // namespace pipefish::detect
