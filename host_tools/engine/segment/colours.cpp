#include "segment/colours.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pipefish::segment
{

Colours::Colours(const std::vector<Image> &planes, int bins) : planes_(planes), bins_(bins)
{
    size_t count = 1;
    for (size_t c = 0; c < planes.size(); c++)
        count *= static_cast<size_t>(bins);
    histogram_.assign(count, 0);
}

size_t Colours::cells(int x, int y, std::array<Cell, 8> &out) const
{
    size_t count = 1;
    out[0] = {0, 1};
    for (const Image &plane : planes_) {
        const double at = std::clamp(static_cast<double>(plane(y, x)) * bins_ - 0.5, 0.0, bins_ - 1.0);
        const int low = std::min(static_cast<int>(at), bins_ - 2);
        const double share = at - low; // of the upper one
        for (size_t k = 0; k < count; k++) {
            const size_t index = out[k].index * static_cast<size_t>(bins_) + static_cast<size_t>(low);
            out[count + k] = {index + 1, out[k].weight * share};
            out[k] = {index, out[k].weight * (1 - share)};
        }
        count *= 2;
    }
    return count;
}

void Colours::add(int x, int y, double weight)
{
    std::array<Cell, 8> found;
    for (size_t k = 0, count = cells(x, y, found); k < count; k++)
        histogram_[found[k].index] += weight * found[k].weight;
}

// Along one channel by a kernel of 1 4 6 4 1.
void Colours::smooth(size_t stride)
{
    constexpr double kernel[5] = {1.0 / 16, 4.0 / 16, 6.0 / 16, 4.0 / 16, 1.0 / 16};
    const std::vector<double> from = histogram_;
    for (size_t cell = 0; cell < from.size(); cell++) {
        const auto at = static_cast<int>(cell / stride % static_cast<size_t>(bins_));
        double sum = 0;
        for (int k = 0; k < 5; k++) {
            const int to = std::clamp(at + k - 2, 0, bins_ - 1);
            sum += kernel[k] * from[cell + static_cast<size_t>(to - at) * stride];
        }
        histogram_[cell] = sum;
    }
}

void Colours::settle()
{
    const double total = std::accumulate(histogram_.begin(), histogram_.end(), 0.0);
    for (size_t c = 0, stride = 1; c < planes_.size(); c++, stride *= static_cast<size_t>(bins_))
        smooth(stride);
    for (double &h : histogram_)
        h *= static_cast<double>(histogram_.size()) / std::max(total, 1e-9);
}

double Colours::density(int x, int y) const
{
    std::array<Cell, 8> found;
    double out = 0;
    for (size_t k = 0, count = cells(x, y, found); k < count; k++)
        out += found[k].weight * histogram_[found[k].index];
    return out;
}

} // namespace pipefish::segment
