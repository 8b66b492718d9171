// A calibration target as the detector needs it; pipefish/detect.py fills it from a Target.
#pragma once

#include <Eigen/Dense>

#include <array>
#include <cstdint>
#include <string>
#include <vector>

namespace pipefish::detect
{

enum class Kind { checkerboard, circles, asymmetric_circles, charuco, sleeve };

struct Marker { // of a ChArUco board
    Eigen::Vector2d middle;
    std::vector<uint8_t> bits; // marker_bits x marker_bits, row by row, 1 = white
};

struct Board {
    Kind kind = Kind::checkerboard;
    std::vector<Eigen::Vector2d> flat;  // metres on the sheet laid flat: X right, Y down
    std::vector<std::array<int, 2>> at; // place on the lattice that neighbours span, of each point
    std::vector<uint8_t> code;        // sleeve: 1 where a disc has a hole; checkerboard: 1 where the upper left is dark
    Eigen::Vector2d step_i, step_j;   // metres from a point to its neighbours on the lattice
    std::array<int, 2> size = {0, 0}; // points in a row, rows: for OpenCV's detectors
    double radius = 0.0;              // of discs, metres
    double diameter = 0.0;            // of a sleeve's pipe, metres; 0: flat
    int columns = 0;                  // of a sleeve: its lattice closes after so many
    int marker_bits = 0;              // of a ChArUco marker's side
    int marker_errors = 0;            // bits of one that may be misread
    double marker_side = 0.0;         // metres
    std::vector<Marker> markers;

    bool discs() const { return kind != Kind::checkerboard && kind != Kind::charuco; }
    // Where a point of the sheet is, in the target's frame.
    Eigen::Vector3d place(const Eigen::Vector2d &on_sheet) const;
    // From one point of the sheet to another the short way: around a sleeve there are two.
    Eigen::Vector2d between(const Eigen::Vector2d &from, const Eigen::Vector2d &to) const;
};

} // namespace pipefish::detect
