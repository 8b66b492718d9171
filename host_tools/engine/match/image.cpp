#include "match/image.hpp"

#include <opencv2/imgproc.hpp>

#include <cmath>
#include <vector>

namespace pipefish::match
{

ScaleStack::ScaleStack(Image image)
{
    levels_[0] = std::move(image);
}

namespace
{

size_t level_for(double step)
{
    const auto level = std::lround(2 * std::log2(std::max(step, 1.0)));
    return static_cast<size_t>(std::clamp<long>(level, 0, ScaleStack::kLevels - 1));
}

constexpr float kPole = -0.26794919243F; // sqrt(3) - 2, of the cubic spline's inverse filter

// Makes samples coefficients, along all columns at once: there and back over the rows, mirrored at both ends.
void filter_rows(Image &image)
{
    const int w = image.cols, h = image.rows;
    if (h < 2)
        return; // a constant
    std::vector<float> start(static_cast<size_t>(w), 0.0F);
    float power = 1;
    for (int k = 0; k < 16; k++, power *= kPole) { // 0.268^16 is below a float's last bit
        const int turn = k % (2 * h - 2), y = std::min(turn, 2 * h - 2 - turn);
        for (int x = 0; x < w; x++)
            start[static_cast<size_t>(x)] += power * image(y, x);
    }
    for (int x = 0; x < w; x++)
        image(0, x) = start[static_cast<size_t>(x)];
    for (int y = 1; y < h; y++)
        for (int x = 0; x < w; x++)
            image(y, x) += kPole * image(y - 1, x);
    const float last = kPole / (kPole * kPole - 1);
    for (int x = 0; x < w; x++)
        image(h - 1, x) = last * (image(h - 1, x) + kPole * image(h - 2, x));
    for (int y = h - 2; y >= 0; y--)
        for (int x = 0; x < w; x++)
            image(y, x) = kPole * (image(y + 1, x) - image(y, x));
    image *= 6;
}

} // namespace

const Image &ScaleStack::for_step(double step) const
{
    const size_t level = level_for(step);
    if (level > 0) {
        std::call_once(made_[level], [&] {
            // A camera's pixel is already blurred by about half a pixel; one `step` times larger by as much more.
            const double sigma = 0.5 * std::sqrt(std::exp2(static_cast<double>(level)) - 1);
            cv::GaussianBlur(levels_[0], levels_[level], {}, sigma, sigma, cv::BORDER_REPLICATE);
        });
    }
    return levels_[level];
}

const Image &ScaleStack::spline_for_step(double step) const
{
    const size_t level = level_for(step);
    std::call_once(filtered_[level], [&] {
        Image turned, down = for_step(step).clone();
        filter_rows(down);
        cv::transpose(down, turned);
        filter_rows(turned);
        cv::transpose(turned, splines_[level]);
    });
    return splines_[level];
}

cv::Mat_<uint8_t> textured(const Image &image, double threshold)
{
    cv::Mat_<uint8_t> out(image.size(), uint8_t{0});
    const auto t = static_cast<float>(threshold);
    for (int y = 1; y + 1 < image.rows; y++) {
        const float *above = image[y - 1], *row = image[y], *below = image[y + 1];
        for (int x = 1; x + 1 < image.cols; x++) {
            const float v = row[x];
            const float most = std::max(std::max(std::abs(row[x - 1] - v), std::abs(row[x + 1] - v)),
                                        std::max(std::abs(above[x] - v), std::abs(below[x] - v)));
            out(y, x) = most > t ? 255 : 0;
        }
    }
    return out;
}

} // namespace pipefish::match
