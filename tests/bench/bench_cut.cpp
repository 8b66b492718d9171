// segment.cut_wrong: how many of 3000 random functions of 3 to 12 binary variables end above their minimum, which is
// found by trying all; segment.cut_s: processor time of a cut of 640 x 480 variables with eight neighbours, least of
// three. Beside OpenCV's detail::GCGraph.
#include "segment/cut.hpp"

#include <opencv2/core.hpp>
#include <opencv2/imgproc/detail/gcgraph.hpp>

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <random>

namespace
{

using Random = std::mt19937_64;
using pipefish::segment::Cut;

struct Pair {
    int i, j;
    int64_t forth, back; // paid where i is 0 and j is 1, and the other way
};

struct Function {
    std::vector<int64_t> zero, one;
    std::vector<Pair> pairs;

    int64_t operator()(const std::vector<bool> &x) const
    {
        int64_t sum = 0;
        for (size_t i = 0; i < x.size(); i++)
            sum += x[i] ? one[i] : zero[i];
        for (const Pair &p : pairs) {
            const bool a = x[static_cast<size_t>(p.i)], b = x[static_cast<size_t>(p.j)];
            sum += !a && b ? p.forth : a && !b ? p.back : 0;
        }
        return sum;
    }
};

std::vector<bool> ours(const Function &f)
{
    Cut cut;
    cut.start(static_cast<int>(f.zero.size()));
    for (size_t i = 0; i < f.zero.size(); i++)
        cut.add(static_cast<int>(i), f.zero[i], f.one[i]);
    for (const Pair &p : f.pairs)
        cut.add(p.i, p.j, {0, p.forth, p.back, 0});
    cut.solve();
    std::vector<bool> x(f.zero.size());
    for (size_t i = 0; i < x.size(); i++)
        x[i] = cut.one(static_cast<int>(i));
    return x;
}

std::vector<bool> opencv(const Function &f)
{
    cv::detail::GCGraph<double> graph(static_cast<unsigned>(f.zero.size()), static_cast<unsigned>(2 * f.pairs.size()));
    for (size_t i = 0; i < f.zero.size(); i++)
        graph.addTermWeights(graph.addVtx(), static_cast<double>(f.one[i]), static_cast<double>(f.zero[i]));
    for (const Pair &p : f.pairs)
        graph.addEdges(p.i, p.j, static_cast<double>(p.forth), static_cast<double>(p.back));
    graph.maxFlow();
    std::vector<bool> x(f.zero.size());
    for (size_t i = 0; i < x.size(); i++)
        x[i] = !graph.inSourceSegment(static_cast<int>(i));
    return x;
}

int64_t least(const Function &f)
{
    int64_t best = INT64_MAX;
    std::vector<bool> x(f.zero.size());
    for (unsigned choice = 0; choice < 1U << x.size(); choice++) {
        for (size_t i = 0; i < x.size(); i++)
            x[i] = (choice >> i & 1U) != 0;
        best = std::min(best, f(x));
    }
    return best;
}

Function small(Random &random)
{
    const auto upto = [&](int n) { return static_cast<int>(random() % static_cast<unsigned>(n + 1)); };
    const int n = 3 + upto(9);
    Function f;
    for (int i = 0; i < n; i++) {
        f.zero.push_back(upto(20));
        f.one.push_back(upto(20));
        for (int j = i + 1; j < n; j++)
            if (upto(2) == 0 || j == 1) // OpenCV wants one at least
                f.pairs.push_back({i, j, upto(10), upto(10)});
    }
    return f;
}

Function picture(Random &random)
{
    constexpr int kWidth = 640, kHeight = 480;
    const auto upto = [&](int n) { return static_cast<int64_t>(random() % static_cast<unsigned>(n + 1)); };
    Function f;
    for (int y = 0; y < kHeight; y++)
        for (int x = 0; x < kWidth; x++) {
            const int p = y * kWidth + x;
            const bool inside = (x - 320) * (x - 320) + (y - 240) * (y - 240) < 150 * 150;
            f.zero.push_back(upto(inside ? 4000 : 2000));
            f.one.push_back(upto(inside ? 2000 : 4000));
            for (const auto &[dx, dy] : {std::pair(1, 0), {0, 1}, {1, 1}, {-1, 1}})
                if (x + dx >= 0 && x + dx < kWidth && y + dy < kHeight) {
                    const int64_t cost = 300 + upto(1000);
                    f.pairs.push_back({p, p + dy * kWidth + dx, cost, cost});
                }
        }
    return f;
}

template <typename Solve> double seconds(const Solve &solve, const Function &f)
{
    double best = 1e9;
    for (int k = 0; k < 3; k++) {
        const std::clock_t start = std::clock();
        solve(f);
        best = std::min(best, static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC);
    }
    return best;
}

} // namespace

int main()
{
    Random random(1);
    int wrong[2] = {0, 0};
    for (int k = 0; k < 3000; k++) {
        const Function f = small(random);
        const int64_t best = least(f);
        wrong[0] += f(ours(f)) != best;
        wrong[1] += f(opencv(f)) != best;
    }
    const char *line = "{\"name\": \"%s\", \"value\": %g, \"unit\": \"%s\", \"peer\": \"OpenCV GCGraph\", "
                       "\"peer_value\": %g}\n";
    std::printf(line, "segment.cut_wrong", wrong[0] * 1.0, "of 3000", wrong[1] * 1.0);
    const Function f = picture(random);
    std::printf(line, "segment.cut_s", seconds(ours, f), "s", seconds(opencv, f));
    return 0;
}
