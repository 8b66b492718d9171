#include "match/image.hpp"

#include <opencv2/imgproc.hpp>

#include <cmath>

namespace pipefish::match
{

ScaleStack::ScaleStack(Image image)
{
    levels_[0] = std::move(image);
}

const Image &ScaleStack::for_step(double step) const
{
    const int level = std::clamp(static_cast<int>(std::lround(2 * std::log2(std::max(step, 1.0)))), 0, kLevels - 1);
    if (level > 0) {
        std::call_once(made_[static_cast<size_t>(level)], [&] {
            // A camera's pixel is already blurred by about half a pixel; one `step` times larger by as much more.
            const double sigma = 0.5 * std::sqrt(std::exp2(level) - 1);
            cv::GaussianBlur(levels_[0], levels_[static_cast<size_t>(level)], {}, sigma, sigma, cv::BORDER_REPLICATE);
        });
    }
    return levels_[static_cast<size_t>(level)];
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
