#include "segment/state.hpp"

#include "group/support.hpp"
#include "parallel.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>

namespace pipefish::segment
{

namespace
{

int32_t units(double nats)
{
    return static_cast<int32_t>(std::lround(kUnit * nats));
}

constexpr double kUnclaimed = 5.5; // what a match costs in a picture where no layer is near it: as one 6 pixels off

// Matches of groups from `first` to before `last`, one of four: they overlap that much.
std::vector<Tie> ties_of(const std::vector<match::Match> &matches, const group::Groups &groups, int first, int last)
{
    constexpr int step = 4;
    std::vector<Tie> out;
    int count = 0;
    for (size_t k = 0; k < matches.size(); k++)
        if (groups.label[k] >= first && groups.label[k] < last && count++ % step == 0)
            out.push_back({Vector2d(matches[k].x, matches[k].y), matches[k].centre.cast<double>(),
                           step * static_cast<double>(matches[k].zncc), first < 0 || last > first + 1});
    return out;
}

// A merger is given up when its first refinement, which wins most, leaves it dearer by more than this share of what
// it won: of those that succeeded the dearest left 0.27.
constexpr double kHopeless = 0.35;

void replace(LabelImage &labels, int from, int to)
{
    labels.setTo(to, labels == from);
}

} // namespace

State::State(const std::vector<Image> (&planes)[2], const std::vector<match::Match> &matches,
             const group::Groups &groups, const Options &options)
    : options_(options), pictures_{Picture(planes[0]), Picture(planes[1])}
{
    for (size_t s = 0; s < 2; s++)
        grids_[s] = pictures_[s].grid(kUnit * options.edge);
    const int count = std::min(groups.count, options.layers);
    layers_.resize(static_cast<size_t>(count));
    pipefish::parallel_for(count, options.threads, [&](int k) {
        Layer &layer = layers_[static_cast<size_t>(k)];
        layer = layer_of(pictures_, ties_of(matches, groups, k, k + 1), options_);
        layer.groups = {k};
    });
    free_ = ties_of(matches, groups, -1, 0);
    const std::vector<Tie> more = ties_of(matches, groups, count, groups.count);
    free_.insert(free_.end(), more.begin(), more.end());
    for (size_t s = 0; s < 2; s++) {
        labels_[s] = LabelImage(pictures_[s].size(), uint8_t{0});
        for (int k = count; k-- > 0;) { // the largest last, over the others
            const Layer &layer = layers_[static_cast<size_t>(k)];
            const group::Side side = s == 0 ? group::Side::kFirst : group::Side::kSecond;
            cv::Mat_<uint8_t> mask = group::support(matches, groups, k, side, labels_[s].size(), 0);
            const cv::Rect &box = layer.side[s].box();
            const cv::Mat_<uint8_t> possible(layer.seen[s].cost < Problem::kNever);
            labels_[s](box).setTo(k + 1, mask(box) & possible);
        }
    }
}

double State::cut(const LabelImage (&labels)[2], const std::array<cv::Range, 2> &rows) const
{
    int64_t sum = 0;
    for (size_t s = 0; s < 2; s++)
        sum += grids_[s].boundary(labels[s].data, rows[s].start, rows[s].end);
    return static_cast<double>(sum) / kUnit;
}

std::array<cv::Range, 2> State::all_rows() const
{
    return {cv::Range(0, labels_[0].rows), cv::Range(0, labels_[1].rows)};
}

std::array<cv::Range, 2> State::rows_of(int label) const
{
    std::array<cv::Range, 2> out;
    for (size_t s = 0; s < 2; s++) {
        const cv::Rect box = cv::boundingRect(labels_[s] == label);
        out[s] = cv::Range(std::max(0, box.y - 1), box.br().y);
    }
    return out;
}

double State::unclaimed(const std::vector<Tie> &ties) const
{
    double sum = 0;
    for (const Tie &t : ties)
        sum += t.free ? 2 * ties_ * t.weight * kUnclaimed : 0;
    return sum;
}

double State::energy() const
{
    double sum = cut(labels_, all_rows());
    sum += unclaimed(free_);
    for (size_t k = 0; k < layers_.size(); k++)
        sum += layer_energy(layers_[k], given(static_cast<int>(k) + 1), options_) + options_.layer;
    return sum;
}

void State::refine_one(Layer &layer, const Given &by, int steps) const
{
    refine_light(layer, by, options_);
    refine_warp(layer, by, options_, steps);
    refine_light(layer, by, options_);
    refine_sigma(layer, by, options_);
}

void State::refine(int steps)
{
    parallel_for(static_cast<int>(layers_.size()), options_.threads,
                 [&](int k) { refine_one(layers_[static_cast<size_t>(k)], given(k + 1), steps); });
}

void State::finer()
{
    options_.spacing /= 2;
    for (Layer &layer : layers_)
        for (Side &side : layer.side)
            side.warp = segment::finer(side.warp), side.similar.reset();
}

void State::claim()
{
    std::erase_if(free_, [&](const Tie &t) {
        double least = 2 * ties_ * t.weight * kUnclaimed;
        Layer *best = nullptr;
        for (Layer &layer : layers_)
            if (const double cost = tie_energy(layer, t, ties_); cost < least)
                least = cost, best = &layer;
        if (best != nullptr) {
            best->side[0].ties.push_back(t);
            best->side[1].ties.push_back({t.to, t.at, t.weight, true});
        }
        return best != nullptr;
    });
    for (Layer &layer : layers_)
        for (size_t s = 0; s < 2; s++)
            look_likely(layer.side[s], layer.seen[s]); // matches speak for their pixels
}

Problem State::problem() const
{
    const size_t first = labels_[0].total(), nodes = first + labels_[1].total();
    Problem out;
    out.grids = {&grids_[0], &grids_[1]};
    out.lonely = units(options_.lonely);
    out.cost.assign(layers_.size() + 1, std::vector<int32_t>(nodes, Problem::kNever));
    out.partner.assign(layers_.size() + 1, std::vector<int32_t>(nodes, -1));
    out.cost[0].assign(nodes, 0);
    for (size_t k = 0; k < layers_.size(); k++)
        for (size_t s = 0; s < 2; s++) {
            const cv::Rect &box = layers_[k].side[s].box();
            const Evidence &seen = layers_[k].seen[s];
            const int here = labels_[s].cols, there = labels_[1 - s].cols;
            const size_t from = s == 0 ? 0 : first;
            const int to = s == 0 ? static_cast<int>(first) : 0;
            for (int y = 0; y < box.height; y++)
                for (int x = 0; x < box.width; x++) {
                    if (seen.cost(y, x) >= Problem::kNever)
                        continue;
                    const size_t node = from + static_cast<size_t>((box.y + y) * here + box.x + x);
                    const cv::Vec2f at = seen.flow(y, x);
                    out.cost[k + 1][node] = seen.cost(y, x);
                    out.partner[k + 1][node] =
                        to + static_cast<int>(std::lround(at[1])) * there + static_cast<int>(std::lround(at[0]));
                }
        }
    return out;
}

void State::relabel(int cycles)
{
    const size_t first = labels_[0].total();
    Labels labels(labels_[0].begin(), labels_[0].end());
    labels.insert(labels.end(), labels_[1].begin(), labels_[1].end());
    expand(problem(), cycles, labels, flows_);
    const auto middle = labels.begin() + static_cast<std::ptrdiff_t>(first);
    std::copy(labels.begin(), middle, labels_[0].begin());
    std::copy(middle, labels.end(), labels_[1].begin());
}

bool State::within_reach(const Layer &a, const Layer &b) const
{
    for (size_t s = 0; s < 2; s++) {
        const Side &one = a.side[s];
        const cv::Rect &box = one.box();
        const bool near = std::any_of(b.side[s].ties.begin(), b.side[s].ties.end(), [&](const Tie &t) {
            const cv::Point at(static_cast<int>(std::lround(t.at.x())), static_cast<int>(std::lround(t.at.y())));
            return box.contains(at) && one.reach(at - box.tl());
        });
        if (!near)
            return false;
    }
    return true;
}

std::optional<Layer> State::merged(size_t a, size_t b) const
{
    const Given of_a = given(static_cast<int>(a) + 1), of_b = given(static_cast<int>(b) + 1);
    LabelImage labels[2] = {labels_[0].clone(), labels_[1].clone()};
    for (LabelImage &l : labels)
        replace(l, of_b.k, of_a.k);
    const std::array<cv::Range, 2> rows = rows_of(of_b.k);
    const double saved = options_.layer + cut(labels_, rows) - cut(labels, rows);
    std::vector<Tie> ties = layers_[a].side[0].ties;
    ties.insert(ties.end(), layers_[b].side[0].ties.begin(), layers_[b].side[0].ties.end());
    Layer both = layer_of(pictures_, ties, options_);
    double shape = -saved - options_.layer; // what refinement may still win
    for (size_t s = 0; s < 2; s++)
        shape += shape_energy(both.side[s], options_, ties_) - shape_energy(layers_[a].side[s], options_, ties_) -
                 shape_energy(layers_[b].side[s], options_, ties_);
    if (shape > 0)
        return {};
    const double before = layer_energy(layers_[a], of_a, options_) + layer_energy(layers_[b], of_b, options_) + saved;
    const Given by{labels, of_a.k, ties_};
    const double fitted = layer_energy(both, by, options_);
    refine_one(both, by, 1);
    const double refined = layer_energy(both, by, options_);
    if (refined - before > kHopeless * (fitted - refined))
        return {};
    refine_one(both, by, 4);
    if (layer_energy(both, by, options_) > before)
        return {};
    both.groups = layers_[a].groups;
    both.groups.insert(both.groups.end(), layers_[b].groups.begin(), layers_[b].groups.end());
    return both;
}

bool State::try_merge(size_t a)
{
    std::vector<size_t> near;
    for (size_t b = a + 1; b < layers_.size(); b++)
        if (within_reach(layers_[a], layers_[b]))
            near.push_back(b);
    for (size_t first = 0; first < near.size();) { // as many at once as there are threads; the first that is cheaper
        const size_t count = std::min(near.size() - first, static_cast<size_t>(options_.threads));
        std::vector<std::optional<Layer>> both(count);
        pipefish::parallel_for(static_cast<int>(count), options_.threads, [&](int k) {
            both[static_cast<size_t>(k)] = merged(a, near[first + static_cast<size_t>(k)]);
        });
        for (size_t k = 0; k < count; k++)
            if (both[k]) {
                const size_t b = near[first + k];
                for (LabelImage &l : labels_)
                    replace(l, static_cast<int>(b) + 1, static_cast<int>(a) + 1);
                layers_[a] = std::move(*both[k]);
                erase(b);
                return true;
            }
        first += count;
    }
    return false;
}

void State::erase(size_t layer)
{
    layers_.erase(layers_.begin() + static_cast<std::ptrdiff_t>(layer));
    if (layer + 1 < flows_.size())
        flows_.erase(flows_.begin() + static_cast<std::ptrdiff_t>(layer) + 1);
    for (LabelImage &labels : labels_)
        for (uint8_t &l : labels)
            l = static_cast<uint8_t>(l - (l > layer + 1));
}

void State::merge()
{
    for (size_t a = 0; a < layers_.size();)
        if (!try_merge(a))
            a++;
}

// Gives the pixels of a layer to another where that can be, else to the background, if that is cheaper.
bool State::try_remove(int label, int heir)
{
    const size_t own = static_cast<size_t>(label) - 1, other = static_cast<size_t>(heir) - 1;
    LabelImage labels[2] = {labels_[0].clone(), labels_[1].clone()};
    bool inherits = heir == 0;
    for (size_t s = 0; s < 2; s++) {
        if (heir > 0) {
            const cv::Rect &box = layers_[other].side[s].box();
            const cv::Mat_<uint8_t> mine(labels_[s](box) == label);
            const cv::Mat_<uint8_t> taken(mine & (layers_[other].seen[s].cost < Problem::kNever));
            labels[s](box).setTo(heir, taken);
            inherits = inherits || cv::countNonZero(taken) > 0;
        }
        replace(labels[s], label, 0);
    }
    if (!inherits)
        return false; // no more than the background does
    const std::array<cv::Range, 2> rows = rows_of(label);
    double gain = layer_energy(layers_[own], given(label), options_) + options_.layer + cut(labels_, rows) -
                  cut(labels, rows) - unclaimed(layers_[own].side[0].ties);
    if (heir > 0)
        gain += layer_energy(layers_[other], given(heir), options_) -
                layer_energy(layers_[other], {labels, heir, ties_}, options_);
    if (gain < 0)
        return false;
    for (size_t s = 0; s < 2; s++)
        labels_[s] = labels[s];
    std::copy_if(layers_[own].side[0].ties.begin(), layers_[own].side[0].ties.end(), std::back_inserter(free_),
                 [](const Tie &t) { return t.free; });
    erase(own);
    return true;
}

void State::remove()
{
    for (int label = static_cast<int>(layers_.size()); label > 0; label--)
        for (int heir = 0; heir <= static_cast<int>(layers_.size()); heir++)
            if (heir != label && try_remove(label, heir))
                break;
}

} // namespace pipefish::segment
