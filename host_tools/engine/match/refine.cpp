#include "match/refine.hpp"

#include "match/vec.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include <cmath>

namespace pipefish::match
{

namespace
{

// The window's weight at -r..r, 0 beyond: a Gaussian of sigma 0.6 r.
struct Weights {
    int r = 0;
    alignas(16) float w[kPatchWide] = {};
    alignas(16) float at[kPatchWide] = {};

    explicit Weights(int radius) : r(radius)
    {
        for (int i = 0; i < kPatchWide; i++) {
            at[i] = static_cast<float>(i - radius);
            const float t = at[i] / (0.6F * static_cast<float>(radius));
            w[i] = i <= 2 * radius ? std::exp(-0.5F * t * t) : 0.0F;
        }
    }
};

const Weights &weights_of(int r)
{
    thread_local Weights kept(r);
    if (kept.r != r)
        kept = Weights(r);
    return kept;
}

enum Sum { kXX, kXY, kYY, kXA, kYA, kX1, kY1, kXE, kYE, kAA, kA1, k11, kAE, k1E, kSums };

// How many powers of the row a sum is asked for with: those of a product of two gradients 0 to 2, of one 0 and 1.
constexpr int powers_of(int sum)
{
    return sum <= kYY ? 3 : sum <= kYE ? 2 : 1;
}

// Normal equations in the order tx, ty, c00, c01, c10, c11, gain, offset.
struct Normal {
    Eigen::Matrix<double, 8, 8> h;
    Eigen::Matrix<double, 8, 1> g;
};

// Columns i to i + 3 of both patches: residual e = a - b, mean gradient, weighted and summed over the rows, powers of
// the row as the second index.
void sum_columns(const Patch &p, Level lp, const Patch &q, Level lq, int i, const Weights &window,
                 Float4 (&out)[kSums][3])
{
    const float sp = 1 / lp.sigma, sq = 1 / lq.sigma;
    const Float4 column = load(window.w + i);
    for (int j = 1; j <= 2 * window.r + 1; j++) {
        const Float4 w = column * window.w[j - 1];
        const Float4 a = (load(&p.v[j][i + 1]) - lp.mean) * sp, b = (load(&q.v[j][i + 1]) - lq.mean) * sq;
        const Float4 gx =
            0.25F * ((load(&p.v[j][i + 2]) - load(&p.v[j][i])) * sp + (load(&q.v[j][i + 2]) - load(&q.v[j][i])) * sq);
        const Float4 gy = 0.25F * ((load(&p.v[j + 1][i + 1]) - load(&p.v[j - 1][i + 1])) * sp +
                                   (load(&q.v[j + 1][i + 1]) - load(&q.v[j - 1][i + 1])) * sq);
        const Float4 e = a - b, x = w * gx, y = w * gy, wa = w * a;
        Float4 terms[kSums] = {x * gx, x * gy, y * gy, x * a, y * a, x, y, x * e, y * e, wa * a, wa, w, wa * e, w * e};
        for (int m = 0; m < 3; m++)
            for (int k = 0; k < kSums; k++)
                if (m < powers_of(k)) {
                    out[k][m] += terms[k];
                    terms[k] *= window.at[j - 1];
                }
    }
}

Normal normal_of(const Patch &p, Level lp, const Patch &q, Level lq, int r)
{
    const Weights &window = weights_of(r);
    Float4 sums[kSums][3][3] = {}; // weighted by column^i row^j, i + j <= 2
    for (int i = 0; i < 2 * r + 1; i += 4) {
        Float4 s[kSums][3] = {};
        sum_columns(p, lp, q, lq, i, window, s);
        const Float4 v = load(window.at + i);
        for (int k = 0; k < kSums; k++)
            for (int n = 0; n < powers_of(k); n++)
                for (int j = 0; j + n < powers_of(k); j++) {
                    sums[k][n][j] += s[k][j];
                    s[k][j] *= v;
                }
    }
    double m[kSums][3][3];
    for (int k = 0; k < kSums; k++)
        for (int n = 0; n < powers_of(k); n++)
            for (int j = 0; j + n < powers_of(k); j++)
                m[k][n][j] = static_cast<double>(total(sums[k][n][j]));
    // Columns: gradient gx or gy times 1, column, row.
    const int component[6] = {0, 1, 0, 0, 1, 1}, i_of[6] = {0, 0, 1, 0, 1, 0}, j_of[6] = {0, 0, 0, 1, 0, 1};
    const Sum pair[2][2] = {{kXX, kXY}, {kXY, kYY}};
    Normal n;
    for (int s = 0; s < 6; s++) {
        const int c = component[s], i = i_of[s], j = j_of[s];
        for (int t = 0; t < 6; t++)
            n.h(s, t) = m[pair[c][component[t]]][i + i_of[t]][j + j_of[t]];
        n.h(s, 6) = n.h(6, s) = -m[c ? kYA : kXA][i][j];
        n.h(s, 7) = n.h(7, s) = -m[c ? kY1 : kX1][i][j];
        n.g(s) = m[c ? kYE : kXE][i][j];
    }
    n.h(6, 6) = m[kAA][0][0];
    n.h(6, 7) = n.h(7, 6) = m[kA1][0][0];
    n.h(7, 7) = m[k11][0][0];
    n.g(6) = -m[kAE][0][0];
    n.g(7) = -m[k1E][0][0];
    return n;
}

} // namespace

bool refine(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, float max_shift,
            float max_change, Local &local)
{
    Pair pair;
    if (!compare(first, second, x, y, r, sigma_min, local, pair))
        return false;
    const Sampling &s = pair.s;
    Normal n = normal_of(pair.p, pair.lp, pair.q, pair.lq, r);
    // A thousandth of the typical strength: what the patch does not tell (along an edge) stays as it is.
    const double shift_ridge = 1e-3 * (n.h(0, 0) + n.h(1, 1)), map_ridge = 1e-3 * n.h.diagonal().segment<4>(2).sum();
    n.h.diagonal().head<2>().array() += shift_ridge;
    n.h.diagonal().segment<4>(2).array() += max_change > 0 ? map_ridge : 1e6 * map_ridge;
    const Eigen::Matrix<float, 8, 1> d = n.h.llt().solve(n.g).cast<float>();
    Eigen::Matrix2f c;
    c << d(2), d(3), d(4), d(5);
    const Eigen::Vector2f t = d.head<2>();
    if (!(t.norm() < max_shift) || (max_change > 0 && !(c.norm() <= max_change))) // NaN too
        return false;
    Local moved = local;
    moved.centre += local.a * t * static_cast<float>(s.step);
    if (max_change > 0)
        moved.a = local.a * (Eigen::Matrix2f::Identity() + c);
    const Sampling s_2 = sampling_for(first, second, moved.a);
    if (!sane(moved.a) || !fits(s_2, x, y, r, moved))
        return false;
    if (s_2.step != s.step || s_2.first != s.first) {
        if (!measure(first, second, x, y, r, sigma_min, moved))
            return false;
    } else {
        sample_second(s_2, moved, r, pair.q, 0);
        const Level moved_lq = level_of(pair.q, r);
        moved.zncc = correlate(pair.p, pair.lp, pair.q, moved_lq, r);
        if (static_cast<double>(moved_lq.sigma) < sigma_min)
            return false;
    }
    if (moved.zncc < local.zncc)
        return false;
    local = moved;
    return true;
}

} // namespace pipefish::match
