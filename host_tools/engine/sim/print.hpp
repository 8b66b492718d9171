// What is on a sheet: a print of hard-edged shapes, exact at any magnification, or a raster.
#pragma once

#include <cstdint>
#include <variant>
#include <vector>

namespace pipefish::sim
{

// An axis-aligned rectangle or an ellipse with axes along a and b: middle and half sizes in metres.
struct Figure {
    bool round = false;
    double a = 0.0, b = 0.0, half_a = 0.0, half_b = 0.0, albedo = 0.0;
};

// Figures on a ground of one albedo; a later one lies on the earlier ones. Coordinates as on the sheet.
class Print
{
public:
    Print(std::vector<Figure> figures, double ground);

    double albedo(double a, double b) const;
    // Whether no figure's edge may run through the rectangle [a0, a1] x [b0, b1]. Never true if one does.
    bool plain(double a0, double a1, double b0, double b1) const;

private:
    void cells(double a0, double a1, double b0, double b1, int range[4]) const;

    std::vector<Figure> figures_;
    double ground_;
    double a0_ = 0.0, b0_ = 0.0, step_a_ = 1.0, step_b_ = 1.0; // of the grid over all figures
    int columns_ = 1, rows_ = 1;
    std::vector<std::vector<int>> grid_; // figures that touch a cell, in their order
};

// Albedos, rows x columns, stretched over the sheet: u, v in [-1, 1] are its outer edges.
class Raster
{
public:
    Raster(std::vector<float> texels, int rows, int columns);

    int rows() const { return levels_[0].rows; }
    int columns() const { return levels_[0].columns; }
    // Bilinear, from the level whose texels are not larger than `step` texels of the finest one.
    double albedo(double u, double v, double step) const;

private:
    struct Level {
        int rows, columns;
        std::vector<float> texels;
    };
    static double read(const Level &level, double u, double v);

    std::vector<Level> levels_; // halved again and again
};

using Texture = std::variant<Print, Raster>;

// A texture that is rich at every scale and band-limited: smooth noise in octaves and scattered soft-edged blots.
// Values 0.05 to 0.95.
struct PatternSpec {
    uint64_t seed = 1;
    int rows = 512, columns = 512;
    double coarse = 128.0, fine = 6.0; // texels: wavelengths of the coarsest and the finest octave
    double fall = 0.85;                // amplitude of each octave to that of the next coarser
    double contrast = 0.18;            // standard deviation of the noise
    double blots = 0.6;                // share of the area that blots cover, before they hide each other
};
std::vector<float> draw_pattern(const PatternSpec &spec);

} // namespace pipefish::sim
