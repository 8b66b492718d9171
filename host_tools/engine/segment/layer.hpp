// A layer: what both pictures show of one surface, and the fields that carry it from each to the other.
#pragma once

#include "segment/lattice.hpp"
#include "segment/picture.hpp"

namespace pipefish::segment
{

struct Options {
    int layers = 12;     // the most to start from
    int rounds = 6;      // of refinement
    double edge = 3;     // cost of a boundary, nats a pixel along the grid
    double lonely = 1;   // cost of a pixel whose place in the other picture is not the same layer's, nats
    double layer = 1000; // cost of a layer, nats
    double spacing = 16; // of displacement's grid, pixels; halved once layers are merged
    double bend = 1;     // stiffness of displacement: nats for a second difference of a pixel between grid points
    double light = 200;  // stiffness of gain and offset: nats for a difference of 1 between grid points, halved
    double reach = 40;   // pixels beyond its matches in which a layer may be
    int least = 400;     // pixels of a layer that is reported
    int threads = 1;
};

inline constexpr double kUnit = 1000; // costs are in thousandths of a nat, whole numbers

// A match seen from one picture; it stands for `weight` matches.
struct Tie {
    Vector2d at, to;
    double weight;
    bool free = false; // of no group: a layer may take it, and let it go
};

// One picture of a layer: from here to the other picture.
struct Side {
    const Picture *here = nullptr, *there = nullptr;
    std::vector<Tie> ties;
    double scale = 1;                      // pixels of the other picture for one of this, along a line
    cv::Mat_<uint8_t> reach;               // of the box: within reach of a tie
    Warp warp;                             // to the other picture
    std::shared_ptr<const Factor> similar; // of its normal equations, at some time
    Lattice light; // gain and offset, bilinear: the grid point (i, j) is at box + spacing (i, j)
    std::vector<Eigen::VectorXd> gain, offset; // a channel; colour here = gain * colour there + offset
    std::vector<double> sigma;                 // of a channel's residual

    const cv::Rect &box() const { return warp.lattice.box; }
    // The pictures' planes, blurred so that both have the resolution of the coarser.
    const Image &plane_here(size_t channel) const { return here->plane(channel).for_step(1 / scale); }
    const Image &plane_there(size_t channel) const { return there->plane(channel).spline_for_step(scale); }
};

// What a side says about each pixel of its box.
struct Evidence {
    cv::Mat_<cv::Vec2f> flow;  // place in the other picture
    cv::Mat_<int32_t> cost;    // of the layer here less that of the background, thousandths of a nat, or kNever
    std::vector<Image> warped; // planes of the other picture, brought here, as they are there; 0 where that is no place
    std::vector<Image> off;    // what a plane here is above them, relit
    Image informed;            // 0..1: how much texture there is to tell motions apart
    Image fits;                // 0..1: probability of being seen in both, given the layer
    Image zncc;
    int folds = 0; // pixels in reach where the field folds

    bool possible(int y, int x) const { return cost(y, x) < Problem::kNever; }
};

Evidence look(const Side &side);
// The same where only light, or only sigma, is not what it was. What others share is left to them.
void look_relit(const Side &side, Evidence &seen);
void look_likely(const Side &side, Evidence &seen);

// Gain and offset at a pixel.
struct Light {
    double gain, offset;
};
Light light_at(const Side &side, size_t channel, int x, int y);

// Labels of a picture, as an image.
using LabelImage = cv::Mat_<uint8_t>;

struct Layer {
    Side side[2];
    Evidence seen[2];
    std::vector<int> groups; // it was made from
};

// Parts of the energy, nats. Of the pixels with label k: their own costs, and those of being alone.
double data_energy(const Evidence &seen, const cv::Rect &box, int k, const LabelImage &here, const LabelImage &there,
                   double lonely);
// Of the fields: stiffness, and how far ties are from where they should be; `ties` weighs these.
double shape_energy(const Side &side, const Options &options, double ties);
double light_energy(const Side &side, const Options &options);
// How far places are from themselves after the way there and back, at the ties of both sides.
double round_trip_energy(const Side &one, const Side &other);

// What a match (picture 1, picture 2) would add to these if it were among the layer's; infinite out of reach.
double tie_energy(const Layer &layer, const Tie &tie, double ties);

// Units in which a distance in a side's own picture and in the other is measured: pixels of the coarser of the two.
inline double unit_here(const Side &side)
{
    return std::max(1.0, 1 / side.scale);
}
inline double unit_there(const Side &side)
{
    return std::max(1.0, side.scale);
}

inline constexpr double kRoundTrip = 0.5; // weight of a round trip, of a tie's own
double huber(double distance);            // cost of a distance in units
double huber_weight(double distance);     // its slope over the distance

} // namespace pipefish::segment
