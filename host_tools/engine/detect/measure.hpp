// What finding from the picture alone and finding by a model have in common: one point measured.
#pragma once

#include "board.hpp"
#include "disc.hpp"
#include "find.hpp"
#include "lattice.hpp"

#include <optional>

namespace pipefish::detect
{

// What a disc should look like; cell as below.
DiscSetup disc_setup(const Board &board, const Eigen::Matrix2d &cell);

// Measures the point of the board expected at `at`. cell: pixels by a step along the lattice of the board. code: what
// the board has there; -1: not known. Nothing where the picture has no such point.
std::optional<Point> measure_point(const cv::Mat &image, const Board &board, const Eigen::Vector2d &at,
                                   const Eigen::Matrix2d &cell, int code);

// The same, first looking for it within 0.45 steps around `at` in a patch that is warped onto the board.
std::optional<Point> search_point(const cv::Mat &image, const Board &board, const Eigen::Vector2d &at,
                                  const Eigen::Matrix2d &cell, int code);

// Fills ids, pixels, covariance and outlines from points by their numbers on the board, with the lattice's steps there.
struct Measured {
    int id;
    Point point;
    Eigen::Matrix2d cell;
};
void report(const cv::Mat &image, const Board &board, const std::vector<Measured> &points, Detection &out);

} // namespace pipefish::detect
