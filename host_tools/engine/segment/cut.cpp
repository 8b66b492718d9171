// Maximum flow after Boykov and Kolmogorov, An Experimental Comparison of Min-Cut/Max-Flow Algorithms for Energy
// Minimization in Vision, PAMI 2004: two trees of arcs that are not full, one from the source and one from the sink,
// grow until they touch; flow along the path that they make cuts branches off, and these look for other parents before
// they are given up. The source is 0, the sink 1: a term above 0 is an arc from the source, one below 0 to the sink.
#include "segment/cut.hpp"

#include <algorithm>
#include <limits>
#include <stdexcept>

namespace pipefish::segment
{

namespace
{

constexpr int kFar = std::numeric_limits<int>::max();

} // namespace

void Cut::start(int variables)
{
    nodes_.assign(static_cast<size_t>(variables), {});
    arcs_.clear();
    constant_ = flow_ = 0;
    time_ = 0;
}

int Cut::add(int i, int j, const int64_t (&c)[4], int32_t flow)
{
    const int64_t sum = c[1] + c[2] - c[0] - c[3];
    if (sum < 0)
        throw std::invalid_argument("a pair of variables costs more where they differ: not submodular");
    if (sum > std::numeric_limits<int32_t>::max())
        throw std::invalid_argument("a pair of variables costs too much for 32 bits");
    const int64_t back = std::clamp<int64_t>(c[2] - c[0], 0, sum); // leaves least to the variables themselves
    constant_ += c[0];
    const int64_t start = std::clamp<int64_t>(flow, -back, sum - back);
    node(i).term += c[2] - c[0] - back - start;
    node(j).term += c[3] - c[2] + back + start;
    const auto k = static_cast<int>(arcs_.size()), filled = static_cast<int>(start);
    arcs_.push_back({j, node(i).first, static_cast<int32_t>(sum - back - start), filled});
    arcs_.push_back({i, node(j).first, static_cast<int32_t>(back + start), -filled});
    node(i).first = k, node(j).first = k + 1;
    return k / 2;
}

int64_t Cut::solve()
{
    int64_t sum = constant_;
    active_.clear();
    for (size_t k = 0; k < nodes_.size(); k++) {
        Node &n = nodes_[k];
        sum += std::min<int64_t>(n.term, 0);
        if (n.term != 0) {
            n.tree = n.term > 0 ? kSource : kSink;
            n.parent = kRoot, n.distance = 1;
            activate(static_cast<int>(k));
        }
    }
    for (size_t first = 0; first < active_.size();) {
        const int p = active_[first];
        if (const int touching = node(p).tree == kFree ? kNone : grow(p); touching != kNone) {
            time_++;
            augment(touching); // p stays first: it may touch more
            for (size_t k = 0; k < orphans_.size(); k++)
                adopt(orphans_[k]);
            continue;
        }
        node(p).active = false;
        if (++first == nodes_.size()) { // those that have been keep no more room than the others
            active_.erase(active_.begin(), active_.begin() + static_cast<std::ptrdiff_t>(first));
            first = 0;
        }
    }
    return sum + flow_;
}

void Cut::activate(int k)
{
    if (!node(k).active) {
        node(k).active = true;
        active_.push_back(k);
    }
}

// Takes p's free neighbours into its tree. Returns an arc from the source's tree to the sink's, or kNone.
int Cut::grow(int p)
{
    const Node &own = node(p);
    for (int k = own.first; k != kNone; k = arc(k).next) {
        if (outwards(own.tree, k) == 0)
            continue;
        const int q = arc(k).to;
        Node &other = node(q);
        if (other.tree == kFree) {
            other.tree = own.tree;
            activate(q);
        } else if (other.tree != own.tree) {
            return own.tree == kSource ? k : k ^ 1;
        } else if (other.time > own.time || other.distance <= own.distance + 1) {
            continue; // it is as near to its root where it is
        }
        other.parent = k ^ 1;
        other.time = own.time, other.distance = own.distance + 1;
    }
    return kNone;
}

// Visits the nodes from `from` to the root of its tree, with their arcs; returns the root.
template <typename Visit> int Cut::climb(int from, const Visit &visit)
{
    for (int k = node(from).parent; k != kRoot; k = node(from).parent) {
        visit(from, k);
        from = arc(k).to;
    }
    return from;
}

// Lets flow what may along the path through an arc between the trees.
void Cut::augment(int touching)
{
    const int ends[2] = {arc(touching ^ 1).to, arc(touching).to};
    int64_t most = arc(touching).room;
    for (const int from : ends) {
        const Tree tree = node(from).tree;
        const int root = climb(from, [&](int, int k) { most = std::min<int64_t>(most, inwards(tree, k)); });
        most = std::min(most, std::abs(node(root).term));
    }
    const auto room = static_cast<int32_t>(most);
    const auto fill = [&](int k) {
        arc(k).room -= room, arc(k).filled += room;
        arc(k ^ 1).room += room, arc(k ^ 1).filled -= room;
    };
    fill(touching);
    orphans_.clear();
    for (const int from : ends) {
        const Tree tree = node(from).tree;
        const int root = climb(from, [&](int p, int k) {
            const int used = tree == kSource ? k ^ 1 : k;
            fill(used);
            if (arc(used).room == 0)
                orphans_.push_back(p);
        });
        node(root).term -= tree == kSource ? most : -most;
        if (node(root).term == 0)
            orphans_.push_back(root);
    }
    std::reverse(orphans_.begin(), orphans_.end()); // nearest to the roots first
    for (const int p : orphans_)
        node(p).parent = kOrphan;
    flow_ += most;
}

// How far a node is from the root of its tree; kFar where it hangs on an orphan.
int Cut::distance(int from)
{
    int sum = 0;
    for (int p = from;; p = arc(node(p).parent).to, sum++) {
        Node &n = node(p);
        if (n.parent == kOrphan)
            return kFar;
        if (n.parent == kRoot)
            n.time = time_, n.distance = 1;
        if (n.time == time_)
            return sum + n.distance;
    }
}

// Finds an orphan the parent that is nearest to the root; else lets it and its children go.
void Cut::adopt(int p)
{
    Node &own = node(p);
    int best = kNone, least = kFar;
    for (int k = own.first; k != kNone; k = arc(k).next) {
        const int q = arc(k).to;
        if (node(q).tree != own.tree || inwards(own.tree, k) == 0)
            continue;
        int far = distance(q);
        if (far == kFar)
            continue;
        if (far < least)
            best = k, least = far;
        for (int n = q; node(n).time != time_; n = arc(node(n).parent).to)
            node(n).time = time_, node(n).distance = far--;
    }
    own.parent = best;
    if (best != kNone) {
        own.time = time_, own.distance = least + 1;
        return;
    }
    for (int k = own.first; k != kNone; k = arc(k).next) {
        const int q = arc(k).to;
        Node &other = node(q);
        if (other.tree != own.tree)
            continue;
        if (inwards(own.tree, k) > 0)
            activate(q);
        if (other.parent == (k ^ 1)) {
            other.parent = kOrphan;
            orphans_.push_back(q);
        }
    }
    own.tree = kFree;
}

} // namespace pipefish::segment
