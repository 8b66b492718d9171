// The minimum of a submodular function of binary variables, by a cut of a graph.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::segment
{

// Costs are whole numbers, so that a minimum is a minimum, not one up to rounding. May be used again after start().
class Cut
{
public:
    // A function of so many variables, 0 everywhere.
    void start(int variables);

    // Adds `zero` where variable i is 0, `one` where it is 1.
    void add(int i, int64_t zero, int64_t one)
    {
        constant_ += zero;
        node(i).term += one - zero;
    }

    // Adds c[2 i + j] where the variables are i and j; c[0] + c[3] <= c[1] + c[2], a difference below 2^31, or
    // std::invalid_argument. `flow` is a guess of what will flow from i to j, as in a similar function: a good one
    // saves time, and none changes the minimum. Returns the pair's number.
    int add(int i, int j, const int64_t (&c)[4], int32_t flow = 0);

    // Of a pair: what flows from i to j, after solve().
    int32_t flow(int pair) const { return arcs_[2 * static_cast<size_t>(pair)].filled; }

    // What it comes to where all variables are 0; before solve().
    int64_t all_zero() const { return constant_; }

    // Finds the minimum; one() tells where it is: of several minima the one with the fewest zeros. Once after start().
    int64_t solve();
    bool one(int i) const { return nodes_[static_cast<size_t>(i)].tree != kSource; }

private:
    enum Tree : uint8_t { kFree, kSource, kSink };
    static constexpr int kNone = -1, kRoot = -2, kOrphan = -3; // instead of an arc

    struct Node {
        int64_t term = 0;   // paid where this is 1, less what is paid where it is 0; of which what may still flow
        int first = kNone;  // of its arcs
        int parent = kNone; // arc to its parent
        int time = 0;       // when `distance` was known
        int distance = 0;   // arcs to the root, about
        Tree tree = kFree;
        bool active = false;
    };
    struct Arc { // arcs k and k ^ 1 are the same line, there and back
        int to, next;
        int32_t room;   // what may still flow
        int32_t filled; // what flows
    };

    Node &node(int k) { return nodes_[static_cast<size_t>(k)]; }
    Arc &arc(int k) { return arcs_[static_cast<size_t>(k)]; }
    // What may still flow along an arc's line in the way of a tree: from its nodes outwards, or towards them.
    int32_t outwards(Tree tree, int k) { return arc(tree == kSource ? k : k ^ 1).room; }
    int32_t inwards(Tree tree, int k) { return arc(tree == kSource ? k ^ 1 : k).room; }
    void activate(int k);
    int grow(int p);
    template <typename Visit> int climb(int from, const Visit &visit);
    void augment(int touching);
    int distance(int from);
    void adopt(int p);

    int64_t constant_ = 0, flow_ = 0;
    std::vector<Node> nodes_;
    std::vector<Arc> arcs_;
    std::vector<int> active_, orphans_; // queues
    int time_ = 0;
};

} // namespace pipefish::segment
