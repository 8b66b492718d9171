// Dense segmentation of two pictures into layers that move, bend and are lit each in its own way (after Kannala, Rahtu,
// Brandt and Heikkila, CVPR workshop 2009; energy and constants are this project's).
#pragma once

#include "group/group.hpp"
#include "segment/layer.hpp"

#include <functional>
#include <string>

namespace pipefish::segment
{

// A layer as it is reported. Index 0: in picture 1, 1: in picture 2. Fields are of a whole picture, NaN where the layer
// cannot be.
struct Found {
    int area[2] = {0, 0};
    std::vector<int> groups;               // it was made from
    int claimed = 0;                       // matches of no group, of each fourth that was asked, that it took
    cv::Mat_<cv::Vec2f> flow[2];           // place in the other picture
    std::vector<Image> gain[2], offset[2]; // a channel: colour here = gain * colour there + offset
    Image warped[2][3];                    // the other picture's planes brought here, relit
    double sigma[2] = {0, 0};              // deviation of colour from what the other picture has, rms of the channels
    double zncc[2] = {0, 0};               // mean over the layer's textured pixels
    int folds[2] = {0, 0};                 // pixels in reach where the field folds
    double low_evidence[2] = {0, 0};       // share of pixels that hang on their neighbours: evidence below one nat
    double ambiguous[2] = {0, 0};          // share of pixels whose place in the other picture is another layer's
};

struct Step {
    std::string name;
    double energy; // nats; never above the one before, but two steps define it anew, lower
    int layers;
};

struct Result {
    LabelImage labels[2];      // 0: background
    std::vector<Found> layers; // label k is layers[k - 1]; largest first
    std::vector<Step> trace;
};

// planes: one or three of each picture, values 0..1. `progress` is told the share that is done. Depends on the
// pictures, matches and groups alone, never on options.threads. Throws std::invalid_argument for pictures that do not
// go together. Time: about 10 s for two pictures of 640 x 480 and four layers.
Result segment(const std::vector<Image> (&planes)[2], const std::vector<match::Match> &matches,
               const group::Groups &groups, const Options &options, const std::function<void(double)> &progress);

} // namespace pipefish::segment
