#include "match/seeds.hpp"

#include "parallel.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace pipefish::match
{

namespace
{

struct Choice {
    int best = -1;
    float distance = 4, next = 4; // squared; `next` of a region elsewhere
};

// For each region of `from` its best in `to`. In strips: the products of all with all would be too large.
std::vector<Choice> choose(const Described &from, const Described &to, int threads)
{
    constexpr int strip = 256;
    const int n = static_cast<int>(from.regions.size()), m = static_cast<int>(to.regions.size());
    std::vector<Choice> out(static_cast<size_t>(n));
    parallel_for((n + strip - 1) / strip, threads, [&](int s) {
        const int begin = s * strip, count = std::min(strip, n - begin);
        Eigen::MatrixXf product(m, count);
        product.noalias() = to.descriptors.transpose() * from.descriptors.middleCols(begin, count);
        for (int k = 0; k < count; k++) {
            Choice &c = out[static_cast<size_t>(begin + k)];
            Eigen::Index best = 0;
            c.distance = 2 - 2 * product.col(k).maxCoeff(&best);
            c.best = static_cast<int>(best);
            const Eigen::Vector2d at = to.regions[static_cast<size_t>(best)].at;
            for (int i = 0; i < m; i++) {
                const float d = 2 - 2 * product(i, k);
                if (d < c.next && (to.regions[static_cast<size_t>(i)].at - at).squaredNorm() > 25)
                    c.next = d; // not the same place in another shape
            }
        }
    });
    return out;
}

} // namespace

std::vector<Seed> find_seeds(const ScaleStack &first, const ScaleStack &second, const SeedOptions &options)
{
    const Described one = describe_regions(first, options.regions), two = describe_regions(second, options.regions);
    if (one.regions.empty() || two.regions.empty())
        return {};
    const std::vector<Choice> there = choose(one, two, options.regions.threads);
    const std::vector<Choice> back = choose(two, one, options.regions.threads);
    std::vector<std::pair<float, Seed>> found;
    const auto most = static_cast<float>(options.ratio * options.ratio);
    for (size_t k = 0; k < there.size(); k++) {
        const Choice &c = there[k];
        const Region &r = one.regions[k], &r_2 = two.regions[static_cast<size_t>(c.best)];
        const Choice &b = back[static_cast<size_t>(c.best)];
        const bool mutual = (one.regions[static_cast<size_t>(b.best)].at - r.at).squaredNorm() < 25;
        if (mutual && c.distance < most * c.next)
            found.emplace_back(c.distance / c.next, Seed{r.at, r_2.at, r_2.shape * r.shape.inverse()});
    }
    std::stable_sort(found.begin(), found.end(), [](const auto &p, const auto &q) { return p.first < q.first; });
    std::vector<Seed> out;
    for (size_t k = 0; k < std::min(found.size(), static_cast<size_t>(options.most)); k++)
        out.push_back(found[k].second);
    return out;
}

} // namespace pipefish::match
