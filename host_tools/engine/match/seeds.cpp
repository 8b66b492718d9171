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

// For each region of one image its best in the other, and the reverse (without `next`).
struct Choices {
    std::vector<Choice> there, back;
};

// In strips: the products of all with all would be too large.
Choices choose(const Described &one, const Described &two, int threads)
{
    constexpr int strip = 256;
    const int n = static_cast<int>(one.regions.size()), m = static_cast<int>(two.regions.size());
    const int strips = (n + strip - 1) / strip;
    Choices out{std::vector<Choice>(static_cast<size_t>(n)), std::vector<Choice>(static_cast<size_t>(m))};
    std::vector<std::vector<Choice>> back(static_cast<size_t>(strips));
    parallel_for(strips, threads, [&](int s) {
        const int begin = s * strip, count = std::min(strip, n - begin);
        Eigen::MatrixXf product(m, count);
        product.noalias() = two.descriptors.transpose() * one.descriptors.middleCols(begin, count);
        std::vector<Choice> &column = back[static_cast<size_t>(s)];
        column.resize(static_cast<size_t>(m));
        for (int k = 0; k < count; k++) {
            Choice &c = out.there[static_cast<size_t>(begin + k)];
            Eigen::Index best = 0;
            c.distance = 2 - 2 * product.col(k).maxCoeff(&best);
            c.best = static_cast<int>(best);
            const Eigen::Vector2d at = two.regions[static_cast<size_t>(best)].at;
            for (int i = 0; i < m; i++) {
                const float d = 2 - 2 * product(i, k);
                Choice &b = column[static_cast<size_t>(i)];
                if (d < b.distance)
                    b = {begin + k, d, 4};
                if (d < c.next && (two.regions[static_cast<size_t>(i)].at - at).squaredNorm() > 25)
                    c.next = d; // not the same place in another shape
            }
        }
    });
    for (const std::vector<Choice> &column : back) // in order: the first of equals stays
        for (size_t i = 0; i < column.size(); i++)
            if (column[i].distance < out.back[i].distance)
                out.back[i] = column[i];
    return out;
}

} // namespace

std::vector<Seed> match_regions(const Described &one, const Described &two, const SeedOptions &options)
{
    if (one.regions.empty() || two.regions.empty())
        return {};
    const auto [there, back] = choose(one, two, options.regions.threads);
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

std::vector<Seed> find_seeds(const ScaleStack &first, const ScaleStack &second, const SeedOptions &options)
{
    return match_regions(describe_regions(first, options.regions), describe_regions(second, options.regions), options);
}

} // namespace pipefish::match
