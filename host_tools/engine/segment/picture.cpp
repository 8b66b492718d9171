#include "segment/picture.hpp"

#include <opencv2/imgproc.hpp>

#include <cmath>
#include <stdexcept>

namespace pipefish::segment
{

namespace
{

constexpr int kBins = 32; // of a colour channel

// How dense a pixel's colour is among those of its surroundings, 16 pixels 3 and 5 away: a flat region explains itself.
double local_density(const std::deque<match::ScaleStack> &planes, int x, int y)
{
    // As wide as makes it neutral: where all is flat, a layer's pixel and the background's are equally likely.
    const double sigma = kLeastNoise * std::pow(0.5, 1.0 / static_cast<double>(planes.size()));
    const double scale = 1 / (2 * sigma * sigma), peak = 0.3989422804 / sigma;
    constexpr int ring[8][2] = {{3, 0}, {2, 2}, {0, 3}, {-2, 2}, {-3, 0}, {-2, -2}, {0, -3}, {2, -2}};
    const int width = planes[0].width(), height = planes[0].height();
    double sum = 0, count = 0;
    for (const int far : {3, 5})
        for (const auto &[dx, dy] : ring) {
            const int i = x + dx * far / 3, j = y + dy * far / 3;
            if (i < 0 || j < 0 || i >= width || j >= height)
                continue;
            double difference = 0;
            for (const match::ScaleStack &p : planes) {
                const double d = p.image()(y, x) - p.image()(j, i);
                difference += d * d;
            }
            sum += std::exp(-scale * difference);
            count++;
        }
    return sum / count * std::pow(peak, static_cast<double>(planes.size()));
}

} // namespace

Picture::Picture(const std::vector<Image> &planes) : rarity_(planes.at(0).size())
{
    for (const Image &plane : planes)
        planes_.emplace_back(plane);
    Colours colours(planes, kBins);
    for (int y = 0; y < rarity_.rows; y++)
        for (int x = 0; x < rarity_.cols; x++)
            colours.add(x, y, 1);
    colours.settle();
    // One of a hundred colours may be any, half of the others are as nearby, half as anywhere in the picture.
    for (int y = 0; y < rarity_.rows; y++)
        for (int x = 0; x < rarity_.cols; x++) {
            const double density = colours.density(x, y);
            rarity_(y, x) = static_cast<float>(-std::log(0.01 + 0.495 * (density + local_density(planes_, x, y))));
        }
}

double Picture::grey(size_t channel) const
{
    constexpr double weights[3] = {0.299, 0.587, 0.114};
    return channels() == 1 ? 1 : weights[channel];
}

Grid Picture::grid(double cost) const
{
    std::vector<Image> planes;
    for (const match::ScaleStack &p : planes_)
        planes.push_back(p.image());
    return grid_of(planes, cost);
}

Grid grid_of(const std::vector<Image> &planes, double cost)
{
    const int width = planes.at(0).cols, height = planes[0].rows;
    Grid out{width, std::vector<std::array<int32_t, 4>>(planes[0].total(), {0, 0, 0, 0})};
    constexpr int steps[4][2] = {{1, 0}, {0, 1}, {1, 1}, {-1, 1}};
    const auto visit = [&](const auto &body) {
        for (int y = 0; y < height; y++)
            for (int x = 0; x < width; x++)
                for (size_t k = 0; k < 4; k++) {
                    const int i = x + steps[k][0], j = y + steps[k][1];
                    if (i < 0 || i >= width || j >= height)
                        continue;
                    double difference = 0;
                    for (const Image &p : planes) {
                        const double d = p(y, x) - p(j, i);
                        difference += d * d;
                    }
                    body(static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x), k, difference);
                }
    };
    double sum = 0, count = 0;
    visit([&](size_t, size_t, double difference) { sum += difference, count++; });
    const double twice = std::max(2 * sum / count, 1e-9);
    visit([&](size_t p, size_t k, double difference) {
        const double c = cost * (0.1 + 0.9 * std::exp(-difference / twice)) / (k > 1 ? std::sqrt(2.0) : 1);
        out.cost[p][k] = static_cast<int32_t>(std::lround(c));
    });
    return out;
}

} // namespace pipefish::segment
