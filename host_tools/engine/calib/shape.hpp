// The shape of a board that is not quite what was drawn: aspect and shear of the print, the sheet's height over its
// plane and displacements in it as polynomials (products of Legendre polynomials, which barely mix with the pose).
#pragma once

#include <Eigen/Core>

#include <array>
#include <bit>
#include <cstdint>

namespace pipefish::calib
{

// Coefficients, all in units of the board's half size: aspect, shear, height by total degree 2 to 6 (3 + 4 + 5 + 6 +
// 7), then x and y of the displacement in the plane by total degree 2 and 3 (7 each). Constant and linear heights are
// the pose; the overall size is the unit of length.
inline constexpr int kShape = 41;
inline constexpr int kShapeHeight = 2, kShapeInPlane = 27;

struct Shape {
    std::array<double, kShape> coefficient{};
    double centre_x = 0.0, centre_y = 0.0, half = 1.0; // metres: of the drawn points

    // The drawn point where it really is. d (3 x kShape) may be null.
    Eigen::Vector3d at(const Eigen::Vector3d &drawn, Eigen::Matrix<double, 3, kShape> *d) const;

    bool flat() const
    {
        uint64_t bits = 0; // one vectorised pass: asked for every point of a projection
        for (const double c : coefficient) {
            bits |= std::bit_cast<uint64_t>(c) << 1;
        }
        return bits == 0;
    }
};

} // namespace pipefish::calib
