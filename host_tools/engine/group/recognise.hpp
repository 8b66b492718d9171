// Recognition of specific objects: a model's picture against a scene, by how much of the model is matched by groups.
#pragma once

#include "group/support.hpp"
#include "match/region.hpp"

#include <cmath>

namespace pipefish::group
{

// A picture made ready once, for many pairs: cropped to its mask, made smaller where it is large, regions described.
class Prepared
{
public:
    // mask: empty for the whole picture, else of its size, where the object is. Throws std::invalid_argument for a mask
    // that covers less than 100 pixels of what remains. Pictures of more than max_pixels are made smaller.
    Prepared(const match::Image &image, const Mask &mask, int max_pixels, int regions);

    const match::ScaleStack &stack() const { return stack_; }
    const match::Described &regions() const { return regions_; }
    const Mask &mask() const { return mask_; }         // 255 everywhere without a mask
    const Mask &textured() const { return textured_; } // of the mask
    double area() const { return area_; }              // pixels of the mask
    cv::Point2d in_picture(cv::Point2d p) const;       // from here to the picture that was given

private:
    struct Cut;
    explicit Prepared(const Cut &cut, int regions);

    cv::Point2d offset_;
    double scale_;
    Mask mask_, textured_;
    double area_;
    match::ScaleStack stack_;
    match::Described regions_;
};

struct Segment {
    double score = 0;       // area * coverage * correlation
    double area = 0;        // of the support, as a share of the model
    double coverage = 0;    // matched share of the textured pixels of the support, counted in the coarser image
    double correlation = 0; // mean of (zncc - 0.5) / 0.5
    double evidence = 0;    // that it is no chance, see evidence()
    int matches = 0;
    cv::Point2d centre;                                 // of its support in the scene
    std::vector<std::vector<cv::Point2d>> model, scene; // outlines, pixels of the pictures that were given
};

// Where a rigid object as a whole can be in the scene, pixels of the picture that was given.
struct Place {
    cv::Point2d centre;
    double radius = 0;
    bool has(cv::Point2d p) const { return std::hypot(p.x - centre.x, p.y - centre.y) <= radius; }
};

struct Recognition {
    int seeds = 0, matches = 0; // before grouping
    // Sum over `segments` of what counts of them, at most 1; without any: of the most evident group, at most `least`,
    // so that it ranks what is absent and nothing more.
    double score = 0;
    std::vector<Segment> segments; // largest score first; none overlaps a better one by half, all are in `place`
    Place place;                   // by the best segment's map
    // The model's own outline carried into the scene by the affine map that fits the matches of all segments: where all
    // of the object would be.
    std::vector<std::vector<cv::Point2d>> extent;
};

struct RecogniseOptions {
    match::Options growth;
    Options grouping;
    int seeds = 300;
    double least = 0.002; // score of a segment
    // From which a group counts in full, set on judged pictures: some 20 form by chance in a pair, the best of all
    // had 4. Its score counts by the factor exp(what it lacks).
    double evidence = 6;
    // Vertices of a segment, and pixels matched for each. Of what is smaller there is one at most, where it is evident
    // and nothing larger is: beside a larger one it is as likely on another side of the object, or where its
    // print repeats, and turns the map of the whole.
    int vertices = 30;
    double matches = 12.5;
    double reach = 3; // pixels of the coarser image by which supports go beyond their triangles
};

Recognition recognise(const Prepared &model, const Prepared &scene, const RecogniseOptions &options);

} // namespace pipefish::group
