// Labels of the pixels of two images at once, by alpha-expansion (Boykov, Veksler and Zabih, 2001).
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::segment
{

using Labels = std::vector<uint8_t>;

// A labelling problem. Pixels of both images are nodes 0..n-1; label 0 is the background.
struct Problem {
    static constexpr int32_t kNever = 1'000'000; // a cost that forbids a label

    struct Edge {
        int i, j;
        int32_t cost; // where their labels differ
    };

    std::vector<std::vector<int32_t>> cost;    // [label][node], up to kNever
    std::vector<Edge> edges;                   // between neighbours in the same image
    std::vector<std::vector<int32_t>> partner; // [label][node], label >= 1: where the layer takes it, or -1
    int32_t lonely = 0;                        // where a node has label k >= 1 and its partner by k has another

    size_t nodes() const { return cost[0].size(); }
    int labels() const { return static_cast<int>(cost.size()); }
    int64_t energy(const Labels &labels) const;
};

// The best labelling that differs from `labels` by nodes that take label `alpha`. Returns whether it is better, and
// then changes `labels`.
bool expand_once(const Problem &problem, int alpha, Labels &labels);

// Expands label after label until none gains, at most `cycles` times over.
void expand(const Problem &problem, int cycles, Labels &labels);

} // namespace pipefish::segment
