// Labels of the pixels of two images at once, by alpha-expansion (Boykov, Veksler and Zabih, 2001).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::segment
{

using Labels = std::vector<uint8_t>;

// What it costs that neighbouring pixels of an image have different labels.
struct Grid {
    int width = 0;
    // Of each pixel, row by row: with the one right of it, below, below to the right, below to the left; 0 with none.
    std::vector<std::array<int32_t, 4>> cost;

    // How far on the neighbours are, in the order of the costs.
    std::array<int, 4> steps() const { return {1, width, width + 1, width - 1}; }
    // What the boundaries of labels cost, of rows `from` to before `to` with the neighbours in and below them.
    int64_t boundary(const uint8_t *labels, int from, int to) const;
    int height() const { return static_cast<int>(cost.size()) / width; }
};

// A labelling problem. Nodes are the pixels of all images, one after the other; label 0 is the background.
struct Problem {
    static constexpr int32_t kNever = 1'000'000; // a cost that forbids a label

    std::vector<const Grid *> grids;           // of the images
    std::vector<std::vector<int32_t>> cost;    // [label][node], up to kNever
    std::vector<std::vector<int32_t>> partner; // [label][node], label >= 1: where the layer takes it, or -1
    int32_t lonely = 0;                        // where a node has label k >= 1 and its partner by k has another

    size_t nodes() const { return cost[0].size(); }
    int labels() const { return static_cast<int>(cost.size()); }
    int64_t energy(const Labels &labels) const;
};

// The best labelling that differs from `labels` by nodes that take label `alpha`. Returns whether it is better, and
// then changes `labels`.
bool expand_once(const Problem &problem, int alpha, Labels &labels);

// What flowed in the cut of a label's last expansion, from each node to its neighbours and to its two partners: where
// the next cut begins.
using Flows = std::vector<std::array<int32_t, 6>>;

// Expands label after label until none gains, at most `cycles` times over. `flows` of labels are kept up to date; those
// of a similar problem save time, and none change the result.
void expand(const Problem &problem, int cycles, Labels &labels, std::vector<Flows> &flows);

} // namespace pipefish::segment
