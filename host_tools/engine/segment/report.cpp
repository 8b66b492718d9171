// What is reported of a state: layers of some size, largest first, with their fields over whole pictures.
#include "segment/state.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace pipefish::segment
{

namespace
{

constexpr float kNone = std::numeric_limits<float>::quiet_NaN();
constexpr int kSpeck = 50; // pixels: a smaller piece of a label is what surrounds it

// The label that most pixels beside a piece have.
int surroundings(const LabelImage &labels, const cv::Mat_<int> &pieces, int piece, const cv::Rect &box)
{
    int votes[256] = {};
    for (int y = box.y; y < box.br().y; y++)
        for (int x = box.x; x < box.br().x; x++)
            for (const cv::Point step : {cv::Point(1, 0), cv::Point(-1, 0), cv::Point(0, 1), cv::Point(0, -1)}) {
                const cv::Point at = cv::Point(x, y) + step;
                if (pieces(y, x) == piece && at.inside({{0, 0}, labels.size()}) && pieces(at) != piece)
                    votes[labels(at)]++;
            }
    return static_cast<int>(std::max_element(std::begin(votes), std::end(votes)) - std::begin(votes));
}

// Fields of a side over the whole picture.
void spread(const Side &side, const Evidence &seen, size_t s, Found &out)
{
    const cv::Rect &box = side.box();
    const size_t channels = side.gain.size();
    out.flow[s] = cv::Mat_<cv::Vec2f>(side.here->size(), cv::Vec2f(kNone, kNone));
    for (size_t c = 0; c < channels; c++) {
        out.gain[s].emplace_back(side.here->size(), kNone);
        out.offset[s].emplace_back(side.here->size(), kNone);
        out.warped[s][c] = Image(side.here->size(), kNone);
    }
    for (int y = 0; y < box.height; y++)
        for (int x = 0; x < box.width; x++) {
            if (seen.cost(y, x) >= Problem::kNever)
                continue;
            const cv::Point at(box.x + x, box.y + y);
            out.flow[s](at) = seen.flow(y, x);
            for (size_t c = 0; c < channels; c++) {
                const Light light = light_at(side, c, at.x, at.y);
                out.gain[s][c](at) = static_cast<float>(light.gain);
                out.offset[s][c](at) = static_cast<float>(light.offset);
                out.warped[s][c](at) = static_cast<float>(light.gain * seen.warped[c](y, x) + light.offset);
            }
        }
}

void measure(const Side &side, const Evidence &seen, int k, const LabelImage &here, const LabelImage &there, size_t s,
             Found &out)
{
    const cv::Rect &box = side.box();
    double textured = 0, zncc = 0;
    int low = 0, other = 0, pixels = 0;
    for (int y = 0; y < box.height; y++)
        for (int x = 0; x < box.width; x++) {
            if (here(box.y + y, box.x + x) != k || seen.cost(y, x) >= Problem::kNever)
                continue;
            pixels++;
            textured += seen.informed(y, x);
            zncc += seen.informed(y, x) * seen.zncc(y, x);
            low += std::abs(seen.cost(y, x)) < kUnit;
            const int at = there(static_cast<int>(std::lround(seen.flow(y, x)[1])),
                                 static_cast<int>(std::lround(seen.flow(y, x)[0])));
            other += at != 0 && at != k;
        }
    double variance = 0;
    for (const double sigma : side.sigma)
        variance += sigma * sigma / static_cast<double>(side.sigma.size());
    out.area[s] = pixels;
    out.sigma[s] = std::sqrt(variance);
    out.zncc[s] = zncc / std::max(textured, 1e-9);
    out.folds[s] = seen.folds;
    out.low_evidence[s] = low / std::max(1.0, static_cast<double>(pixels));
    out.ambiguous[s] = other / std::max(1.0, static_cast<double>(pixels));
}

} // namespace

LabelImage State::without_specks(size_t s) const
{
    LabelImage out = labels_[s].clone();
    for (int label = 0; label <= static_cast<int>(layers_.size()); label++) {
        cv::Mat_<int> pieces, stats;
        cv::Mat centres;
        const int count = cv::connectedComponentsWithStats(labels_[s] == label, pieces, stats, centres);
        for (int piece = 1; piece < count; piece++) {
            const cv::Rect box(stats(piece, cv::CC_STAT_LEFT), stats(piece, cv::CC_STAT_TOP),
                               stats(piece, cv::CC_STAT_WIDTH), stats(piece, cv::CC_STAT_HEIGHT));
            if (stats(piece, cv::CC_STAT_AREA) >= kSpeck)
                continue;
            const int heir = surroundings(labels_[s], pieces, piece, box);
            for (int y = box.y; y < box.br().y; y++)
                for (int x = box.x; x < box.br().x; x++)
                    if (pieces(y, x) == piece)
                        out(y, x) = static_cast<uint8_t>(possible(heir, s, {x, y}) ? heir : 0);
        }
    }
    return out;
}

bool State::possible(int label, size_t s, cv::Point at) const
{
    if (label == 0)
        return true;
    const Layer &layer = layers_[static_cast<size_t>(label) - 1];
    const cv::Rect &box = layer.side[s].box();
    return box.contains(at) && layer.seen[s].cost(at - box.tl()) < Problem::kNever;
}

Result State::result() const
{
    Result out;
    const LabelImage labels[2] = {without_specks(0), without_specks(1)};
    std::vector<int> area(layers_.size() * 2, 0);
    for (size_t s = 0; s < 2; s++)
        for (const uint8_t label : labels[s])
            if (label > 0)
                area[2 * (label - size_t{1}) + s]++;
    std::vector<size_t> order(layers_.size());
    std::iota(order.begin(), order.end(), size_t{0});
    std::erase_if(order, [&](size_t k) { return std::min(area[2 * k], area[2 * k + 1]) < options_.least; });
    std::stable_sort(order.begin(), order.end(),
                     [&](size_t a, size_t b) { return area[2 * a] + area[2 * a + 1] > area[2 * b] + area[2 * b + 1]; });
    std::vector<uint8_t> label(layers_.size() + 1, 0);
    for (size_t k = 0; k < order.size(); k++)
        label[order[k] + 1] = static_cast<uint8_t>(k + 1);
    for (size_t s = 0; s < 2; s++) {
        out.labels[s] = labels[s].clone();
        for (uint8_t &l : out.labels[s])
            l = label[l];
    }
    for (size_t k = 0; k < order.size(); k++) {
        const Layer &layer = layers_[order[k]];
        Found found;
        found.groups = layer.groups;
        found.claimed = static_cast<int>(
            std::count_if(layer.side[0].ties.begin(), layer.side[0].ties.end(), [](const Tie &t) { return t.free; }));
        for (size_t s = 0; s < 2; s++) {
            spread(layer.side[s], layer.seen[s], s, found);
            measure(layer.side[s], layer.seen[s], static_cast<int>(k) + 1, out.labels[s], out.labels[1 - s], s, found);
        }
        out.layers.push_back(std::move(found));
    }
    return out;
}

} // namespace pipefish::segment
