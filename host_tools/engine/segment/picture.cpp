#include "segment/picture.hpp"

#include <opencv2/imgproc.hpp>

#include <cmath>
#include <stdexcept>

namespace pipefish::segment
{

namespace
{

constexpr int kBins = 32; // of a colour channel

// Linear weights of the two bins around a value.
struct Bins {
    int low;
    double share; // of the upper

    explicit Bins(float v)
    {
        const double at = std::clamp(static_cast<double>(v) * kBins - 0.5, 0.0, kBins - 1.0);
        low = std::min(static_cast<int>(at), kBins - 2);
        share = at - low;
    }
};

// Visits the 2 or 8 cells around a pixel's colour with their weights.
template <typename Visit> void cells(const std::deque<match::ScaleStack> &planes, int x, int y, const Visit &visit)
{
    const size_t n = planes.size();
    std::array<Bins, 3> bins = {Bins(0), Bins(0), Bins(0)};
    for (size_t c = 0; c < n; c++)
        bins[c] = Bins(planes[c].image()(y, x));
    for (size_t k = 0; k < size_t{1} << n; k++) {
        size_t cell = 0;
        double weight = 1;
        for (size_t c = 0; c < n; c++) {
            const bool up = k >> c & 1;
            cell = cell * kBins + static_cast<size_t>(bins[c].low + up);
            weight *= up ? bins[c].share : 1 - bins[c].share;
        }
        visit(cell, weight);
    }
}

// Smooths a histogram along one channel by a kernel of 1 4 6 4 1, a deviation of one bin.
void smooth(std::vector<double> &histogram, size_t stride)
{
    constexpr double kernel[5] = {1.0 / 16, 4.0 / 16, 6.0 / 16, 4.0 / 16, 1.0 / 16};
    const std::vector<double> from = histogram;
    for (size_t cell = 0; cell < from.size(); cell++) {
        const auto at = static_cast<int>(cell / stride % kBins);
        double sum = 0;
        for (int k = 0; k < 5; k++) {
            const int to = std::clamp(at + k - 2, 0, kBins - 1);
            sum += kernel[k] * from[cell + static_cast<size_t>(to - at) * stride];
        }
        histogram[cell] = sum;
    }
}

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
    size_t count = 1;
    for (size_t c = 0; c < planes.size(); c++)
        count *= kBins;
    std::vector<double> histogram(count, 0);
    for (int y = 0; y < rarity_.rows; y++)
        for (int x = 0; x < rarity_.cols; x++)
            cells(planes_, x, y, [&](size_t cell, double weight) { histogram[cell] += weight; });
    for (size_t c = 0, stride = 1; c < planes.size(); c++, stride *= kBins)
        smooth(histogram, stride);
    // One of a hundred colours may be any, half of the others are as nearby, half as anywhere in the picture.
    const auto pixels = static_cast<double>(rarity_.total()), cell_count = static_cast<double>(count);
    for (int y = 0; y < rarity_.rows; y++)
        for (int x = 0; x < rarity_.cols; x++) {
            double density = 0;
            cells(planes_, x, y, [&](size_t cell, double weight) { density += weight * histogram[cell]; });
            rarity_(y, x) = static_cast<float>(
                -std::log(0.01 + 0.495 * (density * cell_count / pixels + local_density(planes_, x, y))));
        }
}

double Picture::grey(size_t channel) const
{
    constexpr double weights[3] = {0.299, 0.587, 0.114};
    return channels() == 1 ? 1 : weights[channel];
}

void Picture::edges(int first, double cost, std::vector<Problem::Edge> &out) const
{
    const int width = rarity_.cols, height = rarity_.rows;
    const auto visit = [&](const auto &body) {
        for (int y = 0; y < height; y++)
            for (int x = 0; x < width; x++)
                for (const auto &[dx, dy] : {std::pair(1, 0), std::pair(0, 1), std::pair(1, 1), std::pair(-1, 1)}) {
                    if (x + dx < 0 || x + dx >= width || y + dy >= height)
                        continue;
                    double difference = 0;
                    for (const match::ScaleStack &p : planes_) {
                        const double d = p.image()(y, x) - p.image()(y + dy, x + dx);
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
