// The one optimiser: Levenberg-Marquardt on problems whose normal matrix has the shape of an arrow (normal_matrix.hpp):
// small blocks e that are eliminated, a banded chain f, a dense border g.
//
// A problem is a class with
//   int eliminated() const; int banded() const; int border() const;
//     the numbers of e blocks, f blocks and g parameters
//   std::span<const int> couplings(int e) const;
//     f blocks that share a residual with e, ascending
//   int reach() const;
//     the largest |i - j| of f blocks in one residual without e
//   template <class Sink> void linearize(int e, Sink &) const;
//     sink.add(...) for each residual with e; with e = -1 for those without
//   double cost(int e) const;
//     half the robust sum of squares of the same residuals
//   void apply(const Step &); void save();
//     state := saved state + step; saved state := state
// Residuals are whitened. E and F are the sizes of one e and one f block (1 where there are none).
#pragma once

#include "optim/arrow_factor.hpp"

#include <limits>
#include <stdexcept>

namespace pipefish::optim
{

struct Options {
    int max_iterations = 100;
    double cost_tolerance = 1e-12; // relative decrease of the cost by an accepted step
    double gradient_tolerance =
        1e-10;            // largest |gradient| over the square root of the Hessian's diagonal and of the cost
    double lambda = 1e-4; // first damping, relative to the Hessian's diagonal
    int threads = 1;
};

enum class Status {
    converged,
    out_of_iterations,
    stalled,  // no step decreases the cost, and the gradient is not small
    singular, // the normal matrix has no Cholesky factor even when damped: something is not determined
};

struct Summary {
    Status status = Status::singular;
    int iterations = 0;
    double initial_cost = 0.0, final_cost = 0.0; // half the robust sum of squares
};

template <int E, int F> class LeastSquares
{
public:
    using MatrixEG = typename NormalMatrix<E, F>::MatrixEG;
    using Covariance = typename ArrowFactor<E, F>::Covariance; // what covariance() returns

    // Minimises; the problem's state and saved state are then the best found.
    template <class Problem> Summary minimize(Problem &problem, const Options &options = {})
    {
        Summary summary;
        normal_.prepare(problem);
        problem.save();
        double cost = normal_.total_cost(problem, options.threads), lambda = options.lambda, growth = 2.0;
        summary.initial_cost = summary.final_cost = cost;
        if (!std::isfinite(cost)) {
            throw std::invalid_argument("least squares: the start has no finite cost");
        }
        bool moved = true; // since it was linearised; the state that a last step leads to never is
        for (summary.iterations = 0; summary.iterations < options.max_iterations; summary.iterations++) {
            if (moved) {
                normal_.linearize(problem, options.threads);
                moved = false;
            }
            if (normal_.scaled_gradient() <= options.gradient_tolerance * std::sqrt(std::max(cost, 1e-300))) {
                summary.status = Status::converged;
                return summary;
            }
            if (!factor_.compute(normal_, lambda)) {
                lambda *= growth;
                growth *= 2.0;
                summary.status = Status::singular;
                if (lambda > 1e12) {
                    return summary;
                }
                continue;
            }
            const Step<E, F> step = factor_.solve(normal_);
            problem.apply(step);
            const double trial = normal_.total_cost(problem, options.threads);
            const double predicted = normal_.predicted_decrease(step, lambda);
            // A sum of many squares is known to some units in the last place only: a smaller gain does not show in it.
            const double blur = 64.0 * std::numeric_limits<double>::epsilon() * cost;
            if (predicted <= blur) {
                summary.final_cost = polish(problem, cost, blur, options.threads);
                summary.status = Status::converged;
                return summary;
            }
            if (!(trial < cost)) { // NaN too: the step left the domain
                problem.apply(normal_.zero_step());
                lambda *= growth;
                growth *= 2.0;
                summary.status = Status::stalled;
                if (lambda > 1e12) {
                    return summary;
                }
                continue;
            }
            const double decrease = cost - trial, ratio = decrease / std::max(predicted, 1e-300);
            // Nielsen's rule: the damping follows how well the model predicted.
            lambda *= std::max(1.0 / 3.0, 1.0 - std::pow(2.0 * ratio - 1.0, 3));
            lambda = std::max(lambda, 1e-15);
            growth = 2.0;
            problem.save();
            moved = true;
            cost = summary.final_cost = trial;
            if (decrease <= options.cost_tolerance * cost) {
                summary.status = Status::converged;
                summary.iterations++;
                return summary;
            }
            summary.status = Status::out_of_iterations;
        }
        return summary;
    }

    // Inverse of the normal matrix at the problem's state, whose residuals are whitened: the covariance of the
    // estimate. Throws std::domain_error where it is singular (a gauge is free).
    template <class Problem> Covariance covariance(const Problem &problem, int threads = 1)
    {
        normal_.prepare(problem);
        normal_.linearize(problem, threads);
        if (!factor_.compute(normal_, 0.0)) {
            throw std::domain_error("least squares: the normal matrix is singular, something is not determined");
        }
        return factor_.inverse(normal_);
    }

    // Covariance (m x m) of the linear functions sum of a[k]^T x of e blocks e[k], a[k]: E x m, with the factor that
    // covariance() left.
    Eigen::MatrixXd functions(std::span<const int> e, std::span<const MatrixEG> a) const
    {
        return factor_.functions(normal_, e, a);
    }

private:
    // A last step without damping, whose error is of second order: it is more exact than the cost can tell. The cost.
    template <class Problem> double polish(Problem &problem, double cost, double blur, int threads)
    {
        if (factor_.compute(normal_, 0.0)) {
            problem.apply(factor_.solve(normal_));
            const double trial = normal_.total_cost(problem, threads);
            if (trial <= cost + blur) {
                problem.save();
                return trial;
            }
        }
        problem.apply(normal_.zero_step());
        return cost;
    }

    NormalMatrix<E, F> normal_;
    ArrowFactor<E, F> factor_;
};

// The shapes in use are compiled once, in shapes.cpp.
extern template class NormalMatrix<1, 1>;
extern template class ArrowFactor<1, 1>;
extern template class NormalMatrix<3, 6>;
extern template class ArrowFactor<3, 6>;
extern template class NormalMatrix<5, 1>;
extern template class ArrowFactor<5, 1>;
extern template class NormalMatrix<6, 1>;
extern template class ArrowFactor<6, 1>;

} // namespace pipefish::optim
