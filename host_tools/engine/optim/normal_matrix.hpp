// The normal matrix of a least-squares problem, in the shape of an arrow:
//
//   [ H_ee  H_ef  H_eg ]   e: many small blocks that couple with each other only through the rest (the points of a
//   bundle [       H_ff  H_fg ]      adjustment, the poses of a calibration)
//   [             H_gg ]   f: a chain of blocks that couple only with near ones (the poses of a survey, the knots of a
//                             tube): block-banded
//                          g: few that couple with all (camera, board shape, wheel scale): dense border
//
// Sums are made in a fixed number of pieces, added in order: the same bits for any number of threads.
#pragma once

#include "optim/blocks.hpp"
#include "optim/robust.hpp"
#include "parallel.hpp"

#include <Eigen/Core>

#include <algorithm>
#include <cmath>
#include <span>
#include <type_traits>
#include <utility>
#include <vector>

namespace pipefish::optim
{

template <int E, int F> struct Step {
    std::vector<Eigen::Matrix<double, E, 1>> e;
    std::vector<Eigen::Matrix<double, F, 1>> f;
    Eigen::VectorXd g;
};

template <int E, int F> class NormalMatrix
{
public:
    using MatrixE = Eigen::Matrix<double, E, E>;
    using MatrixF = Eigen::Matrix<double, F, F>;
    using MatrixFE = Eigen::Matrix<double, F, E>;
    using MatrixEG = Eigen::Matrix<double, E, Eigen::Dynamic>;
    using MatrixFG = Eigen::Matrix<double, F, Eigen::Dynamic>;
    using VectorE = Eigen::Matrix<double, E, 1>;
    using VectorF = Eigen::Matrix<double, F, 1>;

    // Sums over f blocks from `first` on, and the border's.
    struct Piece {
        size_t first = 0; // f block: a piece holds those that its e blocks couple with
        std::vector<MatrixF> h_ff;
        std::vector<MatrixFG> h_fg;
        std::vector<VectorF> b_f;
        Eigen::MatrixXd h_gg;
        Eigen::VectorXd b_g;
    };

    // Receives residuals. One a piece of the sums.
    class Sink
    {
    public:
        // `rows` whitened residuals r, one at least, that share one robust loss. j_e: rows x E or null; f[k] with
        // j_f[k], rows x F; j_g: rows x border() or null. All row-major.
        void add(int rows, const double *r, const RobustLoss &loss, const double *j_e, std::span<const int> f,
                 std::span<const double *const> j_f, const double *j_g);

    private:
        friend class NormalMatrix;
        template <class Count>
        void add_weighted(Count rows, double weight, const double *r, const double *j_e, std::span<const int> f,
                          std::span<const double *const> j_f, const double *j_g);

        NormalMatrix *owner_ = nullptr;
        Piece *piece_ = nullptr;
        size_t e_ = 0;
    };

    size_t count_e = 0, count_f = 0, band = 0; // band: the largest distance of f blocks that couple
    Eigen::Index border = 0;
    std::vector<size_t> w_offset; // of each e block in w
    std::vector<int> w_index;     // f block of each coupling
    std::vector<MatrixFE> w;      // H_fe: its columns are long, for the loops over them
    std::vector<MatrixE> h_ee;
    std::vector<VectorE> b_e;
    std::vector<MatrixEG> h_eg;
    Piece common; // of all: h_ff[banded_at(i, d)]: between f blocks i and i - d

    size_t banded_at(size_t i, size_t back) const { return i * (band + 1) + back; }

    // Shape of the problem, and room for it.
    template <class Problem> void prepare(const Problem &problem)
    {
        count_e = static_cast<size_t>(problem.eliminated());
        count_f = static_cast<size_t>(problem.banded());
        border = problem.border();
        band = static_cast<size_t>(problem.reach());
        w_offset.assign(1, 0);
        w_index.clear();
        for (size_t e = 0; e < count_e; e++) {
            const std::span<const int> f = problem.couplings(static_cast<int>(e));
            w_index.insert(w_index.end(), f.begin(), f.end());
            w_offset.push_back(w_index.size());
            if (!f.empty()) {
                band = std::max(band, static_cast<size_t>(f.back() - f.front()));
            }
        }
        w.resize(w_index.size());
        h_ee.resize(count_e);
        b_e.resize(count_e);
        h_eg.assign(count_e, MatrixEG::Zero(E, border));
    }

    // Half the robust sum of squares.
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

    template <class Problem> void linearize(const Problem &problem, int threads)
    {
        std::vector<Piece> pieces(PIECES + 1);
        parallel_for(PIECES + 1, threads, [&](int number) {
            Piece &piece = pieces[static_cast<size_t>(number)];
            clear(number, piece);
            Sink sink;
            sink.owner_ = this;
            sink.piece_ = &piece;
            if (number == PIECES) {
                problem.linearize(-1, sink);
                return;
            }
            for (size_t e = first_of(number); e < first_of(number + 1); e++) {
                clear_eliminated(e);
                sink.e_ = e;
                problem.linearize(static_cast<int>(e), sink);
            }
        });
        sum_up(pieces);
    }

    // Largest |gradient| over the square root of the Hessian's diagonal.
    double scaled_gradient() const;

    // Of the quadratic model: (step . (lambda diag step) - b . step) / 2.
    double predicted_decrease(const Step<E, F> &step, double lambda) const;

    Step<E, F> zero_step() const;

private:
    static constexpr int PIECES = 16; // fixed: the sums' order must not depend on the number of threads

    void clear(int number, Piece &piece);
    void clear_eliminated(size_t e);
    void sum_up(std::vector<Piece> &pieces);

    MatrixFE &coupling(size_t e, int f)
    {
        const auto first = w_index.begin() + static_cast<std::ptrdiff_t>(w_offset[e]);
        const auto last = w_index.begin() + static_cast<std::ptrdiff_t>(w_offset[e + 1]);
        return w[static_cast<size_t>(std::lower_bound(first, last, f) - w_index.begin())];
    }

    size_t first_of(int piece) const { return count_e * static_cast<size_t>(piece) / PIECES; }

    // First f block, and one past the last, that a piece's e blocks couple with; of the last piece: all.
    std::pair<size_t, size_t> touched(int number) const
    {
        if (number == PIECES) {
            return {0, count_f};
        }
        size_t first = count_f, last = 0;
        for (size_t k = w_offset[first_of(number)]; k < w_offset[first_of(number + 1)]; k++) {
            first = std::min(first, static_cast<size_t>(w_index[k]));
            last = std::max(last, static_cast<size_t>(w_index[k]) + 1);
        }
        return {std::min(first, last), last};
    }

    static double scaled(double gradient, double diagonal)
    {
        return diagonal > 0.0 ? std::abs(gradient) / std::sqrt(diagonal) : std::abs(gradient);
    }
};

// Not inside the class, where they would be inline: shapes.cpp compiles them once for all.

template <int E, int F>
void NormalMatrix<E, F>::Sink::add(int rows, const double *r, const RobustLoss &loss, const double *j_e,
                                   std::span<const int> f, std::span<const double *const> j_f, const double *j_g)
{
    double s = 0.0;
    for (int i = 0; i < rows; i++) {
        s += r[i] * r[i];
    }
    const double weight = loss(s).weight;
    if (rows == 2) { // a pixel
        add_weighted(std::integral_constant<int, 2>(), weight, r, j_e, f, j_f, j_g);
    } else {
        add_weighted(rows, weight, r, j_e, f, j_f, j_g);
    }
}

template <int E, int F>
template <class Count>
void NormalMatrix<E, F>::Sink::add_weighted(Count rows, double weight, const double *r, const double *j_e,
                                            std::span<const int> f, std::span<const double *const> j_f,
                                            const double *j_g)
{
    const Eigen::Index g = owner_->border;
    if (j_e) {
        add_rows(owner_->h_ee[e_], weight, rows, j_e, j_e);
        add_rows(owner_->b_e[e_], weight, rows, j_e, r);
        if (j_g) {
            add_rows(owner_->h_eg[e_], weight, rows, j_e, j_g);
        }
    }
    for (size_t k = 0; k < f.size(); k++) {
        const size_t i = static_cast<size_t>(f[k]) - piece_->first;
        add_rows(piece_->b_f[i], weight, rows, j_f[k], r);
        if (j_e) {
            add_rows(owner_->coupling(e_, f[k]), weight, rows, j_f[k], j_e);
        }
        if (j_g) {
            add_rows(piece_->h_fg[i], weight, rows, j_f[k], j_g);
        }
        for (size_t l = 0; l < f.size(); l++) {
            if (f[l] <= f[k]) {
                add_rows(piece_->h_ff[owner_->banded_at(i, static_cast<size_t>(f[k] - f[l]))], weight, rows, j_f[k],
                         j_f[l]);
            }
        }
    }
    if (j_g) {
        for (int k = 0; k < rows; k++) {
            for (Eigen::Index i = 0; i < g; i++) {
                piece_->b_g[i] += weight * r[k] * j_g[k * g + i];
            }
        }
        using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
        const Eigen::Map<const Rows> jg(j_g, rows, g);
        piece_->h_gg.template selfadjointView<Eigen::Lower>().rankUpdate(jg.transpose(), weight);
    }
}

template <int E, int F> void NormalMatrix<E, F>::clear(int number, Piece &piece)
{
    const auto [first, last] = touched(number);
    piece.first = first;
    piece.h_ff.assign((last - first) * (band + 1), MatrixF::Zero());
    piece.h_fg.assign(last - first, MatrixFG::Zero(F, border));
    piece.b_f.assign(last - first, VectorF::Zero());
    piece.h_gg = Eigen::MatrixXd::Zero(border, border);
    piece.b_g = Eigen::VectorXd::Zero(border);
}

// When its turn comes, not all at once before: it is then in the cache.
template <int E, int F> void NormalMatrix<E, F>::clear_eliminated(size_t e)
{
    h_ee[e].setZero();
    b_e[e].setZero();
    h_eg[e].setZero();
    for (size_t k = w_offset[e]; k < w_offset[e + 1]; k++) {
        w[k].setZero();
    }
}

template <int E, int F> void NormalMatrix<E, F>::sum_up(std::vector<Piece> &pieces)
{
    common = std::move(pieces[PIECES]);
    for (size_t p = 0; p < PIECES; p++) {
        const size_t first = pieces[p].first;
        for (size_t i = 0; i < pieces[p].h_ff.size(); i++) {
            common.h_ff[banded_at(first, 0) + i] += pieces[p].h_ff[i];
        }
        for (size_t i = 0; i < pieces[p].b_f.size(); i++) {
            common.h_fg[first + i] += pieces[p].h_fg[i];
            common.b_f[first + i] += pieces[p].b_f[i];
        }
        common.h_gg += pieces[p].h_gg;
        common.b_g += pieces[p].b_g;
    }
}

template <int E, int F> double NormalMatrix<E, F>::scaled_gradient() const
{
    double worst = 0.0;
    for (size_t e = 0; e < count_e; e++) {
        for (int i = 0; i < E; i++) {
            worst = std::max(worst, scaled(b_e[e][i], h_ee[e](i, i)));
        }
    }
    for (size_t f = 0; f < count_f; f++) {
        for (int i = 0; i < F; i++) {
            worst = std::max(worst, scaled(common.b_f[f][i], common.h_ff[banded_at(f, 0)](i, i)));
        }
    }
    for (Eigen::Index i = 0; i < border; i++) {
        worst = std::max(worst, scaled(common.b_g[i], common.h_gg(i, i)));
    }
    return worst;
}

template <int E, int F> double NormalMatrix<E, F>::predicted_decrease(const Step<E, F> &step, double lambda) const
{
    double sum = 0.0;
    const auto add = [&](const auto &b, const auto &h, const auto &by) {
        for (Eigen::Index i = 0; i < b.size(); i++) {
            sum += by[i] * (lambda * std::max(h(i, i), 1e-12) * by[i] - b[i]);
        }
    };
    for (size_t e = 0; e < count_e; e++) {
        add(b_e[e], h_ee[e], step.e[e]);
    }
    for (size_t f = 0; f < count_f; f++) {
        add(common.b_f[f], common.h_ff[banded_at(f, 0)], step.f[f]);
    }
    add(common.b_g, common.h_gg, step.g);
    return 0.5 * sum;
}

template <int E, int F> Step<E, F> NormalMatrix<E, F>::zero_step() const
{
    return {std::vector<VectorE>(count_e, VectorE::Zero()), std::vector<VectorF>(count_f, VectorF::Zero()),
            Eigen::VectorXd::Zero(border)};
}

} // namespace pipefish::optim
