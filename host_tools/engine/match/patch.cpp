#include "match/patch.hpp"

#include "match/vec.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::match
{

void sample_first(const Sampling &s, int x, int y, int r, Patch &out)
{
    for (int j = 0; j < 2 * r + 3; j++) {
        const float *row = (*s.first)[y + (j - r - 1) * s.step] + x - (r + 1) * s.step;
        if (s.step == 1)
            std::copy_n(row, 2 * r + 3, out.v[j]);
        else
            for (int i = 0; i < 2 * r + 3; i++)
                out.v[j][i] = row[i * s.step];
        store(&out.v[j][2 * r + 3], Float4{}); // read by sum_row, with weight 0
    }
}

void sample_second(const Sampling &s, const Local &at, int r, Patch &out, int rim)
{
    const Eigen::Matrix2f a = at.a * static_cast<float>(s.step);
    const int last = 2 * r + 1 + rim;
    for (int j = 1 - rim; j <= last; j++) {
        const Eigen::Vector2f start = at.centre + a.col(1) * static_cast<float>(j - r - 1);
        for (int i = 1 - rim; i <= last; i += 4) {
            Float4 along = counted(i - r - 1); // not beyond the row: it may end at the image's rim
            along = along < static_cast<float>(last - r - 1) ? along : Float4{} + static_cast<float>(last - r - 1);
            store(&out.v[j][i], spline(*s.spline, start.x() + a(0, 0) * along, start.y() + a(1, 0) * along));
        }
        store(&out.v[j][2 * r + 3], Float4{});
    }
}

bool fits(const Sampling &s, int x, int y, int r, const Local &at)
{
    const int reach = (r + 1) * s.step;
    return x >= reach && y >= reach && x + reach < s.first->cols && y + reach < s.first->rows &&
           inside(*s.second, at.centre, at.a, static_cast<float>(reach));
}

Level level_of(const Patch &p, int r)
{
    const int n = 2 * r + 1;
    const float origin = p.v[r + 1][r + 1];
    const Float4 rest = first_of(n % 4);
    Float4 sum = {}, squares = {};
    for (int j = 1; j <= n; j++) {
        int i = 1;
        for (; i + 3 <= n; i += 4) {
            const Float4 d = load(&p.v[j][i]) - origin;
            sum += d;
            squares += d * d;
        }
        const Float4 d = (load(&p.v[j][i]) - origin) * rest;
        sum += d;
        squares += d * d;
    }
    const auto count = static_cast<float>(n * n);
    const float mean = total(sum) / count;
    return {mean + origin, std::sqrt(std::max(0.0F, total(squares) / count - mean * mean))};
}

float correlate(const Patch &p, Level lp, const Patch &q, Level lq, int r)
{
    const int n = 2 * r + 1;
    const Float4 rest = first_of(n % 4);
    Float4 sum = {};
    for (int j = 1; j <= n; j++) {
        int i = 1;
        for (; i + 3 <= n; i += 4)
            sum += (load(&p.v[j][i]) - lp.mean) * (load(&q.v[j][i]) - lq.mean);
        sum += (load(&p.v[j][i]) - lp.mean) * (load(&q.v[j][i]) - lq.mean) * rest;
    }
    return total(sum) / (lp.sigma * lq.sigma * static_cast<float>(n * n));
}

Sampling sampling_for(const ScaleStack &first, const ScaleStack &second, const Eigen::Matrix2f &a)
{
    const double scale = std::sqrt(std::abs(static_cast<double>(a.determinant())));
    const int step = scale < 1 ? std::clamp(static_cast<int>(std::lround(1 / scale)), 1, 4) : 1;
    return {step, &first.for_step(1 / scale), &second.for_step(scale), &second.spline_for_step(scale)};
}

bool sane(const Eigen::Matrix2f &a)
{
    const float det = std::abs(a.determinant());
    return det > 1.0F / 36 && det < 36 && aspect(a) <= 6;
}

bool compare(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, Local &local,
             Pair &out)
{
    out.s = sampling_for(first, second, local.a);
    if (!fits(out.s, x, y, r, local))
        return false;
    sample_first(out.s, x, y, r, out.p);
    sample_second(out.s, local, r, out.q);
    out.lp = level_of(out.p, r);
    out.lq = level_of(out.q, r);
    if (static_cast<double>(std::min(out.lp.sigma, out.lq.sigma)) < sigma_min)
        return false;
    local.zncc = correlate(out.p, out.lp, out.q, out.lq, r);
    return true;
}

bool measure(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, Local &local)
{
    Pair pair;
    return compare(first, second, x, y, r, sigma_min, local, pair);
}

} // namespace pipefish::match
