// Grey images for matching: values 0..1, pixel centres at integers, and the same image blurred for coarser sampling.
#pragma once

#include "match/vec.hpp"

#include <Eigen/Core>
#include <opencv2/core.hpp>

#include <algorithm>
#include <array>
#include <memory>
#include <mutex>

namespace pipefish::match
{

using Image = cv::Mat_<float>;

// An image and its blurred copies, all at full resolution: level l is for samples 2^(l/2) pixels apart. Copies are made
// when first asked for. Safe to share between threads.
class ScaleStack
{
public:
    static constexpr int kLevels = 6;

    explicit ScaleStack(Image image);

    // The level for samples `step` pixels apart: the sampling then is as if the image were coarser, not aliased.
    const Image &for_step(double step) const;
    // The same as coefficients of a cubic spline, for spline().
    const Image &spline_for_step(double step) const;
    const Image &image() const { return levels_[0]; }
    int width() const { return levels_[0].cols; }
    int height() const { return levels_[0].rows; }

private:
    mutable std::array<Image, kLevels> levels_, splines_;
    mutable std::array<std::once_flag, kLevels> made_, filtered_;
};

// 255 where a pixel differs from one of its four neighbours by more than `threshold`: the texture confidence of
// Lhuillier and Quan. The border of one pixel is 0.
cv::Mat_<uint8_t> textured(const Image &image, double threshold);

// Bilinear values at four places, which are clamped into the image.
inline Float4 bilinear(const Image &image, Float4 x, Float4 y)
{
    const float right = static_cast<float>(image.cols - 1) - 1e-3F, bottom = static_cast<float>(image.rows - 1) - 1e-3F;
    x = x > 0 ? x : Float4{};
    y = y > 0 ? y : Float4{};
    x = x < right ? x : Float4{} + right;
    y = y < bottom ? y : Float4{} + bottom;
    const Int4 i = truncated(x), j = truncated(y);
    const Float4 a = x - floats(i), b = y - floats(j);
    const size_t step = image.step1();
    const float *p[4];
    for (int k = 0; k < 4; k++)
        p[k] = image[0] + static_cast<size_t>(j[k]) * step + i[k];
    const Float4 u = pairs(p[0], p[1]), v = pairs(p[2], p[3]);
    const Float4 u_2 = pairs(p[0] + step, p[1] + step), v_2 = pairs(p[2] + step, p[3] + step);
    const Float4 left = __builtin_shufflevector(u, v, 0, 2, 4, 6),
                 left_2 = __builtin_shufflevector(u_2, v_2, 0, 2, 4, 6);
    const Float4 top = left + a * (__builtin_shufflevector(u, v, 1, 3, 5, 7) - left);
    const Float4 low = left_2 + a * (__builtin_shufflevector(u_2, v_2, 1, 3, 5, 7) - left_2);
    return top + b * (low - top);
}

// Value of a cubic spline from its coefficients; 1 <= x < width - 2 and likewise y. Exact interpolation: a shift by
// part of a pixel is measured without the bias of shorter kernels (0.01 px with Catmull and Rom's, on waves of 5
// pixels).
inline float spline(const Image &image, float x, float y)
{
    constexpr float s = 1.0F / 6;
    constexpr Float4 c0 = {s, 4 * s, s, 0}, c1 = {-3 * s, 0, 3 * s, 0}, c2 = {3 * s, -6 * s, 3 * s, 0};
    constexpr Float4 c3 = {-s, 3 * s, -3 * s, s};
    const int i = static_cast<int>(x), j = static_cast<int>(y);
    const float tx = x - static_cast<float>(i), ty = y - static_cast<float>(j);
    const Float4 wx = ((c3 * tx + c2) * tx + c1) * tx + c0, wy = ((c3 * ty + c2) * ty + c1) * ty + c0;
    const size_t step = image.step1();
    const float *p = image[j - 1] + i - 1;
    const Float4 columns =
        wy[0] * load(p) + wy[1] * load(p + step) + wy[2] * load(p + 2 * step) + wy[3] * load(p + 3 * step);
    return total(columns * wx);
}

// The same at four places, to the last bit.
inline Float4 spline(const Image &image, Float4 x, Float4 y)
{
    constexpr float s = 1.0F / 6;
    const Int4 i = truncated(x), j = truncated(y);
    const auto weights = [](Float4 t, Float4(&w)[4]) {
        w[0] = ((-s * t + 3 * s) * t - 3 * s) * t + s;
        w[1] = (3 * s * t - 6 * s) * t * t + 4 * s;
        w[2] = ((-3 * s * t + 3 * s) * t + 3 * s) * t + s;
        w[3] = s * t * t * t;
    };
    Float4 wx[4], wy[4], v[4];
    weights(x - floats(i), wx);
    weights(y - floats(j), wy);
    const size_t step = image.step1();
    for (int k = 0; k < 4; k++) {
        const float *p = image[0] + static_cast<size_t>(j[k] - 1) * step + i[k] - 1;
        v[k] = wy[0][k] * load(p) + wy[1][k] * load(p + step) + wy[2][k] * load(p + 2 * step) +
               wy[3][k] * load(p + 3 * step);
    }
    transpose(v);
    return (v[0] * wx[0] + v[1] * wx[1]) + (v[2] * wx[2] + v[3] * wx[3]);
}

// Whether the parallelogram centre + A [-r, r]^2 lies where spline() may be asked.
inline bool inside(const Image &image, const Eigen::Vector2f &centre, const Eigen::Matrix2f &a, float r)
{
    const Eigen::Vector2f reach = r * a.cwiseAbs().rowwise().sum();
    return centre.x() - reach.x() >= 1.0F && centre.y() - reach.y() >= 1.0F &&
           centre.x() + reach.x() < static_cast<float>(image.cols - 2) &&
           centre.y() + reach.y() < static_cast<float>(image.rows - 2);
}

} // namespace pipefish::match
