// Labels and layers together: their energy, and what changes their number.
#pragma once

#include "segment/fit.hpp"
#include "segment/segment.hpp"

#include <array>
#include <optional>

namespace pipefish::segment
{

class State
{
public:
    State(const std::vector<Image> (&planes)[2], const std::vector<match::Match> &matches, const group::Groups &groups,
          const Options &options);

    double energy() const;
    void refine(int steps);                // fields and noise of all layers
    void relabel(int cycles);              // alpha-expansion
    void claim();                          // matches without a layer, by the layers whose fields are near
    void merge();                          // pairs that are cheaper as one
    void remove();                         // layers that are dearer than the background
    void finer();                          // displacement from now on on a grid of half the spacing
    void trust_pictures() { ties_ = 0.2; } // matches have served: from now on they count for less
    size_t layers() const { return layers_.size(); }
    Result result() const;

private:
    Given given(int k) const { return {labels_, k, ties_}; }
    void refine_one(Layer &layer, const Given &by, int steps) const;
    Problem problem() const;
    bool within_reach(const Layer &a, const Layer &b) const;
    // What boundaries cost, nats: of rows of either picture with the neighbours in and below them.
    double cut(const LabelImage (&labels)[2], const std::array<cv::Range, 2> &rows) const;
    std::array<cv::Range, 2> all_rows() const;
    std::array<cv::Range, 2> rows_of(int label) const;    // whose boundaries change where its pixels get another label
    double unclaimed(const std::vector<Tie> &ties) const; // what those that are free cost where no layer has them
    bool try_remove(int label, int heir);
    std::optional<Layer> merged(size_t a, size_t b) const;  // refined, if that is cheaper than both
    bool try_merge(size_t a);                               // with the first later one with which it is cheaper
    void erase(size_t layer);                               // its labels have gone
    LabelImage without_specks(size_t s) const;              // pieces of few pixels are what surrounds them
    bool possible(int label, size_t s, cv::Point at) const; // whether a pixel may have it

    Options options_;
    Picture pictures_[2];
    Grid grids_[2];             // of the pictures
    std::vector<Layer> layers_; // layer k - 1 has label k
    std::vector<Tie> free_;     // matches of no layer
    LabelImage labels_[2];
    std::vector<Flows> flows_; // of labels, in their last expansions
    double ties_ = 1;
};

} // namespace pipefish::segment
