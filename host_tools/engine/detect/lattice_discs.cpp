// A grid among discs: grown from one and its neighbours.
#include "lattice_steps.hpp"

#include <algorithm>
#include <cmath>
#include <set>

namespace pipefish::detect
{

namespace
{

// How far apart two discs are, in radii: the ellipse of each is a unit circle in its own measure, whichever way the
// sheet is turned; the mean of both measures cancels what perspective does to one. The same for all neighbours of a
// lattice along a step, on a plane and on a pipe's wall.
double apart(const Blob &a, const Blob &b)
{
    const Eigen::Vector2d way = b.at - a.at;
    return 0.5 * (a.half_axes.inverse() * way).norm() + 0.5 * (b.half_axes.inverse() * way).norm();
}

bool alike(const Blob &a, const Blob &b)
{
    const double ratio = std::abs(a.half_axes.determinant() / b.half_axes.determinant());
    return ratio > 0.35 && ratio < 2.8;
}

constexpr double kSameStep = 0.15; // of a step, in radii: 2 % is usual, in any lens and on a pipe's wall

struct Seed { // a blob and its neighbours at (1, 0) and (0, 1)
    int middle;
    std::array<int, 2> beside;
};

// The blob that is as far from those beside a site, in radii, as the seed's are along the same step, and nearest to
// where the site is forecast; -1: none.
int by_steps(const std::vector<Blob> &blobs, const Seed &seed, const Grid &grid, const Site &site,
             const Eigen::Vector2d &place)
{
    int best = -1;
    double least = 0.6; // steps
    for (size_t k = 0; k < blobs.size(); k++) {
        double off = 0.0;
        for (size_t d = 0; d < 4; d++) {
            const auto near = grid.find(plus(site, kSteps[d]));
            if (near == grid.end())
                continue;
            const double usual = apart(blobs[size_t(seed.middle)], blobs[size_t(seed.beside[d % 2])]);
            const double ratio = apart(blobs[k], blobs[size_t(near->second.code)]) / usual;
            off = std::max({off, (blobs[k].half_axes.inverse() * (blobs[k].at - place)).norm() / usual,
                            std::abs(ratio - 1.0) > kSameStep ? 1.0 : 0.0});
        }
        if (off < least) {
            least = off;
            best = static_cast<int>(k);
        }
    }
    return best;
}

Grid grow_blobs(const std::vector<Blob> &blobs, const Seed &seed)
{
    Grid grid;
    std::set<int> used;
    const auto put = [&](const Site &site, int k) {
        Point p;
        p.at = blobs[size_t(k)].at;
        p.code = k; // which blob, until the grid is chosen
        grid[site] = p;
        used.insert(k);
    };
    put({0, 0}, seed.middle);
    put(kSteps[0], seed.beside[0]);
    put(kSteps[1], seed.beside[1]);
    for (bool more = true; more;) {
        more = false;
        std::set<Site> border;
        for (const auto &[site, point] : grid)
            for (const Site &step : kSteps)
                if (!grid.contains(plus(site, step)))
                    border.insert(plus(site, step));
        for (const Site &site : border) {
            const auto f = forecast(grid, site, 0, false);
            if (!f)
                continue;
            const int k = by_steps(blobs, seed, grid, site, f->at);
            if (k < 0 || used.contains(k))
                continue;
            bool fits = true;
            for (const Site &s : kSteps)
                if (const auto near = grid.find(plus(site, s)); near != grid.end())
                    fits = fits && alike(blobs[size_t(k)], blobs[size_t(near->second.code)]);
            if (!fits)
                continue;
            put(site, k);
            more = true;
        }
    }
    return grid;
}

// The share of neighbours that are as far apart, in radii, as is usual along their step (point.code: which blob).
double regularity(const std::vector<Blob> &blobs, const Grid &grid)
{
    size_t right = 0, all = 0;
    for (size_t d = 0; d < 2; d++) {
        std::vector<double> steps;
        for (const auto &[site, point] : grid)
            if (const auto next = grid.find(plus(site, kSteps[d])); next != grid.end())
                steps.push_back(apart(blobs[size_t(point.code)], blobs[size_t(next->second.code)]));
        if (steps.empty())
            return 0.0;
        std::vector<double> sorted = steps;
        std::nth_element(sorted.begin(), sorted.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2), sorted.end());
        const double usual = sorted[steps.size() / 2];
        all += steps.size();
        right += static_cast<size_t>(
            std::count_if(steps.begin(), steps.end(), [&](double x) { return std::abs(x / usual - 1.0) < kSameStep; }));
    }
    return static_cast<double>(right) / static_cast<double>(all);
}

// The change of base that makes steps u, v as short as they can be (Gauss's reduction): new site = m * site.
std::array<int, 4> shortening(Eigen::Vector2d u, Eigen::Vector2d v)
{
    std::array<int, 4> m = {1, 0, 0, 1};
    for (int round = 0; round < 20; round++) {
        // Sites are i u + j v: where u loses v, j gains i.
        const int k = static_cast<int>(std::lround(u.dot(v) / v.squaredNorm()));
        const int l = k ? 0 : static_cast<int>(std::lround(u.dot(v) / u.squaredNorm()));
        if (!k && !l)
            break;
        u -= k * v;
        m = {m[0], m[1], m[2] + k * m[0], m[3] + k * m[1]};
        v -= l * u;
        m = {m[0] + l * m[2], m[1] + l * m[3], m[2], m[3]};
    }
    return m;
}

// The same grid on the lattice's shortest base, by a vote of its sites: a seed at the border of a grid may have found a
// slanted one.
Grid with_short_steps(const Grid &grid)
{
    std::map<std::array<int, 4>, int> votes;
    for (const auto &[site, point] : grid)
        if (const auto f = forecast(grid, site, 0, true))
            votes[shortening(f->cell.col(0), f->cell.col(1))]++;
    std::array<int, 4> m = {1, 0, 0, 1};
    int most = 0;
    for (const auto &[matrix, count] : votes)
        if (count > most) {
            most = count;
            m = matrix;
        }
    Grid out;
    for (const auto &[site, point] : grid)
        out[{m[0] * site[0] + m[1] * site[1], m[2] * site[0] + m[3] * site[1]}] = point;
    return out;
}

// The two nearest neighbours of a blob, in radii, that lie well apart around it.
std::optional<Seed> seed_at(const std::vector<Blob> &blobs, int i)
{
    const Blob &a = blobs[size_t(i)];
    const Eigen::Matrix2d to_circle = a.half_axes.inverse();
    const double turn = to_circle.determinant() > 0 ? 1.0 : -1.0;
    std::vector<std::pair<double, int>> near;
    for (size_t j = 0; j < blobs.size(); j++)
        if (static_cast<int>(j) != i && alike(a, blobs[j]))
            near.push_back({apart(a, blobs[j]), static_cast<int>(j)});
    const size_t kept = std::min<size_t>(near.size(), 6);
    std::partial_sort(near.begin(), near.begin() + static_cast<std::ptrdiff_t>(kept), near.end());
    for (size_t k = 1; k < kept; k++) {
        const Eigen::Vector2d u = to_circle * (blobs[size_t(near[0].second)].at - a.at);
        const Eigen::Vector2d v = to_circle * (blobs[size_t(near[k].second)].at - a.at);
        const double sine = turn * cross(u, v) / (u.norm() * v.norm());
        if (std::abs(sine) < 0.75 || near[k].first > 1.5 * near[0].first)
            continue;
        const int one = near[0].second, two = near[k].second;
        return sine > 0 ? Seed{i, {one, two}} : Seed{i, {two, one}};
    }
    return std::nullopt;
}

} // namespace

Grid grid_of_blobs(const std::vector<Blob> &blobs)
{
    double score = 0.0;
    Grid best;
    const int n = static_cast<int>(blobs.size());
    std::set<int> covered;
    int tries = 0;
    for (int i = 0; i < n && tries < 60; i++) {
        const std::optional<Seed> seed = covered.contains(i) ? std::nullopt : seed_at(blobs, i);
        if (!seed)
            continue;
        Grid grid = grow_blobs(blobs, *seed);
        tries++;
        prune(grid);
        // Larger is better, and more regular: a wrong start may string the same blobs together askew.
        const double regular = regularity(blobs, grid), now = static_cast<double>(grid.size()) * regular * regular;
        if (now > score) {
            score = now;
            covered.clear();
            for (const auto &[site, point] : grid)
                covered.insert(point.code);
            best = std::move(grid);
        }
    }
    for (auto &[site, point] : best)
        point.code = 0;
    return with_short_steps(best);
}

} // namespace pipefish::detect
