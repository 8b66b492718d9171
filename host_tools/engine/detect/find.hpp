// Finding a calibration target in a picture, and measuring its points.
#pragma once

#include "board.hpp"
#include "pipefish/camera.h"

#include <opencv2/core.hpp>

#include <string>
#include <vector>

namespace pipefish::detect
{

enum class Status {
    complete,  // all points of the target
    partial,   // some of them
    ambiguous, // some of them, and it cannot be told which: the numbers are right up to a shift along the board
    none,      // no target, or not this one
};

struct Detection {
    Status status = Status::none;
    std::string reason;   // in plain words: what is missing, or why there is nothing
    std::vector<int> ids; // numbers of the target's points, ascending
    std::vector<Eigen::Vector2d> pixels;
    std::vector<Eigen::Matrix2d> covariance;            // pixels^2
    std::vector<std::vector<Eigen::Vector2d>> outlines; // of discs: points on the rim, pixels
    int turns = 1;         // orderings that look the same; the one that reads most like text is given
    bool mirrored = false; // the target is seen as in a mirror
    std::array<int, 2> seen = {0,
                               0}; // points in a row and rows of the grid in the picture, whatever the target; 0: none
};

constexpr int kOutlinePoints = 32;

// From the picture alone. image: 8 bits, one channel. Finds the whole target or a part of it.
Detection find_target(const cv::Mat &image, const Board &board);

// With a camera and the target's pose (cam_from_target): measures each point where the model says it must be, in a
// window and by tests that follow the model's local map, near to the rim of the picture and beyond 90 degrees.
Detection find_target_guided(const cv::Mat &image, const Board &board, const pf_camera &camera,
                             const Eigen::Matrix<double, 3, 4> &pose);

} // namespace pipefish::detect
