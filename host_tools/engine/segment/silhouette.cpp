#include "segment/silhouette.hpp"

#include "segment/picture.hpp"

#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>

namespace pipefish::segment
{

namespace
{

using group::Mask;

constexpr double kSure = 6;         // nats that the place tells at most
constexpr double kColour = 5;       // and the colour
constexpr double kUnit = 1000;      // of a cost, a nat
constexpr double kAnyColour = 0.01; // share of pixels of no colour in particular

// The surroundings of an object, made smaller if they are large.
struct Place {
    cv::Rect box;
    cv::Size size;
    std::vector<Image> planes;
    Mask expected, seen, others;

    Place(const std::vector<Image> &given, const Mask &expected_there, const Mask &seen_there, const Mask &others_there,
          int most)
    {
        Mask both;
        cv::bitwise_or(expected_there, seen_there, both);
        box = cv::boundingRect(both);
        const int margin = 2 + static_cast<int>(0.5 * std::sqrt(cv::countNonZero(both)));
        box = cv::Rect(box.x - margin, box.y - margin, box.width + 2 * margin, box.height + 2 * margin) &
              cv::Rect(0, 0, both.cols, both.rows);
        const double scale = std::min(1.0, std::sqrt(static_cast<double>(most) / box.area()));
        size = {std::max(2, static_cast<int>(box.width * scale)), std::max(2, static_cast<int>(box.height * scale))};
        const auto cut = [&](const auto &image, int how) {
            std::remove_cvref_t<decltype(image)> out;
            cv::resize(image(box), out, size, 0, 0, how);
            return out;
        };
        for (const Image &plane : given)
            planes.push_back(cut(plane, cv::INTER_AREA));
        expected = cut(expected_there, cv::INTER_NEAREST);
        seen = cut(seen_there, cv::INTER_NEAREST);
        others = cut(others_there, cv::INTER_NEAREST);
    }
};

// Log odds, by the place alone, that a pixel shows the object: its distance from the expected outline, in units of how
// well that is known there.
Image by_place(const Place &p, const SilhouetteOptions &options)
{
    cv::Mat1f inside, outside, away;
    cv::distanceTransform(p.expected, inside, cv::DIST_L2, 5);
    cv::distanceTransform(~p.expected, outside, cv::DIST_L2, 5);
    cv::distanceTransform(~p.seen, away, cv::DIST_L2, 5);
    Image out(p.size);
    for (int y = 0; y < out.rows; y++)
        for (int x = 0; x < out.cols; x++) {
            const double known = options.rim + options.spread * static_cast<double>(away(y, x));
            const double off = static_cast<double>(inside(y, x) - outside(y, x)) / known;
            out(y, x) = static_cast<float>(p.seen(y, x)     ? kSure
                                           : p.others(y, x) ? -kSure
                                                            : std::clamp(off, -kSure, kSure));
        }
    return out;
}

double probability(float log_odds)
{
    return 1 / (1 + std::exp(-static_cast<double>(log_odds)));
}

// Log odds by place and colour, the colours in and outside being those of pixels that `share` (0..1) has there.
Image by_colour(const Place &p, const Image &place, const Image &share, double evidence)
{
    const int bins = p.planes.size() == 1 ? 32 : 16;
    Colours in(p.planes, bins), out(p.planes, bins);
    for (int y = 0; y < share.rows; y++)
        for (int x = 0; x < share.cols; x++) {
            in.add(x, y, share(y, x));
            out.add(x, y, 1 - share(y, x));
        }
    in.settle();
    out.settle();
    Image odds(p.size);
    for (int y = 0; y < odds.rows; y++)
        for (int x = 0; x < odds.cols; x++) {
            const double told = std::log((in.density(x, y) + kAnyColour) / (out.density(x, y) + kAnyColour));
            odds(y, x) = place(y, x) + static_cast<float>(evidence * std::clamp(told, -kColour, kColour));
        }
    return odds;
}

// 1 where the object is, by the cut of least cost.
Labels cut_of(const Image &odds, const Grid &grid)
{
    Problem problem;
    const size_t n = odds.total();
    problem.cost.assign(2, std::vector<int32_t>(n, 0));
    problem.partner.assign(2, std::vector<int32_t>(n, -1));
    size_t k = 0;
    for (const float value : odds) {
        problem.cost[value > 0 ? 0 : 1][k++] = static_cast<int32_t>(std::lround(kUnit * std::abs(value)));
    }
    problem.grids = {&grid};
    Labels out(n, 0);
    expand_once(problem, 1, out);
    return out;
}

Mask held_together(const Mask &mask, const Mask &seen, const Mask &expected)
{
    cv::Mat1i part;
    const auto count = static_cast<size_t>(cv::connectedComponents(mask, part, 8, CV_32S));
    std::vector<int> area(count, 0), within(count, 0), matched(count, 0);
    for (int y = 0; y < mask.rows; y++)
        for (int x = 0; x < mask.cols; x++) {
            const auto k = static_cast<size_t>(part(y, x));
            area[k]++;
            within[k] += expected(y, x) != 0;
            matched[k] += seen(y, x) != 0;
        }
    Mask out = mask.clone();
    for (int y = 0; y < mask.rows; y++)
        for (int x = 0; x < mask.cols; x++) {
            const auto k = static_cast<size_t>(part(y, x));
            if (k > 0 && matched[k] == 0 && 2 * within[k] < area[k])
                out(y, x) = 0;
        }
    return out;
}

} // namespace

Mask silhouette(const std::vector<Image> &planes, const Mask &expected, const Mask &seen, const Mask &others,
                const SilhouetteOptions &options)
{
    Mask out(expected.size(), 0);
    if (cv::countNonZero(expected) + cv::countNonZero(seen) == 0)
        return out;
    const Place p(planes, expected, seen, others, options.most);
    const Image place = by_place(p, options);
    const Grid grid = grid_of(p.planes, kUnit * options.smoothness);
    Image first(p.size);
    for (int y = 0; y < first.rows; y++)
        for (int x = 0; x < first.cols; x++)
            first(y, x) = static_cast<float>(probability(place(y, x)));
    Image share = first.clone();
    Labels labels;
    const auto picture_of = [&](const Labels &of, uint8_t one) {
        Mask picture(p.size);
        std::transform(of.begin(), of.end(), picture.begin(), [&](uint8_t l) { return l != 0 ? one : uint8_t{0}; });
        return picture;
    };
    for (int round = 0; round < options.rounds; round++) {
        Labels next = cut_of(by_colour(p, place, share, options.evidence), grid);
        const bool same = next == labels;
        labels = std::move(next);
        if (same)
            break;
        Image found;
        picture_of(labels, 1).convertTo(found, CV_32F);
        share = 0.7F * cv::max(found, 0.02F) + 0.3F * first;
    }
    const Mask small = held_together(picture_of(labels, 255), p.seen, p.expected);
    Mask large;
    cv::resize(small, large, p.box.size(), 0, 0, cv::INTER_LINEAR);
    large = large > 127;
    large.copyTo(out(p.box));
    return out;
}

} // namespace pipefish::segment
