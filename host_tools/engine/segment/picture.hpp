// A picture made ready for segmentation: its colour planes, how common its colours are, where its edges are.
#pragma once

#include "segment/colours.hpp"
#include "segment/expand.hpp"

#include <deque>

namespace pipefish::segment
{

// Least deviation of a layer's colours from one picture to the other, of 1: what a smooth field cannot follow is more
// than a camera's noise.
inline constexpr double kLeastNoise = 0.02;

// Neighbouring pixels of different labels cost `cost` where colours are alike and down to a tenth where they differ.
Grid grid_of(const std::vector<Image> &planes, double cost);

class Picture
{
public:
    explicit Picture(const std::vector<Image> &planes); // one or three of the same size, 0..1

    size_t channels() const { return planes_.size(); }
    cv::Size size() const { return rarity_.size(); }
    const match::ScaleStack &plane(size_t channel) const { return planes_[channel]; }
    // The share of a plane in the grey picture.
    double grey(size_t channel) const;
    // -log of the density of a pixel's colour among those of the picture and of its surroundings: what the background
    // explains it by.
    const Image &rarity() const { return rarity_; }

    Grid grid(double cost) const; // as grid_of

private:
    std::deque<match::ScaleStack> planes_;
    Image rarity_;
};

} // namespace pipefish::segment
