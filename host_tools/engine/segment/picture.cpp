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

void Picture::edges(int first, double cost, std::vector<Problem::Edge> &out) const
{
    std::vector<Image> planes;
    for (const match::ScaleStack &p : planes_)
        planes.push_back(p.image());
    neighbour_edges(planes, first, cost, out);
}

void neighbour_edges(const std::vector<Image> &planes, int first, double cost, std::vector<Problem::Edge> &out)
{
    const int width = planes.at(0).cols, height = planes[0].rows;
    const auto visit = [&](const auto &body) {
        for (int y = 0; y < height; y++)
            for (int x = 0; x < width; x++)
                for (const auto &[dx, dy] : {std::pair(1, 0), std::pair(0, 1), std::pair(1, 1), std::pair(-1, 1)}) {
                    if (x + dx < 0 || x + dx >= width || y + dy >= height)
                        continue;
                    double difference = 0;
                    for (const Image &p : planes) {
                        const double d = p(y, x) - p(y + dy, x + dx);
                        difference += d * d;
                    }
                    body(first + y * width + x, dy * width + dx, difference, dx != 0 && dy != 0);
                }
    };
    double sum = 0, count = 0;
    visit([&](int, int, double difference, bool) { sum += difference, count++; });
    const double twice = std::max(2 * sum / count, 1e-9);
    visit([&](int p, int step, double difference, bool diagonal) {
        const double c = cost * (0.1 + 0.9 * std::exp(-difference / twice)) / (diagonal ? std::sqrt(2.0) : 1);
        out.push_back({p, p + step, static_cast<int32_t>(std::lround(c))});
    });
}

} // namespace pipefish::segment
