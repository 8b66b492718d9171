// Factor of an arrow-shaped normal matrix: the e blocks are eliminated one by one (Schur complement), what is left is a
// banded Cholesky factor with a dense border. Solves, and inverts as far as covariances are wanted.
#pragma once

#include "optim/normal_matrix.hpp"

#include <Eigen/Cholesky>

namespace pipefish::optim
{

template <int E, int F> class ArrowFactor
{
public:
    using Normal = NormalMatrix<E, F>;
    using MatrixE = typename Normal::MatrixE;
    using MatrixF = typename Normal::MatrixF;
    using MatrixEG = typename Normal::MatrixEG;
    using MatrixFG = typename Normal::MatrixFG;
    using VectorE = typename Normal::VectorE;
    using MatrixFE = typename Normal::MatrixFE;

    // Of the inverse. Blocks of f further apart than the band are not computed.
    struct Covariance {
        std::vector<MatrixE> e;
        std::vector<std::vector<MatrixF>> f; // f[i][d]: between f blocks i and i - d
        std::vector<MatrixFG> fg;
        Eigen::MatrixXd g;
    };

    // Of the matrix with its diagonal times 1 + lambda. False: not positive definite.
    bool compute(const Normal &normal, double lambda);

    // Those below are of the matrix that was factored.

    // With the right side of `normal`, which may be another than when the matrix was factored.
    Step<E, F> solve(const Normal &normal) const;

    Covariance inverse(const Normal &normal) const;

    // Covariance (m x m) of the linear functions sum of a[k]^T x of e blocks e[k], a[k]: E x m. A sum of squares: it
    // keeps its digits where single blocks' covariances are large beside it.
    Eigen::MatrixXd functions(const Normal &normal, std::span<const int> e, std::span<const MatrixEG> a) const;

private:
    size_t at(size_t i, size_t back) const { return i * (band_ + 1) + back; }

    template <class Matrix> static void damp(Matrix &h, double lambda)
    {
        for (Eigen::Index i = 0; i < h.rows(); i++) {
            h(i, i) += lambda * std::max(h(i, i), 1e-12);
        }
    }

    bool eliminate(const Normal &normal, size_t e, double lambda);
    bool factor_band(const Normal &normal);
    bool factor_border(const Normal &normal);
    std::vector<MatrixF> banded_inverse() const;
    MatrixE eliminated_covariance(const Normal &normal, const Covariance &known, size_t e) const;

    template <class Rows> void forward(std::vector<Rows> &x, size_t first = 0) const // x := L^-1 x, zero before first
    {
        for (size_t i = first; i < count_; i++) {
            for (size_t k = std::max(first, i > band_ ? i - band_ : 0); k < i; k++) {
                add_product(x[i], -1.0, s_ff_[at(i, i - k)], x[k]);
            }
            solve_lower(s_ff_[at(i, 0)], x[i]);
        }
    }

    template <class Rows> void backward(std::vector<Rows> &x) const // x := L^-T x
    {
        for (size_t i = count_; i-- > 0;) {
            for (size_t k = i + 1; k < count_ && k <= i + band_; k++) {
                add_transposed_product(x[i], -1.0, s_ff_[at(k, k - i)], x[k]);
            }
            solve_lower_transposed(s_ff_[at(i, 0)], x[i]);
        }
    }

    Eigen::VectorXd solve_border(const Eigen::VectorXd &right) const
    {
        return scale_g_.asDiagonal() * llt_g_.solve(scale_g_.asDiagonal() * right);
    }

    size_t count_ = 0, band_ = 0; // of f blocks
    std::vector<MatrixE> inverse_e_;
    std::vector<MatrixF> s_ff_;  // L
    std::vector<MatrixFG> s_fg_; // L^-1 S_fg
    Eigen::MatrixXd s_gg_;
    Eigen::VectorXd scale_g_;
    Eigen::LLT<Eigen::MatrixXd> llt_g_;
};

// Not inside the class, where they would be inline: shapes.cpp compiles them once for all.

template <int E, int F> bool ArrowFactor<E, F>::compute(const Normal &normal, double lambda)
{
    count_ = normal.count_f;
    band_ = normal.band;
    inverse_e_.resize(normal.count_e);
    s_ff_ = normal.common.h_ff;
    s_fg_ = normal.common.h_fg;
    s_gg_ = normal.common.h_gg;
    for (size_t f = 0; f < count_; f++) {
        damp(s_ff_[at(f, 0)], lambda);
    }
    damp(s_gg_, lambda);
    for (size_t e = 0; e < normal.count_e; e++) {
        if (!eliminate(normal, e, lambda)) {
            return false;
        }
    }
    return factor_band(normal) && factor_border(normal);
}

template <int E, int F> bool ArrowFactor<E, F>::eliminate(const Normal &normal, size_t e, double lambda)
{
    MatrixE l = normal.h_ee[e];
    damp(l, lambda);
    const MatrixE h = l;
    if (!cholesky(l)) {
        return false;
    }
    for (int i = 0; i < E; i++) { // a pivot that lost all its digits belongs to a direction that nothing determines
        if (!(l(i, i) * l(i, i) > 1e-15 * h(i, i))) {
            return false;
        }
    }
    MatrixE &inverse = inverse_e_[e];
    inverse.setIdentity();
    solve_lower(l, inverse);
    solve_lower_transposed(l, inverse);
    for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
        MatrixFE left = MatrixFE::Zero();
        add_product(left, 1.0, normal.w[a], inverse);
        const size_t i = static_cast<size_t>(normal.w_index[a]);
        for (size_t b = normal.w_offset[e]; b <= a; b++) {
            add_product_transposed(s_ff_[at(i, i - static_cast<size_t>(normal.w_index[b]))], -1.0, left, normal.w[b]);
        }
        if (normal.border > 0) {
            add_product(s_fg_[i], -1.0, left, normal.h_eg[e]);
        }
    }
    if (normal.border > 0) {
        MatrixEG solved = MatrixEG::Zero(E, normal.border);
        add_product(solved, 1.0, inverse, normal.h_eg[e]);
        add_transposed_product(s_gg_, -1.0, normal.h_eg[e], solved);
    }
    return true;
}

template <int E, int F> Step<E, F> ArrowFactor<E, F>::solve(const Normal &normal) const
{
    Step<E, F> step = normal.zero_step();
    for (size_t f = 0; f < count_; f++) {
        step.f[f] = -normal.common.b_f[f];
    }
    Eigen::VectorXd right_g = -normal.common.b_g;
    for (size_t e = 0; e < normal.count_e; e++) {
        VectorE reduced = VectorE::Zero();
        add_product(reduced, 1.0, inverse_e_[e], normal.b_e[e]);
        for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
            add_product(step.f[static_cast<size_t>(normal.w_index[a])], 1.0, normal.w[a], reduced);
        }
        if (normal.border > 0) {
            add_transposed_product(right_g, 1.0, normal.h_eg[e], reduced);
        }
    }
    forward(step.f);
    if (normal.border > 0) {
        for (size_t f = 0; f < count_; f++) {
            add_transposed_product(right_g, -1.0, s_fg_[f], step.f[f]);
        }
        step.g = solve_border(right_g);
        for (size_t f = 0; f < count_; f++) {
            add_product(step.f[f], -1.0, s_fg_[f], step.g);
        }
    }
    backward(step.f);
    for (size_t e = 0; e < normal.count_e; e++) {
        VectorE right = -normal.b_e[e];
        for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
            add_transposed_product(right, -1.0, normal.w[a], step.f[static_cast<size_t>(normal.w_index[a])]);
        }
        if (normal.border > 0) {
            add_product(right, -1.0, normal.h_eg[e], step.g);
        }
        add_product(step.e[e], 1.0, inverse_e_[e], right);
    }
    return step;
}

template <int E, int F> auto ArrowFactor<E, F>::inverse(const Normal &normal) const -> Covariance
{
    Covariance out;
    const std::vector<MatrixF> z = banded_inverse();
    std::vector<MatrixFG> y = s_fg_; // S_ff^-1 S_fg
    if (normal.border > 0) {
        out.g = scale_g_.asDiagonal() * llt_g_.solve(Eigen::MatrixXd::Identity(normal.border, normal.border)) *
                scale_g_.asDiagonal();
        backward(y);
    }
    out.f.resize(count_);
    out.fg.assign(count_, MatrixFG::Zero(F, normal.border));
    for (size_t i = 0; i < count_; i++) {
        if (normal.border > 0) {
            add_product(out.fg[i], -1.0, y[i], out.g);
        }
        for (size_t d = 0; d <= std::min(i, band_); d++) {
            out.f[i].push_back(z[at(i, d)]);
            if (normal.border > 0) {
                add_product_transposed(out.f[i].back(), -1.0, out.fg[i], y[i - d]);
            }
        }
    }
    for (size_t e = 0; e < normal.count_e; e++) {
        out.e.push_back(eliminated_covariance(normal, out, e));
    }
    return out;
}

template <int E, int F>
Eigen::MatrixXd ArrowFactor<E, F>::functions(const Normal &normal, std::span<const int> e,
                                             std::span<const MatrixEG> a) const
{
    const Eigen::Index m = a.empty() ? 0 : a[0].cols();
    Eigen::MatrixXd out = Eigen::MatrixXd::Zero(m, m), on_g = Eigen::MatrixXd::Zero(normal.border, m);
    std::vector<MatrixFG> x(count_, MatrixFG::Zero(F, m)); // how the functions depend on the f blocks
    size_t first = count_;
    for (size_t k = 0; k < e.size(); k++) {
        const size_t block = static_cast<size_t>(e[k]);
        MatrixEG solved = MatrixEG::Zero(E, m);
        add_product(solved, 1.0, inverse_e_[block], a[k]);
        add_transposed_product(out, 1.0, a[k], solved);
        for (size_t c = normal.w_offset[block]; c < normal.w_offset[block + 1]; c++) {
            const size_t i = static_cast<size_t>(normal.w_index[c]);
            add_product(x[i], -1.0, normal.w[c], solved);
            first = std::min(first, i);
        }
        if (normal.border > 0) {
            add_transposed_product(on_g, -1.0, normal.h_eg[block], solved);
        }
    }
    forward(x, first);
    for (size_t i = first; i < count_; i++) {
        add_transposed_product(out, 1.0, x[i], x[i]);
        if (normal.border > 0) {
            add_transposed_product(on_g, -1.0, s_fg_[i], x[i]);
        }
    }
    if (normal.border > 0) {
        const Eigen::MatrixXd scaled_g = scale_g_.asDiagonal() * on_g;
        out += scaled_g.transpose() * llt_g_.solve(scaled_g);
    }
    return out;
}

// In place: s_ff_ becomes the lower block-banded factor L, its diagonal blocks lower triangular.
template <int E, int F> bool ArrowFactor<E, F>::factor_band(const Normal &normal)
{
    for (size_t i = 0; i < count_; i++) {
        const size_t start = i > band_ ? i - band_ : 0;
        for (size_t j = start; j <= i; j++) {
            MatrixF &block = s_ff_[at(i, i - j)];
            const size_t from = std::max(start, j > band_ ? j - band_ : 0);
            for (size_t k = from; k < j; k++) {
                add_product_transposed(block, -1.0, s_ff_[at(i, i - k)], s_ff_[at(j, j - k)]);
            }
            if (j < i) {
                solve_from_right(s_ff_[at(j, 0)], block);
                continue;
            }
            double before = normal.common.h_ff[at(i, 0)](0, 0);
            for (int k = 1; k < F; k++) {
                before = std::min(before, normal.common.h_ff[at(i, 0)](k, k));
            }
            if (!cholesky(block)) {
                return false;
            }
            for (int k = 0; k < F; k++) { // a pivot that lost all its digits: as in eliminate()
                if (!(block(k, k) > 1e-8 * std::sqrt(std::max(before, 0.0)))) {
                    return false;
                }
            }
        }
    }
    return true;
}

// s_fg_ becomes X = L^-1 S_fg, and the border its own factor.
template <int E, int F> bool ArrowFactor<E, F>::factor_border(const Normal &normal)
{
    if (normal.border == 0) {
        return true;
    }
    forward(s_fg_);
    for (size_t i = 0; i < count_; i++) {
        add_transposed_product(s_gg_, -1.0, s_fg_[i], s_fg_[i]);
    }
    // Scaled to unit diagonal before factoring, so that "singular" does not depend on units.
    scale_g_ = normal.common.h_gg.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    llt_g_.compute(scale_g_.asDiagonal() * s_gg_ * scale_g_.asDiagonal());
    return llt_g_.info() == Eigen::Success && llt_g_.matrixL().toDenseMatrix().diagonal().minCoeff() > 1e-8;
}

// S_ff^-1 inside the band, z[i][d] between i and i - d, with the factor of the undamped matrix: Takahashi's
// recursion, from the last block backwards.
template <int E, int F> auto ArrowFactor<E, F>::banded_inverse() const -> std::vector<MatrixF>
{
    std::vector<MatrixF> z(count_ * (band_ + 1), MatrixF::Zero());
    for (size_t j = count_; j-- > 0;) {
        MatrixF inverse = MatrixF::Identity();
        solve_lower(s_ff_[at(j, 0)], inverse);
        const size_t last = std::min(count_ - 1, j + band_);
        for (size_t i = last; i > j; i--) {
            MatrixF sum = MatrixF::Zero();
            for (size_t k = j + 1; k <= last; k++) {
                if (i >= k) {
                    add_product(sum, -1.0, z[at(i, i - k)], s_ff_[at(k, k - j)]);
                } else {
                    add_transposed_product(sum, -1.0, z[at(k, k - i)], s_ff_[at(k, k - j)]);
                }
            }
            add_product(z[at(i, i - j)], 1.0, sum, inverse);
        }
        MatrixF sum = inverse, block = MatrixF::Zero();
        for (size_t k = j + 1; k <= last; k++) {
            add_transposed_product(sum, -1.0, s_ff_[at(k, k - j)], z[at(k, k - j)]);
        }
        // Made symmetric: the part that is not grows with every block, by 1.8 a frame in a survey, to nonsense.
        add_transposed_product(block, 0.5, inverse, sum);
        add_transposed_product(block, 0.5, sum, inverse);
        z[at(j, 0)] = block;
    }
    return z;
}

template <int E, int F>
auto ArrowFactor<E, F>::eliminated_covariance(const Normal &normal, const Covariance &known, size_t e) const -> MatrixE
{
    MatrixE crossed = MatrixE::Zero(), middle = MatrixE::Zero(); // middle: crossed + its transpose + the rest
    for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
        const size_t i = static_cast<size_t>(normal.w_index[a]);
        for (size_t b = normal.w_offset[e]; b <= a; b++) {
            MatrixFE half = MatrixFE::Zero();
            add_product(half, 1.0, known.f[i][i - static_cast<size_t>(normal.w_index[b])], normal.w[b]);
            add_transposed_product(b < a ? crossed : middle, 1.0, normal.w[a], half);
        }
        if (normal.border > 0) {
            MatrixEG half = MatrixEG::Zero(E, normal.border);
            add_transposed_product(half, 1.0, normal.w[a], known.fg[i]);
            add_product_transposed(crossed, 1.0, half, normal.h_eg[e]);
        }
    }
    if (normal.border > 0) {
        MatrixEG half = MatrixEG::Zero(E, normal.border);
        add_product(half, 1.0, normal.h_eg[e], known.g);
        add_product_transposed(middle, 1.0, half, normal.h_eg[e]);
    }
    MatrixE out = inverse_e_[e], half = MatrixE::Zero();
    for (int i = 0; i < E; i++) {
        for (int j = 0; j < E; j++) {
            middle(i, j) += crossed(i, j) + crossed(j, i);
        }
    }
    add_product(half, 1.0, inverse_e_[e], middle);
    add_product(out, 1.0, half, inverse_e_[e]);
    return out;
}

} // namespace pipefish::optim
