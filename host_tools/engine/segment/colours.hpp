// How common a colour is among the pixels of a picture or of a part of it.
#pragma once

#include "match/image.hpp"

#include <array>
#include <cstddef>
#include <vector>

namespace pipefish::segment
{

using match::Image;

// A histogram of the colours of one or three planes of the same size, 0..1, `bins` a channel.
class Colours
{
public:
    Colours(const std::vector<Image> &planes, int bins);

    void add(int x, int y, double weight);
    // After the last add(): smooths by a deviation of one bin, and makes the mean density 1.
    void settle();
    // Of a pixel's colour, in units of what it would be if all colours were as common.
    double density(int x, int y) const;

private:
    struct Cell {
        size_t index;
        double weight;
    };
    // The cells around a pixel's colour, 2 or 8 of them.
    size_t cells(int x, int y, std::array<Cell, 8> &out) const;
    void smooth(size_t stride);

    std::vector<Image> planes_;
    int bins_;
    std::vector<double> histogram_;
};

} // namespace pipefish::segment
