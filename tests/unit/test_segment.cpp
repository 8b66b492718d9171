// What motion segmentation rests on: cuts against all choices of small functions, wherever their flow starts; and the
// systems of its fields against a dense solver. That layers come of it is the subject of tests/python/test_segment.py.
#include "segment/cut.hpp"
#include "segment/expand.hpp"
#include "segment/layer.hpp"
#include "segment/system.hpp"

#include "unity.h"

#include <Eigen/Dense>

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <memory>
#include <random>
#include <stdexcept>
#include <vector>

extern "C" void setUp() {}
extern "C" void tearDown() {}

namespace
{

using namespace pipefish::segment;
using Random = std::mt19937_64;

int upto(Random &random, int most)
{
    return static_cast<int>(random() % static_cast<unsigned>(most + 1));
}

// A function of binary variables: costs of each, and of pairs, submodular.
struct Function {
    struct Pair {
        int i, j;
        std::array<int64_t, 4> cost;
    };
    std::vector<std::array<int64_t, 2>> one;
    std::vector<Pair> pairs;

    explicit Function(Random &random) : one(static_cast<size_t>(3 + upto(random, 6)))
    {
        const auto n = static_cast<int>(one.size());
        for (auto &c : one)
            c = {upto(random, 20), upto(random, 20)};
        for (int i = 0; i < n; i++)
            for (int j = i + 1; j < n; j++)
                if (upto(random, 2) == 0) {
                    std::array<int64_t, 4> c = {upto(random, 9), upto(random, 9), upto(random, 9), upto(random, 9)};
                    c[1] += std::max<int64_t>(0, c[0] + c[3] - c[1] - c[2]);
                    pairs.push_back({i, j, c});
                }
    }

    int64_t operator()(unsigned choice) const
    {
        int64_t sum = 0;
        for (size_t k = 0; k < one.size(); k++)
            sum += one[k][choice >> k & 1U];
        for (const Pair &p : pairs)
            sum += p.cost[2 * (choice >> p.i & 1U) + (choice >> p.j & 1U)];
        return sum;
    }

    // Of least cost, and of these the one with the most ones.
    unsigned best() const
    {
        unsigned out = 0;
        for (unsigned choice = 1; choice < 1U << one.size(); choice++)
            if ((*this)(choice) < (*this)(out) ||
                ((*this)(choice) == (*this)(out) && std::popcount(choice) > std::popcount(out)))
                out = choice;
        return out;
    }

    // By `cut`, flows guessed up to `wild`.
    unsigned solve(Cut &cut, Random &random, int wild, int64_t &least) const
    {
        cut.start(static_cast<int>(one.size()));
        for (size_t k = 0; k < one.size(); k++)
            cut.add(static_cast<int>(k), one[k][0], one[k][1]);
        for (const Pair &p : pairs)
            cut.add(p.i, p.j, {p.cost[0], p.cost[1], p.cost[2], p.cost[3]}, upto(random, 2 * wild) - wild);
        least = cut.solve();
        unsigned out = 0;
        for (size_t k = 0; k < one.size(); k++)
            out |= cut.one(static_cast<int>(k)) ? 1U << k : 0U;
        return out;
    }
};

void test_a_cut_is_the_best_of_all_choices_wherever_its_flow_starts()
{
    Random random(1);
    Cut cut;
    for (int k = 0; k < 2000; k++) {
        const Function f(random);
        const unsigned best = f.best();
        for (const int wild : {0, 5, 1000}) {
            int64_t least = 0;
            TEST_ASSERT_EQUAL_UINT(best, f.solve(cut, random, wild, least));
            TEST_ASSERT_EQUAL_INT64(f(best), least);
        }
    }
}

void test_a_cut_that_starts_from_its_own_flow_ends_with_it()
{
    Cut cut;
    for (int32_t start = 0, round = 0; round < 2; round++) {
        cut.start(2);
        cut.add(0, 0, 50);
        cut.add(1, 30, 0);
        const int pair = cut.add(0, 1, {0, 20, 5, 0}, start);
        TEST_ASSERT_EQUAL_INT64(20, cut.solve());
        start = cut.flow(pair);
        TEST_ASSERT_EQUAL_INT32(20, start);
    }
}

void test_a_cut_refuses_what_it_cannot_solve()
{
    Cut cut;
    cut.start(2);
    for (const int64_t cost : {int64_t{-1}, int64_t{1} << 31}) {
        bool refused = false;
        try {
            cut.add(0, 1, {0, cost, 0, 0});
        } catch (const std::invalid_argument &) {
            refused = true;
        }
        TEST_ASSERT_TRUE(refused);
    }
}

void test_flows_of_another_problem_leave_the_labels_as_they_are()
{
    constexpr int kWidth = 9, kPixels = 63, kLabels = 3;
    Random random(2);
    std::vector<Flows> kept;
    for (int round = 0; round < 50; round++) {
        Grid grids[2] = {{kWidth, {}}, {kWidth, {}}};
        Problem problem;
        for (Grid &grid : grids) {
            for (int p = 0; p < kPixels; p++) {
                const int x = p % kWidth, y = p / kWidth;
                const bool right = x + 1 < kWidth, below = y + 1 < kPixels / kWidth;
                grid.cost.push_back({right ? upto(random, 8) : 0, below ? upto(random, 8) : 0,
                                     right && below ? upto(random, 8) : 0, x > 0 && below ? upto(random, 8) : 0});
            }
            problem.grids.push_back(&grid);
        }
        problem.lonely = 5;
        problem.cost.assign(kLabels, std::vector<int32_t>(2 * kPixels));
        problem.partner.assign(kLabels, std::vector<int32_t>(2 * kPixels, -1));
        for (size_t k = 0; k < kLabels; k++)
            for (size_t p = 0; p < 2 * kPixels; p++) {
                problem.cost[k][p] = k > 0 && upto(random, 5) == 0 ? Problem::kNever : upto(random, 60);
                if (k > 0)
                    problem.partner[k][p] = upto(random, kPixels - 1) + (p < kPixels ? kPixels : 0);
            }
        Labels fresh(2 * kPixels, 0), started = fresh;
        std::vector<Flows> none;
        expand(problem, 5, fresh, none);
        expand(problem, 5, started, kept);
        TEST_ASSERT_TRUE(fresh == started);
        TEST_ASSERT_TRUE(problem.energy(fresh) < problem.energy(Labels(2 * kPixels, 0)));
    }
}

// A system over a grid and the same densely: the sum of costs of random pairs of points near each other.
struct Both {
    System system;
    Eigen::MatrixXd dense;

    Both(const std::shared_ptr<const Pattern> &pattern, int nx, int ny, int reach, unsigned seed, double weight)
        : system(pattern), dense(Eigen::MatrixXd::Zero(2 * nx * ny, 2 * nx * ny))
    {
        Random random(seed);
        std::normal_distribution<double> normal;
        for (int p = 0; p < nx * ny; p++)
            for (int k = 0; k < 6; k++) {
                const int dy = upto(random, reach),
                          dx = dy == 0 ? upto(random, reach) : upto(random, 2 * reach) - reach;
                const int x = p % nx + dx, y = p / nx + dy, q = y * nx + x;
                if (x < 0 || x >= nx || y >= ny)
                    continue;
                const double a = normal(random), b = normal(random), c = 1 + weight * std::abs(normal(random));
                const Eigen::Matrix2d own = c * (Eigen::Matrix2d() << a * a + 1, a * b, a * b, b * b + 1).finished();
                const auto put = [&](int from, int i, int j, const Eigen::Matrix2d &m) {
                    system.add(static_cast<size_t>(from), i, j, m(0, 0), m(0, 1), m(1, 1));
                    const int to = from + j * nx + i;
                    dense.block<2, 2>(2 * from, 2 * to) += m;
                    if (from != to)
                        dense.block<2, 2>(2 * to, 2 * from) += m;
                };
                put(p, 0, 0, own);
                if (p != q) {
                    put(q, 0, 0, own);
                    put(p, dx, dy, -0.9 * own);
                }
            }
        for (Eigen::Index k = 0; k < system.right().size(); k++)
            system.right()[k] = normal(random);
    }
};

void test_systems_over_grids_are_solved_as_dense_ones()
{
    for (const auto &[nx, ny, reach] : {std::array{23, 17, 3}, {5, 31, 3}, {4, 4, 3}, {19, 20, 1}, {1, 1, 1}}) {
        const auto pattern = std::make_shared<const Pattern>(nx, ny, reach);
        Both both(pattern, nx, ny, reach, 3, 1);
        const Eigen::VectorXd right = both.system.right(), truth = both.dense.ldlt().solve(right);
        TEST_ASSERT_TRUE((both.system.solve() - truth).norm() < 1e-9 * truth.norm());
    }
}

void test_a_similar_systems_factor_serves_and_another_is_replaced()
{
    constexpr int nx = 21, ny = 14;
    const auto pattern = std::make_shared<const Pattern>(nx, ny, 3);
    const Both first(pattern, nx, ny, 3, 4, 1), unlike(pattern, nx, ny, 3, 5, 1000);
    Both near(pattern, nx, ny, 3, 4, 1.2);
    const auto start = std::make_shared<const Factor>(first.system);
    std::shared_ptr<const Factor> factor = start;
    const Eigen::VectorXd right = near.system.right(), truth = near.dense.ldlt().solve(right);
    const Eigen::VectorXd off = near.system.solve(factor) - truth;
    TEST_ASSERT_TRUE(factor == start);
    TEST_ASSERT_TRUE(off.dot(near.dense * off) < 1e-3 * truth.dot(near.dense * truth) && off.norm() > 0);
    Both far(unlike);
    const Eigen::VectorXd other = far.dense.ldlt().solve(far.system.right());
    TEST_ASSERT_TRUE((far.system.solve(factor) - other).norm() < 1e-9 * other.norm());
    TEST_ASSERT_TRUE(factor != start);
}

void test_a_system_without_a_minimum_is_refused()
{
    const auto pattern = std::make_shared<const Pattern>(6, 5, 1);
    Both both(pattern, 6, 5, 1, 6, 1);
    both.system.add(7, 0, 0, -1000, 0, 0);
    bool refused = false;
    try {
        both.system.solve();
    } catch (const std::runtime_error &) {
        refused = true;
    }
    TEST_ASSERT_TRUE(refused);
}

} // namespace

// Of a layer that does not move, over noise, the cost at (20, 20) where `ties` lie on that pixel.
int32_t cost_with(const Picture &picture, const std::vector<Tie> &ties)
{
    const cv::Rect box({0, 0}, picture.size());
    Side side;
    side.here = side.there = &picture;
    side.ties = ties;
    side.reach = cv::Mat_<uint8_t>(box.size(), uint8_t{1});
    side.warp.lattice = side.light = Lattice(box, 16);
    const auto points = static_cast<Eigen::Index>(side.light.points());
    side.warp.d = Eigen::VectorXd::Zero(2 * points);
    side.gain.assign(1, Eigen::VectorXd::Ones(points));
    side.offset.assign(1, Eigen::VectorXd::Zero(points));
    side.sigma.assign(1, kLeastNoise);
    return look(side).cost(20, 20);
}

void test_matches_on_one_pixel_speak_for_it_as_the_best_of_them()
{
    Random random(3);
    Image noise(48, 48);
    for (float &v : noise)
        v = static_cast<float>(upto(random, 255)) / 255;
    const Picture picture(std::vector<Image>{noise});
    const Tie exact{{20, 20}, {20, 20}, 0.9}, near{{20.2, 19.9}, {20.2, 20.9}, 0.9};
    const int32_t none = cost_with(picture, {}), one = cost_with(picture, {exact});
    TEST_ASSERT_EQUAL_INT32(900, none - one);
    TEST_ASSERT_TRUE(cost_with(picture, {near}) > one && cost_with(picture, {near}) < none);
    TEST_ASSERT_EQUAL_INT32(one, cost_with(picture, {near, exact, near, exact}));
}

int main()
{
    UNITY_BEGIN();
    RUN_TEST(test_a_cut_is_the_best_of_all_choices_wherever_its_flow_starts);
    RUN_TEST(test_a_cut_that_starts_from_its_own_flow_ends_with_it);
    RUN_TEST(test_a_cut_refuses_what_it_cannot_solve);
    RUN_TEST(test_flows_of_another_problem_leave_the_labels_as_they_are);
    RUN_TEST(test_systems_over_grids_are_solved_as_dense_ones);
    RUN_TEST(test_a_similar_systems_factor_serves_and_another_is_replaced);
    RUN_TEST(test_a_system_without_a_minimum_is_refused);
    RUN_TEST(test_matches_on_one_pixel_speak_for_it_as_the_best_of_them);
    return UNITY_END();
}
