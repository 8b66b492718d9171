// The one optimiser: Levenberg-Marquardt on problems whose normal matrix has the shape of an arrow,
//
//   [ H_ee  H_ef  H_eg ]   e: many small blocks that couple with each other only through the rest (the points of a
//   bundle [       H_ff  H_fg ]      adjustment, the poses of a calibration): eliminated one by one (Schur complement)
//   [             H_gg ]   f: a chain of blocks that couple only with near ones (the poses of a survey, the knots of a
//                             tube): block-banded
//                          g: few that couple with all (camera, board shape, wheel scale): dense border
//
// Sums are made in a fixed number of pieces, added in order: the same bits for any number of threads.
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

#include "optim/robust.hpp"
#include "parallel.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>
#include <stdexcept>
#include <vector>

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

template <int E, int F> struct Step {
    std::vector<Eigen::Matrix<double, E, 1>> e;
    std::vector<Eigen::Matrix<double, F, 1>> f;
    Eigen::VectorXd g;
};

template <int E, int F> class LeastSquares
{
public:
    using MatrixE = Eigen::Matrix<double, E, E>;
    using MatrixF = Eigen::Matrix<double, F, F>;
    using MatrixEF = Eigen::Matrix<double, E, F>;
    using MatrixEG = Eigen::Matrix<double, E, Eigen::Dynamic>;
    using MatrixFG = Eigen::Matrix<double, F, Eigen::Dynamic>;
    using VectorE = Eigen::Matrix<double, E, 1>;
    using VectorF = Eigen::Matrix<double, F, 1>;

    // What covariance() returns. Blocks of f further apart than the band are not computed.
    struct Covariance {
        std::vector<MatrixE> e;
        std::vector<std::vector<MatrixF>> f; // f[i][d]: between f blocks i and i - d
        std::vector<MatrixFG> fg;
        Eigen::MatrixXd g;
    };

    // Minimises; the problem's state and saved state are then the best found.
    template <class Problem> Summary minimize(Problem &problem, const Options &options = {})
    {
        Summary summary;
        prepare(problem);
        problem.save();
        double cost = total_cost(problem, options.threads), lambda = options.lambda, growth = 2.0;
        summary.initial_cost = summary.final_cost = cost;
        if (!std::isfinite(cost)) {
            throw std::invalid_argument("least squares: the start has no finite cost");
        }
        linearize(problem, options.threads);
        for (summary.iterations = 0; summary.iterations < options.max_iterations; summary.iterations++) {
            if (scaled_gradient() <= options.gradient_tolerance * std::sqrt(std::max(cost, 1e-300))) {
                summary.status = Status::converged;
                return summary;
            }
            if (!factor(lambda)) {
                lambda *= growth;
                growth *= 2.0;
                summary.status = Status::singular;
                if (lambda > 1e12) {
                    return summary;
                }
                continue;
            }
            const Step<E, F> step = solve();
            problem.apply(step);
            const double trial = total_cost(problem, options.threads);
            const double predicted = predicted_decrease(step, lambda);
            // A sum of many squares is known to some units in the last place only: a smaller gain does not show in it.
            const double blur = 64.0 * std::numeric_limits<double>::epsilon() * cost;
            if (predicted <= blur) {
                summary.final_cost = polish(problem, cost, blur, options.threads);
                summary.status = Status::converged;
                return summary;
            }
            if (!(trial < cost)) { // NaN too: the step left the domain
                problem.apply(zero_step());
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
            cost = summary.final_cost = trial;
            linearize(problem, options.threads);
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
        prepare(problem);
        linearize(problem, threads);
        if (!factor(0.0)) {
            throw std::domain_error("least squares: the normal matrix is singular, something is not determined");
        }
        return inverse();
    }

    // Covariance (m x m) of the linear functions sum of a[k]^T x of e blocks e[k], a[k]: E x m, with the factor that
    // covariance() left. A sum of squares: it keeps its digits where single blocks' covariances are large beside it.
    Eigen::MatrixXd functions(std::span<const int> e, std::span<const MatrixEG> a) const
    {
        const Eigen::Index m = a.empty() ? 0 : a[0].cols();
        Eigen::MatrixXd out = Eigen::MatrixXd::Zero(m, m), on_g = Eigen::MatrixXd::Zero(border_, m);
        std::vector<MatrixFG> x(count_f_, MatrixFG::Zero(F, m)); // how the functions depend on the f blocks
        size_t first = count_f_;
        for (size_t k = 0; k < e.size(); k++) {
            const size_t block = static_cast<size_t>(e[k]);
            const MatrixEG solved = inverse_e_[block] * a[k];
            out.noalias() += a[k].transpose() * solved;
            for (size_t c = w_offset_[block]; c < w_offset_[block + 1]; c++) {
                const size_t i = static_cast<size_t>(w_index_[c]);
                x[i].noalias() -= w_[c].transpose() * solved;
                first = std::min(first, i);
            }
            if (border_ > 0) {
                on_g.noalias() -= h_eg_[block].transpose() * solved;
            }
        }
        forward(x, first);
        for (size_t i = first; i < count_f_; i++) {
            out.noalias() += x[i].transpose() * x[i];
            if (border_ > 0) {
                on_g.noalias() -= s_fg_[i].transpose() * x[i];
            }
        }
        if (border_ > 0) {
            const Eigen::MatrixXd scaled_g = scale_g_.asDiagonal() * on_g;
            out += scaled_g.transpose() * llt_g_.solve(scaled_g);
        }
        return out;
    }

    // Receives residuals. One a piece of the sums.
    class Sink
    {
    public:
        // `rows` whitened residuals r that share one robust loss. j_e: rows x E or null; f[k] with j_f[k], rows x F;
        // j_g: rows x border() or null. All row-major.
        void add(int rows, const double *r, const RobustLoss &loss, const double *j_e, std::span<const int> f,
                 std::span<const double *const> j_f, const double *j_g)
        {
            double s = 0.0;
            for (int i = 0; i < rows; i++) {
                s += r[i] * r[i];
            }
            const double weight = loss(s).weight;
            const RowsMap<1> residual(r, rows, 1);
            const RowsMap<E> je(j_e, j_e ? rows : 0, E);
            const int g = static_cast<int>(owner_->border_);
            const RowsMap<Eigen::Dynamic> jg(j_g, j_g ? rows : 0, g);
            if (j_e) {
                owner_->h_ee_[e_].noalias() += weight * (je.transpose() * je);
                owner_->b_e_[e_].noalias() += weight * (je.transpose() * residual);
                if (j_g) {
                    owner_->h_eg_[e_].noalias() += weight * (je.transpose() * jg);
                }
            }
            for (size_t k = 0; k < f.size(); k++) {
                const RowsMap<F> jf(j_f[k], rows, F);
                const size_t i = static_cast<size_t>(f[k]) - piece_->first;
                piece_->b_f[i].noalias() += weight * (jf.transpose() * residual);
                if (j_e) {
                    owner_->coupling(e_, f[k]).noalias() += weight * (je.transpose() * jf);
                }
                if (j_g) {
                    piece_->h_fg[i].noalias() += weight * (jf.transpose() * jg);
                }
                for (size_t l = 0; l < f.size(); l++) {
                    if (f[l] <= f[k]) {
                        const RowsMap<F> other(j_f[l], rows, F);
                        piece_->h_ff[owner_->banded_at(i, static_cast<size_t>(f[k] - f[l]))].noalias() +=
                            weight * (jf.transpose() * other);
                    }
                }
            }
            if (j_g) {
                piece_->b_g.noalias() += weight * (jg.transpose() * residual);
                piece_->h_gg.template selfadjointView<Eigen::Lower>().rankUpdate(jg.transpose(), weight);
            }
        }

    private:
        template <int Columns>
        using RowsMap = Eigen::Map<
            const Eigen::Matrix<double, Eigen::Dynamic, Columns, Columns == 1 ? Eigen::ColMajor : Eigen::RowMajor>>;
        friend class LeastSquares;
        struct Piece {
            size_t first = 0; // f block: a piece holds those that its e blocks couple with
            std::vector<MatrixF> h_ff;
            std::vector<MatrixFG> h_fg;
            std::vector<VectorF> b_f;
            Eigen::MatrixXd h_gg;
            Eigen::VectorXd b_g;
        };
        LeastSquares *owner_ = nullptr;
        Piece *piece_ = nullptr;
        size_t e_ = 0;
    };

private:
    static constexpr int PIECES = 16; // fixed: the sums' order must not depend on the number of threads

    size_t banded_at(size_t i, size_t back) const { return i * (band_ + 1) + back; }

    MatrixEF &coupling(size_t e, int f)
    {
        const auto first = w_index_.begin() + static_cast<std::ptrdiff_t>(w_offset_[e]);
        const auto last = w_index_.begin() + static_cast<std::ptrdiff_t>(w_offset_[e + 1]);
        return w_[static_cast<size_t>(std::lower_bound(first, last, f) - w_index_.begin())];
    }

    template <class Problem> void prepare(const Problem &problem)
    {
        count_e_ = static_cast<size_t>(problem.eliminated());
        count_f_ = static_cast<size_t>(problem.banded());
        border_ = problem.border();
        band_ = static_cast<size_t>(problem.reach());
        w_offset_.assign(1, 0);
        w_index_.clear();
        for (size_t e = 0; e < count_e_; e++) {
            const std::span<const int> f = problem.couplings(static_cast<int>(e));
            w_index_.insert(w_index_.end(), f.begin(), f.end());
            w_offset_.push_back(w_index_.size());
            if (!f.empty()) {
                band_ = std::max(band_, static_cast<size_t>(f.back() - f.front()));
            }
        }
        w_.resize(w_index_.size());
        h_ee_.resize(count_e_);
        b_e_.resize(count_e_);
        h_eg_.assign(count_e_, MatrixEG::Zero(E, border_));
        inverse_e_.resize(count_e_);
    }

    template <class Problem> double total_cost(const Problem &problem, int threads) const
    {
        std::vector<double> part(PIECES + 1, 0.0);
        parallel_for(PIECES, threads, [&](int piece) {
            double sum = 0.0;
            for (size_t e = first_of(piece); e < first_of(piece + 1); e++) {
                sum += problem.cost(static_cast<int>(e));
            }
            part[static_cast<size_t>(piece)] = sum;
        });
        part[PIECES] = problem.cost(-1);
        double sum = 0.0;
        for (const double p : part) {
            sum += p;
        }
        return sum;
    }

    size_t first_of(int piece) const { return count_e_ * static_cast<size_t>(piece) / PIECES; }

    template <class Problem> void linearize(const Problem &problem, int threads)
    {
        std::vector<typename Sink::Piece> pieces(PIECES + 1);
        parallel_for(PIECES + 1, threads, [&](int number) {
            typename Sink::Piece &piece = pieces[static_cast<size_t>(number)];
            const auto [first, last] = touched(number);
            piece.first = first;
            piece.h_ff.assign((last - first) * (band_ + 1), MatrixF::Zero());
            piece.h_fg.assign(last - first, MatrixFG::Zero(F, border_));
            piece.b_f.assign(last - first, VectorF::Zero());
            piece.h_gg = Eigen::MatrixXd::Zero(border_, border_);
            piece.b_g = Eigen::VectorXd::Zero(border_);
            Sink sink;
            sink.owner_ = this;
            sink.piece_ = &piece;
            if (number == PIECES) {
                problem.linearize(-1, sink);
                return;
            }
            for (size_t e = first_of(number); e < first_of(number + 1); e++) {
                h_ee_[e].setZero();
                b_e_[e].setZero();
                h_eg_[e].setZero();
                for (size_t k = w_offset_[e]; k < w_offset_[e + 1]; k++) {
                    w_[k].setZero();
                }
                sink.e_ = e;
                problem.linearize(static_cast<int>(e), sink);
            }
        });
        common_ = std::move(pieces[PIECES]);
        for (size_t p = 0; p < PIECES; p++) {
            const size_t first = pieces[p].first;
            for (size_t i = 0; i < pieces[p].h_ff.size(); i++) {
                common_.h_ff[banded_at(first, 0) + i] += pieces[p].h_ff[i];
            }
            for (size_t i = 0; i < pieces[p].b_f.size(); i++) {
                common_.h_fg[first + i] += pieces[p].h_fg[i];
                common_.b_f[first + i] += pieces[p].b_f[i];
            }
            common_.h_gg += pieces[p].h_gg;
            common_.b_g += pieces[p].b_g;
        }
    }

    // First f block, and one past the last, that a piece's e blocks couple with; of the last piece: all.
    std::pair<size_t, size_t> touched(int number) const
    {
        if (number == PIECES) {
            return {0, count_f_};
        }
        size_t first = count_f_, last = 0;
        for (size_t k = w_offset_[first_of(number)]; k < w_offset_[first_of(number + 1)]; k++) {
            first = std::min(first, static_cast<size_t>(w_index_[k]));
            last = std::max(last, static_cast<size_t>(w_index_[k]) + 1);
        }
        return {std::min(first, last), last};
    }

    static double scaled(double gradient, double diagonal)
    {
        return diagonal > 0.0 ? std::abs(gradient) / std::sqrt(diagonal) : std::abs(gradient);
    }

    double scaled_gradient() const
    {
        double worst = 0.0;
        for (size_t e = 0; e < count_e_; e++) {
            for (int i = 0; i < E; i++) {
                worst = std::max(worst, scaled(b_e_[e][i], h_ee_[e](i, i)));
            }
        }
        for (size_t f = 0; f < count_f_; f++) {
            for (int i = 0; i < F; i++) {
                worst = std::max(worst, scaled(common_.b_f[f][i], common_.h_ff[banded_at(f, 0)](i, i)));
            }
        }
        for (Eigen::Index i = 0; i < border_; i++) {
            worst = std::max(worst, scaled(common_.b_g[i], common_.h_gg(i, i)));
        }
        return worst;
    }

    template <class Matrix> static void damp(Matrix &h, double lambda)
    {
        for (Eigen::Index i = 0; i < h.rows(); i++) {
            h(i, i) += lambda * std::max(h(i, i), 1e-12);
        }
    }

    // Schur complement of the e blocks, then the Cholesky factor of band and border. False: not positive definite.
    bool factor(double lambda)
    {
        s_ff_ = common_.h_ff;
        s_fg_ = common_.h_fg;
        s_gg_ = common_.h_gg;
        for (size_t f = 0; f < count_f_; f++) {
            damp(s_ff_[banded_at(f, 0)], lambda);
        }
        damp(s_gg_, lambda);
        for (size_t e = 0; e < count_e_; e++) {
            MatrixE h = h_ee_[e];
            damp(h, lambda);
            const Eigen::LLT<MatrixE> llt(h);
            // A pivot that lost all its digits belongs to a direction that nothing determines.
            const MatrixE pivots = llt.matrixLLT();
            if (llt.info() != Eigen::Success ||
                !(pivots.diagonal().cwiseAbs2().array() > 1e-15 * h.diagonal().array()).all()) {
                return false;
            }
            inverse_e_[e] = llt.solve(MatrixE::Identity());
            for (size_t a = w_offset_[e]; a < w_offset_[e + 1]; a++) {
                const Eigen::Matrix<double, F, E> left = w_[a].transpose() * inverse_e_[e];
                const size_t i = static_cast<size_t>(w_index_[a]);
                for (size_t b = w_offset_[e]; b <= a; b++) {
                    s_ff_[banded_at(i, i - static_cast<size_t>(w_index_[b]))].noalias() -= left * w_[b];
                }
                if (border_ > 0) {
                    s_fg_[i].noalias() -= left * h_eg_[e];
                }
            }
            if (border_ > 0) {
                s_gg_.template triangularView<Eigen::Lower>() -= h_eg_[e].transpose() * (inverse_e_[e] * h_eg_[e]);
            }
        }
        return factor_band() && factor_border();
    }

    // In place: s_ff_ becomes the lower block-banded factor L, its diagonal blocks lower triangular.
    bool factor_band()
    {
        for (size_t i = 0; i < count_f_; i++) {
            const size_t start = i > band_ ? i - band_ : 0;
            for (size_t j = start; j <= i; j++) {
                MatrixF &block = s_ff_[banded_at(i, i - j)];
                const size_t from = std::max(start, j > band_ ? j - band_ : 0);
                for (size_t k = from; k < j; k++) {
                    block.noalias() -= s_ff_[banded_at(i, i - k)] * s_ff_[banded_at(j, j - k)].transpose();
                }
                if (j < i) {
                    s_ff_[banded_at(j, 0)]
                        .template triangularView<Eigen::Lower>()
                        .transpose()
                        .template solveInPlace<Eigen::OnTheRight>(block);
                    continue;
                }
                const double before = common_.h_ff[banded_at(i, 0)].diagonal().minCoeff();
                const Eigen::LLT<MatrixF> llt(block);
                if (llt.info() != Eigen::Success) {
                    return false;
                }
                block = llt.matrixL();
                // A pivot that lost all its digits belongs to a direction that nothing determines.
                if (!(block.diagonal().minCoeff() > 1e-8 * std::sqrt(std::max(before, 0.0)))) {
                    return false;
                }
            }
        }
        return true;
    }

    // s_fg_ becomes X = L^-1 S_fg, and the border its own factor.
    bool factor_border()
    {
        if (border_ == 0) {
            return true;
        }
        forward(s_fg_);
        for (size_t i = 0; i < count_f_; i++) {
            s_gg_.template selfadjointView<Eigen::Lower>().rankUpdate(s_fg_[i].transpose(), -1.0);
        }
        // Scaled to unit diagonal before factoring, so that "singular" does not depend on units.
        scale_g_ = common_.h_gg.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
        llt_g_.compute(scale_g_.asDiagonal() * s_gg_ * scale_g_.asDiagonal());
        return llt_g_.info() == Eigen::Success && llt_g_.matrixL().toDenseMatrix().diagonal().minCoeff() > 1e-8;
    }

    template <class Rows> void forward(std::vector<Rows> &x, size_t first = 0) const // x := L^-1 x, zero before first
    {
        for (size_t i = first; i < count_f_; i++) {
            for (size_t k = std::max(first, i > band_ ? i - band_ : 0); k < i; k++) {
                x[i].noalias() -= s_ff_[banded_at(i, i - k)] * x[k];
            }
            s_ff_[banded_at(i, 0)].template triangularView<Eigen::Lower>().solveInPlace(x[i]);
        }
    }

    template <class Rows> void backward(std::vector<Rows> &x) const // x := L^-T x
    {
        for (size_t i = count_f_; i-- > 0;) {
            for (size_t k = i + 1; k < count_f_ && k <= i + band_; k++) {
                x[i].noalias() -= s_ff_[banded_at(k, k - i)].transpose() * x[k];
            }
            s_ff_[banded_at(i, 0)].template triangularView<Eigen::Lower>().transpose().solveInPlace(x[i]);
        }
    }

    Eigen::VectorXd solve_border(const Eigen::VectorXd &right) const
    {
        return scale_g_.asDiagonal() * llt_g_.solve(scale_g_.asDiagonal() * right);
    }

    Step<E, F> zero_step() const
    {
        return {std::vector<VectorE>(count_e_, VectorE::Zero()), std::vector<VectorF>(count_f_, VectorF::Zero()),
                Eigen::VectorXd::Zero(border_)};
    }

    Step<E, F> solve() const
    {
        Step<E, F> step = zero_step();
        for (size_t f = 0; f < count_f_; f++) {
            step.f[f] = -common_.b_f[f];
        }
        Eigen::VectorXd right_g = -common_.b_g;
        for (size_t e = 0; e < count_e_; e++) {
            const VectorE reduced = inverse_e_[e] * b_e_[e];
            for (size_t a = w_offset_[e]; a < w_offset_[e + 1]; a++) {
                step.f[static_cast<size_t>(w_index_[a])].noalias() += w_[a].transpose() * reduced;
            }
            if (border_ > 0) {
                right_g.noalias() += h_eg_[e].transpose() * reduced;
            }
        }
        forward(step.f);
        if (border_ > 0) {
            for (size_t f = 0; f < count_f_; f++) {
                right_g.noalias() -= s_fg_[f].transpose() * step.f[f];
            }
            step.g = solve_border(right_g);
            for (size_t f = 0; f < count_f_; f++) {
                step.f[f].noalias() -= s_fg_[f] * step.g;
            }
        }
        backward(step.f);
        for (size_t e = 0; e < count_e_; e++) {
            VectorE right = -b_e_[e];
            for (size_t a = w_offset_[e]; a < w_offset_[e + 1]; a++) {
                right.noalias() -= w_[a] * step.f[static_cast<size_t>(w_index_[a])];
            }
            if (border_ > 0) {
                right.noalias() -= h_eg_[e] * step.g;
            }
            step.e[e] = inverse_e_[e] * right;
        }
        return step;
    }

    // A last step without damping, whose error is of second order: it is more exact than the cost can tell. The cost.
    template <class Problem> double polish(Problem &problem, double cost, double blur, int threads)
    {
        if (factor(0.0)) {
            problem.apply(solve());
            const double trial = total_cost(problem, threads);
            if (trial <= cost + blur) {
                problem.save();
                return trial;
            }
        }
        problem.apply(zero_step());
        return cost;
    }

    // Of the quadratic model: (step . (lambda diag step) - b . step) / 2.
    double predicted_decrease(const Step<E, F> &step, double lambda) const
    {
        double sum = 0.0;
        for (size_t e = 0; e < count_e_; e++) {
            sum -= b_e_[e].dot(step.e[e]);
            sum += lambda * step.e[e].dot(h_ee_[e].diagonal().cwiseMax(1e-12).asDiagonal() * step.e[e]);
        }
        for (size_t f = 0; f < count_f_; f++) {
            sum -= common_.b_f[f].dot(step.f[f]);
            const VectorF diagonal = common_.h_ff[banded_at(f, 0)].diagonal().cwiseMax(1e-12);
            sum += lambda * step.f[f].dot(diagonal.asDiagonal() * step.f[f]);
        }
        sum -= common_.b_g.dot(step.g);
        const Eigen::VectorXd diagonal = common_.h_gg.diagonal().cwiseMax(1e-12);
        sum += lambda * step.g.dot(diagonal.asDiagonal() * step.g);
        return 0.5 * sum;
    }

    // S_ff^-1 inside the band, z[i][d] between i and i - d, with the factor of the undamped matrix: Takahashi's
    // recursion, from the last block backwards.
    std::vector<MatrixF> banded_inverse() const
    {
        std::vector<MatrixF> z(count_f_ * (band_ + 1), MatrixF::Zero());
        const auto at = [&](size_t i, size_t j) -> MatrixF { // either order, within the band
            return i >= j ? z[banded_at(i, i - j)] : MatrixF(z[banded_at(j, j - i)].transpose());
        };
        for (size_t j = count_f_; j-- > 0;) {
            const MatrixF diagonal = s_ff_[banded_at(j, 0)];
            const MatrixF inverse = diagonal.template triangularView<Eigen::Lower>().solve(MatrixF::Identity());
            const size_t last = std::min(count_f_ - 1, j + band_);
            for (size_t i = last; i > j; i--) {
                MatrixF sum = MatrixF::Zero();
                for (size_t k = j + 1; k <= last; k++) {
                    sum.noalias() -= at(i, k) * s_ff_[banded_at(k, k - j)];
                }
                z[banded_at(i, i - j)] = sum * inverse;
            }
            MatrixF sum = inverse;
            for (size_t k = j + 1; k <= last; k++) {
                sum.noalias() -= s_ff_[banded_at(k, k - j)].transpose() * at(k, j);
            }
            // Made symmetric: the part that is not grows with every block, by 1.8 a frame in a survey, to nonsense.
            const MatrixF block = inverse.transpose() * sum;
            z[banded_at(j, 0)] = 0.5 * (block + block.transpose());
        }
        return z;
    }

    // With the factor of the undamped matrix.
    Covariance inverse() const
    {
        Covariance out;
        const std::vector<MatrixF> z = banded_inverse();
        std::vector<MatrixFG> y = s_fg_; // S_ff^-1 S_fg
        if (border_ > 0) {
            out.g = scale_g_.asDiagonal() * llt_g_.solve(Eigen::MatrixXd::Identity(border_, border_)) *
                    scale_g_.asDiagonal();
            backward(y);
        }
        out.f.resize(count_f_);
        for (size_t i = 0; i < count_f_; i++) {
            for (size_t d = 0; d <= std::min(i, band_); d++) {
                MatrixF block = z[banded_at(i, d)];
                if (border_ > 0) {
                    block += y[i] * out.g * y[i - d].transpose();
                }
                out.f[i].push_back(block);
            }
            out.fg.push_back(border_ > 0 ? MatrixFG(-y[i] * out.g) : MatrixFG(F, 0));
        }
        for (size_t e = 0; e < count_e_; e++) {
            out.e.push_back(eliminated_covariance(out, e));
        }
        return out;
    }

    MatrixE eliminated_covariance(const Covariance &known, size_t e) const
    {
        MatrixE middle = MatrixE::Zero();
        for (size_t a = w_offset_[e]; a < w_offset_[e + 1]; a++) {
            const size_t i = static_cast<size_t>(w_index_[a]);
            for (size_t b = w_offset_[e]; b < a; b++) {
                const MatrixE part = w_[a] * known.f[i][i - static_cast<size_t>(w_index_[b])] * w_[b].transpose();
                middle += part + part.transpose();
            }
            middle += w_[a] * known.f[i][0] * w_[a].transpose();
            if (border_ > 0) {
                const MatrixE part = w_[a] * known.fg[i] * h_eg_[e].transpose();
                middle += part + part.transpose();
            }
        }
        if (border_ > 0) {
            middle += h_eg_[e] * known.g * h_eg_[e].transpose();
        }
        return inverse_e_[e] + inverse_e_[e] * middle * inverse_e_[e];
    }

    size_t count_e_ = 0, count_f_ = 0, band_ = 0;
    Eigen::Index border_ = 0;
    std::vector<size_t> w_offset_; // of each e block in w_
    std::vector<int> w_index_;     // f block of each coupling
    std::vector<MatrixEF> w_;
    std::vector<MatrixE> h_ee_, inverse_e_;
    std::vector<VectorE> b_e_;
    std::vector<MatrixEG> h_eg_;
    typename Sink::Piece common_;
    std::vector<MatrixF> s_ff_;
    std::vector<MatrixFG> s_fg_;
    Eigen::MatrixXd s_gg_;
    Eigen::VectorXd scale_g_;
    Eigen::LLT<Eigen::MatrixXd> llt_g_;
};

} // namespace pipefish::optim
