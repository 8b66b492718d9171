#include "match/grow_whole.hpp"

#include <opencv2/imgproc.hpp>

#include <cmath>

namespace pipefish::match
{

namespace
{

// From the window at `from` (top left) whose mean and norm are known: no sums.
void take_known(Window &window, const float *from, size_t stride, int radius, float mean, float inverse)
{
    window.side = 2 * radius + 1;
    window.vectors = (window.side + 3) / 4;
    Float4 last = {};
    for (int k = 0; k < window.side - 4 * (window.vectors - 1); k++)
        last[k] = 1;
    for (int j = 0; j < window.side; j++) {
        const float *row = from + static_cast<size_t>(j) * stride;
        float *to = window.v + j * 4 * window.vectors;
        for (int k = 0; k + 1 < window.vectors; k++)
            store(to + 4 * k, load(row + 4 * k) - mean);
        store(to + 4 * window.vectors - 4, (load(row + 4 * window.vectors - 4) - mean) * last);
    }
    window.inverse_sigma = inverse;
}

} // namespace

WholeSearch::WholeSearch(const Image &first, const Image &second, const Options &options, const Free &free,
                         Growth &counts)
    : first_(first), second_(second), options_(options), free_(free), counts_(counts), one_(statistics_of(first)),
      two_(statistics_of(second)), last_shift_(first.size(), INT32_MIN)
{
}

WholeSearch::Statistics WholeSearch::statistics_of(const Image &image) const
{
    const int n = 2 * options_.radius + 1;
    Statistics out;
    cv::Mat1f squares;
    cv::boxFilter(image, out.mean, CV_32F, {n, n});
    cv::sqrBoxFilter(image, squares, CV_32F, {n, n});
    out.inverse.create(image.size());
    const auto floor = static_cast<float>(options_.sigma_min * options_.sigma_min);
    for (int y = 0; y < image.rows; y++)
        for (int x = 0; x < image.cols; x++) {
            const float variance = squares(y, x) - out.mean(y, x) * out.mean(y, x);
            out.inverse(y, x) = variance >= floor ? 1 / (std::sqrt(variance) * static_cast<float>(n)) : 0.0F;
        }
    return out;
}

void WholeSearch::look_around(const Match &m, std::vector<Candidate> &found)
{
    const int tx = static_cast<int>(std::lround(m.centre.x())) - m.x,
              ty = static_cast<int>(std::lround(m.centre.y())) - m.y;
    for (int dy = -kReach; dy <= kReach; dy++) {
        if (!free_.row(m.x, m.y + dy))
            continue;
        for (int dx = -kReach; dx <= kReach; dx++)
            if (free_.first(m.y + dy, m.x + dx))
                try_place(m.x + dx, m.y + dy, tx, ty, (dy + kReach) * (2 * kReach + 1) + dx + kReach, found);
    }
}

void WholeSearch::try_place(int x, int y, int tx, int ty, int order, std::vector<Candidate> &found)
{
    const int r = options_.radius, margin = r + 4, x_2 = x + tx, y_2 = y + ty;
    const int shift = ty * 65536 + tx; // images have at most 16384 pixels a side
    if (last_shift_(y, x) == shift)
        return;
    last_shift_(y, x) = shift;
    if (x < margin || y < margin || x + margin >= free_.first.cols || y + margin >= free_.first.rows || x_2 < margin ||
        y_2 < margin || x_2 + margin >= free_.second.cols || y_2 + margin >= free_.second.rows)
        return;
    const uint8_t *cell = free_.second[y_2] + x_2;
    const ptrdiff_t row = free_.second.cols;
    if (!(cell[-row - 1] | cell[-row] | cell[-row + 1] | cell[-1] | cell[0] | cell[1] | cell[row - 1] | cell[row] |
          cell[row + 1])) {
        counts_.taken++;
        return;
    }
    counts_.tried++;
    if (one_.inverse(y, x) == 0)
        return;
    Window window;
    take_known(window, first_[y - r] + x - r, first_.step1(), r, one_.mean(y, x), one_.inverse(y, x));
    float z[3][3];
    for (int ej = -1; ej <= 1; ej++)
        for (int ei = -1; ei <= 1; ei++)
            z[ej + 1][ei + 1] = two_.inverse(y_2 + ej, x_2 + ei) * window.inverse_sigma *
                                window.dot(second_[y_2 + ej - r] + x_2 + ei - r, second_.step1());
    const Peak peak(z);
    if (static_cast<double>(peak.zncc) < options_.zncc_min) {
        counts_.low_zncc++;
        return;
    }
    found.push_back({order, x, y, Eigen::Vector2f(static_cast<float>(x_2), static_cast<float>(y_2)) + peak.at,
                     peak.zncc, peak.at_border});
}

Eigen::Vector2f WholeSearch::nudged(const Candidate &c) const
{
    const int r = options_.radius;
    const auto x_2 = static_cast<int>(std::lround(c.centre.x())), y_2 = static_cast<int>(std::lround(c.centre.y()));
    const float mean[2] = {one_.mean(c.y, c.x), two_.mean(y_2, x_2)};
    const float inverse[2] = {one_.inverse(c.y, c.x), two_.inverse(y_2, x_2)};
    Float4 sums[5] = {}; // xx, xy, yy, xe, ye
    const int n = 2 * r + 1, full = n / 4 * 4;
    Float4 last = {};
    for (int k = 0; k < n - full; k++)
        last[k] = 1;
    for (int j = -r; j <= r; j++) {
        const float *p = first_[c.y + j] + c.x - r, *q = second_[y_2 + j] + x_2 - r;
        const size_t step = first_.step1(), step_2 = second_.step1();
        for (int i = 0; i < n; i += 4) {
            const Float4 gx = 0.25F * ((load(p + i + 1) - load(p + i - 1)) * inverse[0] +
                                       (load(q + i + 1) - load(q + i - 1)) * inverse[1]);
            const Float4 gy = 0.25F * ((load(p + i + step) - load(p + i - step)) * inverse[0] +
                                       (load(q + i + step_2) - load(q + i - step_2)) * inverse[1]);
            const Float4 e = (load(p + i) - mean[0]) * inverse[0] - (load(q + i) - mean[1]) * inverse[1];
            const Float4 x = i < full ? gx : gx * last, y = i < full ? gy : gy * last;
            sums[0] += x * gx;
            sums[1] += x * gy;
            sums[2] += y * gy;
            sums[3] += x * e;
            sums[4] += y * e;
        }
    }
    const float xx = total(sums[0]), xy = total(sums[1]), yy = total(sums[2]), xe = total(sums[3]), ye = total(sums[4]);
    const float ridge = 1e-3F * (xx + yy), det = (xx + ridge) * (yy + ridge) - xy * xy;
    const Eigen::Vector2f t = Eigen::Vector2f((yy + ridge) * xe - xy * ye, (xx + ridge) * ye - xy * xe) / det;
    const Eigen::Vector2f whole(static_cast<float>(x_2), static_cast<float>(y_2));
    return t.cwiseAbs().maxCoeff() <= 0.75F ? Eigen::Vector2f(whole + t) : c.centre;
}

} // namespace pipefish::match
