// The optimiser against dense linear algebra on the same problem: steps, covariances, thread independence, and what it
// says when something is not determined.
#include "optim/least_squares.hpp"

#include "unity.h"

#include <Eigen/Dense>

#include <cstring>
#include <random>

extern "C" void setUp() {}
extern "C" void tearDown() {}

namespace
{

using namespace pipefish::optim;

constexpr int E = 3, F = 6, G = 4, POINTS = 60, CHAIN = 14;

template <int Columns> using Rows = Eigen::Matrix<double, Eigen::Dynamic, Columns, Eigen::RowMajor>;

// Residuals A x - y + curvature (a . x)^2 over random sparse rows: with curvature 0 the solution is that of dense least
// squares. One to three rows share a loss; pixels have two, and a way of their own. Each point is seen from three to
// five neighbours in the chain; neighbours are tied; the border is seen by all.
struct Toy {
    struct Row {
        int e;
        std::vector<int> f;
        Rows<Eigen::Dynamic> a; // columns: E, F for each of f, G
        Eigen::VectorXd y;
    };
    std::vector<std::vector<Row>> rows; // by e; the last: without e
    std::vector<std::vector<int>> seen;
    double curvature = 0.0;
    RobustLoss loss;
    bool border_seen = true;
    Eigen::VectorXd x = Eigen::VectorXd::Zero(POINTS * E + CHAIN * F + G), saved = x;

    explicit Toy(unsigned seed)
    {
        std::mt19937_64 random(seed);
        std::normal_distribution<double> normal;
        int next = 0;
        const auto row = [&](int e, std::vector<int> f) {
            Row r{e, std::move(f), {}, {}};
            r.y.resize(e >= 0 ? 3 - next++ % 3 : 2); // any two of a point determine it
            for (double &y : r.y) {
                y = normal(random);
            }
            r.a.resize(r.y.size(), (e >= 0 ? E : 0) + F * static_cast<int>(r.f.size()) + G);
            for (Eigen::Index i = 0; i < r.a.size(); i++) {
                r.a.data()[i] = normal(random);
            }
            return r;
        };
        rows.resize(POINTS + 1);
        for (int e = 0; e < POINTS; e++) {
            const int first = static_cast<int>(random() % (CHAIN - 4)), count = 3 + static_cast<int>(random() % 3);
            std::vector<int> f;
            for (int k = 0; k < count && first + k < CHAIN; k++) {
                if (k != 1) {
                    f.push_back(first + k);
                }
            }
            for (const int i : f) {
                rows[static_cast<size_t>(e)].push_back(row(e, {i}));
            }
            seen.push_back(f);
        }
        for (int i = 0; i + 1 < CHAIN; i++) {
            rows.back().push_back(row(-1, {i + 1, i}));
        }
        for (int i = 0; i < 3 * CHAIN; i++) { // determines every f block, seen by points or not
            rows.back().push_back(row(-1, {i % CHAIN}));
        }
    }

    int eliminated() const { return POINTS; }
    int banded() const { return CHAIN; }
    int border() const { return G; }
    int reach() const { return 1; }
    std::span<const int> couplings(int e) const { return seen[static_cast<size_t>(e)]; }
    const std::vector<Row> &of(int e) const { return rows[e < 0 ? rows.size() - 1 : static_cast<size_t>(e)]; }

    Eigen::VectorXd local(const Row &row, const Eigen::VectorXd &from) const
    {
        Eigen::VectorXd v(row.a.cols());
        Eigen::Index at = 0;
        if (row.e >= 0) {
            v.head(E) = from.segment(row.e * E, E);
            at = E;
        }
        for (const int f : row.f) {
            v.segment(at, F) = from.segment(POINTS * E + f * F, F);
            at += F;
        }
        v.tail(G) = from.tail(G);
        return v;
    }

    Eigen::VectorXd residual(const Row &row, Rows<Eigen::Dynamic> *jacobian) const
    {
        const Eigen::VectorXd linear = row.a * local(row, x);
        if (jacobian) {
            *jacobian = row.a;
            for (Eigen::Index i = 0; i < linear.size(); i++) {
                jacobian->row(i) *= 1.0 + 2.0 * curvature * linear[i];
            }
            if (!border_seen) {
                jacobian->rightCols(1).setZero();
            }
        }
        return linear - row.y + curvature * Eigen::VectorXd(linear.cwiseProduct(linear));
    }

    template <class Sink> void linearize(int e, Sink &sink) const
    {
        for (const Row &row : of(e)) {
            Rows<Eigen::Dynamic> j;
            const Eigen::VectorXd r = residual(row, &j);
            const Rows<E> j_e = j.leftCols(E); // of no meaning where e < 0
            std::vector<Rows<F>> j_f;
            std::vector<const double *> j_f_at;
            for (size_t k = 0; k < row.f.size(); k++) {
                j_f.push_back(j.middleCols((row.e >= 0 ? E : 0) + static_cast<Eigen::Index>(k) * F, F));
            }
            for (const auto &block : j_f) {
                j_f_at.push_back(block.data());
            }
            const Rows<G> j_g = j.rightCols(G);
            sink.add(static_cast<int>(r.size()), r.data(), loss, row.e >= 0 ? j_e.data() : nullptr, row.f, j_f_at,
                     j_g.data());
        }
    }

    double cost(int e) const
    {
        double sum = 0.0;
        for (const Row &row : of(e)) {
            sum += 0.5 * loss(residual(row, nullptr).squaredNorm()).rho;
        }
        return sum;
    }

    void apply(const Step<E, F> &step)
    {
        x = saved;
        for (int e = 0; e < POINTS; e++) {
            x.segment(e * E, E) += step.e[static_cast<size_t>(e)];
        }
        for (int f = 0; f < CHAIN; f++) {
            x.segment(POINTS * E + f * F, F) += step.f[static_cast<size_t>(f)];
        }
        x.tail(G) += step.g;
    }
    void save() { saved = x; }

    // All rows as one dense matrix and right-hand side, at the current state, with robust weights.
    void dense(Eigen::MatrixXd &a, Eigen::VectorXd &r) const
    {
        std::vector<Eigen::VectorXd> all;
        std::vector<double> right;
        for (const auto &group : rows) {
            for (const Row &row : group) {
                Rows<Eigen::Dynamic> j;
                const Eigen::VectorXd value = residual(row, &j);
                const double root = std::sqrt(loss(value.squaredNorm()).weight);
                for (Eigen::Index i = 0; i < value.size(); i++) {
                    Eigen::VectorXd full = Eigen::VectorXd::Zero(x.size());
                    Eigen::Index at = 0;
                    if (row.e >= 0) {
                        full.segment(row.e * E, E) = root * j.row(i).head(E).transpose();
                        at = E;
                    }
                    for (const int f : row.f) {
                        full.segment(POINTS * E + f * F, F) += root * j.row(i).segment(at, F).transpose();
                        at += F;
                    }
                    full.tail(G) = root * j.row(i).tail(G).transpose();
                    all.push_back(full);
                    right.push_back(root * value[i]);
                }
            }
        }
        a.resize(static_cast<Eigen::Index>(all.size()), x.size());
        r.resize(a.rows());
        for (Eigen::Index i = 0; i < a.rows(); i++) {
            a.row(i) = all[static_cast<size_t>(i)].transpose();
            r[i] = right[static_cast<size_t>(i)];
        }
    }
};

// Proves: on a linear problem of arrow shape the optimum is that of a dense QR, whatever the pattern.
void test_linear_problem_equals_dense_least_squares()
{
    for (unsigned seed = 1; seed <= 20; seed++) {
        Toy toy(seed);
        Eigen::MatrixXd a;
        Eigen::VectorXd r;
        toy.dense(a, r);
        const Eigen::VectorXd expected = a.colPivHouseholderQr().solve(-r);
        LeastSquares<E, F> solver;
        Options options;
        options.cost_tolerance = options.gradient_tolerance = 0.0; // to the end
        const Summary summary = solver.minimize(toy, options);
        TEST_ASSERT_TRUE(summary.status == Status::converged);
        TEST_ASSERT_TRUE((toy.x - expected).cwiseAbs().maxCoeff() < 1e-10);
    }
}

// Counts how often it is linearized.
struct Counted : Toy {
    using Toy::Toy;
    mutable int count = 0;

    template <class Sink> void linearize(int e, Sink &sink) const
    {
        count += e < 0;
        Toy::linearize(e, sink);
    }
};

// Proves: derivatives are made once for each step, and none at the result, where they would not be used.
void test_the_result_is_not_linearized()
{
    Counted toy(1);
    toy.curvature = 0.01;
    LeastSquares<E, F> solver;
    Options options;
    options.cost_tolerance = 1e-3;
    const Summary summary = solver.minimize(toy, options);
    TEST_ASSERT_TRUE(summary.status == Status::converged);
    TEST_ASSERT_TRUE(summary.iterations > 1);
    TEST_ASSERT_EQUAL_INT(summary.iterations, toy.count);
}

// Proves: every covariance block it gives (e, f within the band, f with border, border) is that of the dense inverse.
void test_covariance_equals_dense_inverse()
{
    for (unsigned seed = 1; seed <= 10; seed++) {
        Toy toy(seed);
        LeastSquares<E, F> solver;
        solver.minimize(toy);
        const auto covariance = solver.covariance(toy, 2);
        Eigen::MatrixXd a;
        Eigen::VectorXd r;
        toy.dense(a, r);
        const Eigen::MatrixXd expected = (a.transpose() * a).inverse();
        const double tolerance = 1e-9 * expected.cwiseAbs().maxCoeff();
        for (int e = 0; e < POINTS; e++) {
            const auto block = expected.block(e * E, e * E, E, E);
            TEST_ASSERT_TRUE((covariance.e[static_cast<size_t>(e)] - block).cwiseAbs().maxCoeff() < tolerance);
        }
        for (int i = 0; i < CHAIN; i++) {
            const size_t at = static_cast<size_t>(i);
            for (size_t d = 0; d < covariance.f[at].size(); d++) {
                const auto block = expected.block(POINTS * E + i * F, POINTS * E + (i - static_cast<int>(d)) * F, F, F);
                TEST_ASSERT_TRUE((covariance.f[at][d] - block).cwiseAbs().maxCoeff() < tolerance);
            }
            const auto border = expected.block(POINTS * E + i * F, POINTS * E + CHAIN * F, F, G);
            TEST_ASSERT_TRUE((covariance.fg[at] - border).cwiseAbs().maxCoeff() < tolerance);
        }
        TEST_ASSERT_TRUE((covariance.g - expected.bottomRightCorner(G, G)).cwiseAbs().maxCoeff() < tolerance);
    }
}

// A chain of 300 vectors that goes on nearly straight, each residual mixing the coordinates in its own way; the last
// two blocks are known.
class Chain
{
public:
    static constexpr int N = 300;

    int eliminated() const { return 0; }
    int banded() const { return N; }
    int border() const { return 0; }
    int reach() const { return 2; }
    std::span<const int> couplings(int) const { return {}; }
    double cost(int) const { return 1.0; }
    template <class Step> void apply(const Step &) {}
    void save() {}
    template <class Sink> void linearize(int e, Sink &sink) const
    {
        using Rows = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
        for (int i = 0; e < 0 && i < N; i++) {
            std::srand(static_cast<unsigned>(i));
            const Rows mix = 1e2 * (Rows::Identity() + 0.7 * Rows::Random()), middle = -2.0 * mix;
            const Rows known = 1e2 * Rows::Identity();
            const double zero[3] = {0.0, 0.0, 0.0};
            const int at = N - 1 - i, blocks[3] = {at, at + 1, at + 2};
            const double *j[3] = {mix.data(), middle.data(), mix.data()};
            if (i < 2) {
                j[0] = known.data();
                sink.add(3, zero, RobustLoss{}, nullptr, std::span(blocks, 1), std::span(j, 1), nullptr);
            } else {
                sink.add(3, zero, RobustLoss{}, nullptr, blocks, j, nullptr);
            }
        }
    }
};

// Proves: along a long chain the blocks' covariances keep their digits. The recursion multiplies what is not symmetric
// in them at every step: not taken out, it is 1e165 times the variance here, and was nonsense after 80 frames of a
// survey.
void test_covariance_of_a_long_chain_keeps_its_digits()
{
    Chain chain;
    LeastSquares<1, 3> solver;
    const auto covariance = solver.covariance(chain);
    struct Dense {
        Eigen::MatrixXd h = Eigen::MatrixXd::Zero(3 * Chain::N, 3 * Chain::N);
        void add(int, const double *, const RobustLoss &, const double *, std::span<const int> f,
                 std::span<const double *const> j, const double *)
        {
            using Rows = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>;
            for (size_t a = 0; a < f.size(); a++) {
                for (size_t b = 0; b < f.size(); b++) {
                    h.block<3, 3>(3 * f[a], 3 * f[b]) += Rows(j[a]).transpose() * Rows(j[b]);
                }
            }
        }
    } dense;
    chain.linearize(-1, dense);
    const Eigen::MatrixXd half =
        Eigen::LLT<Eigen::MatrixXd>(dense.h).matrixL().solve(Eigen::MatrixXd::Identity(3 * Chain::N, 3 * Chain::N));
    for (int i = 0; i < Chain::N; i++) {
        const Eigen::MatrixXd columns = half.middleCols(3 * i, 3);
        const Eigen::Matrix3d expected = columns.transpose() * columns;
        const Eigen::Matrix3d error = covariance.f[static_cast<size_t>(i)][0] - expected;
        // The chain's condition number is about N^4: 2e-6 is what two orders of the same sums differ by.
        TEST_ASSERT_TRUE(error.cwiseAbs().maxCoeff() < 1e-4 * expected.cwiseAbs().maxCoeff());
    }
}

// Proves: the covariance of linear functions of several e blocks is that of the dense inverse, correlations included.
void test_covariance_of_functions_equals_dense_inverse()
{
    Toy toy(4);
    LeastSquares<E, F> solver;
    solver.minimize(toy);
    (void)solver.covariance(toy);
    Eigen::MatrixXd a;
    Eigen::VectorXd r;
    toy.dense(a, r);
    const Eigen::MatrixXd expected = (a.transpose() * a).inverse();
    for (int e = 0; e + 1 < POINTS; e++) {
        const int blocks[2] = {e, POINTS - 1};
        std::vector<LeastSquares<E, F>::MatrixEG> rows(2, Eigen::MatrixXd::Random(E, 3));
        rows[1].setRandom();
        Eigen::MatrixXd whole = Eigen::MatrixXd::Zero(expected.rows(), 3);
        whole.middleRows(e * E, E) = rows[0];
        whole.middleRows((POINTS - 1) * E, E) = rows[1];
        const Eigen::MatrixXd error = solver.functions(blocks, rows) - whole.transpose() * expected * whole;
        TEST_ASSERT_TRUE(error.cwiseAbs().maxCoeff() < 1e-9 * expected.cwiseAbs().maxCoeff());
    }
}

// Proves: a curved, robust problem ends where the dense gradient vanishes, and never above where it began.
void test_curved_robust_problem_ends_at_a_stationary_point()
{
    for (const RobustLoss::Kind kind : {RobustLoss::Kind::squared, RobustLoss::Kind::huber, RobustLoss::Kind::cauchy}) {
        for (unsigned seed = 1; seed <= 10; seed++) {
            Toy toy(seed);
            toy.curvature = 0.05;
            toy.loss = {kind, 1.0};
            LeastSquares<E, F> solver;
            Options options;
            options.max_iterations = 500;
            options.cost_tolerance = 1e-15;
            const Summary summary = solver.minimize(toy, options);
            TEST_ASSERT_TRUE(summary.status == Status::converged);
            TEST_ASSERT_TRUE(summary.final_cost < summary.initial_cost);
            Eigen::MatrixXd a;
            Eigen::VectorXd r;
            toy.dense(a, r);
            TEST_ASSERT_TRUE((a.transpose() * r).cwiseAbs().maxCoeff() < 1e-4);
        }
    }
}

// Proves: the same bits for 1, 2 and 5 threads.
void test_threads_do_not_change_a_bit()
{
    Eigen::VectorXd first;
    for (const int threads : {1, 2, 5}) {
        Toy toy(7);
        toy.curvature = 0.05;
        toy.loss = {RobustLoss::Kind::cauchy, 2.0};
        LeastSquares<E, F> solver;
        Options options;
        options.threads = threads;
        solver.minimize(toy, options);
        if (threads == 1) {
            first = toy.x;
        }
        TEST_ASSERT_EQUAL_MEMORY(first.data(), toy.x.data(), sizeof(double) * static_cast<size_t>(first.size()));
    }
}

// Proves: a parameter that nothing determines has no covariance (an error, not a number), and does no harm to the rest.
void test_undetermined_parameter_is_refused_a_covariance()
{
    Toy toy(3);
    toy.border_seen = false;
    LeastSquares<E, F> solver;
    const Summary summary = solver.minimize(toy);
    TEST_ASSERT_TRUE(summary.final_cost < summary.initial_cost);
    bool thrown = false;
    try {
        (void)solver.covariance(toy);
    } catch (const std::domain_error &) {
        thrown = true;
    }
    TEST_ASSERT_TRUE(thrown);
}

// Proves: a start without a finite cost is an error of the call.
void test_start_outside_the_domain_throws()
{
    Toy toy(3);
    toy.x[0] = std::numeric_limits<double>::quiet_NaN();
    LeastSquares<E, F> solver;
    bool thrown = false;
    try {
        (void)solver.minimize(toy);
    } catch (const std::invalid_argument &) {
        thrown = true;
    }
    TEST_ASSERT_TRUE(thrown);
}

// Proves: a mixture's loss is minus twice the logarithm of its density as long as that can be written down, and goes on
// beyond, where both its exponentials are 0 in double precision: finite, rising, its weight the derivative and that of
// the wide part.
void test_mixture_is_finite_however_far_off()
{
    const RobustLoss loss{RobustLoss::Kind::mixture, 30.0, 0.05};
    const auto density = [](double s) { return 0.95 * std::exp(-0.5 * s) + 0.05 / 30.0 * std::exp(-0.5 * s / 900.0); };
    for (double s = 0.0; s < 5e4; s = 1.3 * s + 0.01) {
        TEST_ASSERT_DOUBLE_WITHIN(1e-9 * (1.0 + s), -2.0 * std::log(density(s) / density(0.0)), loss(s).rho);
        const double h = 1e-4 * (1.0 + s), slope = (loss(s + h).rho - loss(s).rho) / h;
        TEST_ASSERT_TRUE(loss(s + h).weight <= loss(s).weight);
        TEST_ASSERT_DOUBLE_WITHIN(1e-3 * loss(s).weight, loss(s + 0.5 * h).weight, slope);
    }
    for (double s = 1e5, before = loss(5e4).rho; s < 1e300; before = loss(s).rho, s *= 1e3) {
        const auto [rho, weight] = loss(s);
        TEST_ASSERT_TRUE(std::isfinite(rho) && rho > before);
        TEST_ASSERT_DOUBLE_WITHIN(1e-12, 1.0 / 900.0, weight);
    }
}

} // namespace

int main()
{
    UNITY_BEGIN();
    RUN_TEST(test_linear_problem_equals_dense_least_squares);
    RUN_TEST(test_the_result_is_not_linearized);
    RUN_TEST(test_covariance_equals_dense_inverse);
    RUN_TEST(test_covariance_of_a_long_chain_keeps_its_digits);
    RUN_TEST(test_covariance_of_functions_equals_dense_inverse);
    RUN_TEST(test_curved_robust_problem_ends_at_a_stationary_point);
    RUN_TEST(test_threads_do_not_change_a_bit);
    RUN_TEST(test_undetermined_parameter_is_refused_a_covariance);
    RUN_TEST(test_start_outside_the_domain_throws);
    RUN_TEST(test_mixture_is_finite_however_far_off);
    return UNITY_END();
}
