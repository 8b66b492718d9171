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

    // Of the inverse. Blocks of f further apart than the band are not computed.
    struct Covariance {
        std::vector<MatrixE> e;
        std::vector<std::vector<MatrixF>> f; // f[i][d]: between f blocks i and i - d
        std::vector<MatrixFG> fg;
        Eigen::MatrixXd g;
    };

    // Of the matrix with its diagonal times 1 + lambda. False: not positive definite.
    bool compute(const Normal &normal, double lambda)
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
            MatrixE h = normal.h_ee[e];
            damp(h, lambda);
            const Eigen::LLT<MatrixE> llt(h);
            // A pivot that lost all its digits belongs to a direction that nothing determines.
            const MatrixE pivots = llt.matrixLLT();
            if (llt.info() != Eigen::Success ||
                !(pivots.diagonal().cwiseAbs2().array() > 1e-15 * h.diagonal().array()).all()) {
                return false;
            }
            inverse_e_[e] = llt.solve(MatrixE::Identity());
            for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
                const Eigen::Matrix<double, F, E> left = normal.w[a].transpose() * inverse_e_[e];
                const size_t i = static_cast<size_t>(normal.w_index[a]);
                for (size_t b = normal.w_offset[e]; b <= a; b++) {
                    s_ff_[at(i, i - static_cast<size_t>(normal.w_index[b]))].noalias() -= left * normal.w[b];
                }
                if (normal.border > 0) {
                    s_fg_[i].noalias() -= left * normal.h_eg[e];
                }
            }
            if (normal.border > 0) {
                s_gg_.template triangularView<Eigen::Lower>() -=
                    normal.h_eg[e].transpose() * (inverse_e_[e] * normal.h_eg[e]);
            }
        }
        return factor_band(normal) && factor_border(normal);
    }

    // Those below are of the matrix that was factored.

    Step<E, F> solve(const Normal &normal) const
    {
        Step<E, F> step = normal.zero_step();
        for (size_t f = 0; f < count_; f++) {
            step.f[f] = -normal.common.b_f[f];
        }
        Eigen::VectorXd right_g = -normal.common.b_g;
        for (size_t e = 0; e < normal.count_e; e++) {
            const VectorE reduced = inverse_e_[e] * normal.b_e[e];
            for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
                step.f[static_cast<size_t>(normal.w_index[a])].noalias() += normal.w[a].transpose() * reduced;
            }
            if (normal.border > 0) {
                right_g.noalias() += normal.h_eg[e].transpose() * reduced;
            }
        }
        forward(step.f);
        if (normal.border > 0) {
            for (size_t f = 0; f < count_; f++) {
                right_g.noalias() -= s_fg_[f].transpose() * step.f[f];
            }
            step.g = solve_border(right_g);
            for (size_t f = 0; f < count_; f++) {
                step.f[f].noalias() -= s_fg_[f] * step.g;
            }
        }
        backward(step.f);
        for (size_t e = 0; e < normal.count_e; e++) {
            VectorE right = -normal.b_e[e];
            for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
                right.noalias() -= normal.w[a] * step.f[static_cast<size_t>(normal.w_index[a])];
            }
            if (normal.border > 0) {
                right.noalias() -= normal.h_eg[e] * step.g;
            }
            step.e[e] = inverse_e_[e] * right;
        }
        return step;
    }

    Covariance inverse(const Normal &normal) const
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
        for (size_t i = 0; i < count_; i++) {
            for (size_t d = 0; d <= std::min(i, band_); d++) {
                MatrixF block = z[at(i, d)];
                if (normal.border > 0) {
                    block += y[i] * out.g * y[i - d].transpose();
                }
                out.f[i].push_back(block);
            }
            out.fg.push_back(normal.border > 0 ? MatrixFG(-y[i] * out.g) : MatrixFG(F, 0));
        }
        for (size_t e = 0; e < normal.count_e; e++) {
            out.e.push_back(eliminated_covariance(normal, out, e));
        }
        return out;
    }

    // Covariance (m x m) of the linear functions sum of a[k]^T x of e blocks e[k], a[k]: E x m. A sum of squares: it
    // keeps its digits where single blocks' covariances are large beside it.
    Eigen::MatrixXd functions(const Normal &normal, std::span<const int> e, std::span<const MatrixEG> a) const
    {
        const Eigen::Index m = a.empty() ? 0 : a[0].cols();
        Eigen::MatrixXd out = Eigen::MatrixXd::Zero(m, m), on_g = Eigen::MatrixXd::Zero(normal.border, m);
        std::vector<MatrixFG> x(count_, MatrixFG::Zero(F, m)); // how the functions depend on the f blocks
        size_t first = count_;
        for (size_t k = 0; k < e.size(); k++) {
            const size_t block = static_cast<size_t>(e[k]);
            const MatrixEG solved = inverse_e_[block] * a[k];
            out.noalias() += a[k].transpose() * solved;
            for (size_t c = normal.w_offset[block]; c < normal.w_offset[block + 1]; c++) {
                const size_t i = static_cast<size_t>(normal.w_index[c]);
                x[i].noalias() -= normal.w[c].transpose() * solved;
                first = std::min(first, i);
            }
            if (normal.border > 0) {
                on_g.noalias() -= normal.h_eg[block].transpose() * solved;
            }
        }
        forward(x, first);
        for (size_t i = first; i < count_; i++) {
            out.noalias() += x[i].transpose() * x[i];
            if (normal.border > 0) {
                on_g.noalias() -= s_fg_[i].transpose() * x[i];
            }
        }
        if (normal.border > 0) {
            const Eigen::MatrixXd scaled_g = scale_g_.asDiagonal() * on_g;
            out += scaled_g.transpose() * llt_g_.solve(scaled_g);
        }
        return out;
    }

private:
    size_t at(size_t i, size_t back) const { return i * (band_ + 1) + back; }

    template <class Matrix> static void damp(Matrix &h, double lambda)
    {
        for (Eigen::Index i = 0; i < h.rows(); i++) {
            h(i, i) += lambda * std::max(h(i, i), 1e-12);
        }
    }

    // In place: s_ff_ becomes the lower block-banded factor L, its diagonal blocks lower triangular.
    bool factor_band(const Normal &normal)
    {
        for (size_t i = 0; i < count_; i++) {
            const size_t start = i > band_ ? i - band_ : 0;
            for (size_t j = start; j <= i; j++) {
                MatrixF &block = s_ff_[at(i, i - j)];
                const size_t from = std::max(start, j > band_ ? j - band_ : 0);
                for (size_t k = from; k < j; k++) {
                    block.noalias() -= s_ff_[at(i, i - k)] * s_ff_[at(j, j - k)].transpose();
                }
                if (j < i) {
                    s_ff_[at(j, 0)]
                        .template triangularView<Eigen::Lower>()
                        .transpose()
                        .template solveInPlace<Eigen::OnTheRight>(block);
                    continue;
                }
                const double before = normal.common.h_ff[at(i, 0)].diagonal().minCoeff();
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
    bool factor_border(const Normal &normal)
    {
        if (normal.border == 0) {
            return true;
        }
        forward(s_fg_);
        for (size_t i = 0; i < count_; i++) {
            s_gg_.template selfadjointView<Eigen::Lower>().rankUpdate(s_fg_[i].transpose(), -1.0);
        }
        // Scaled to unit diagonal before factoring, so that "singular" does not depend on units.
        scale_g_ = normal.common.h_gg.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
        llt_g_.compute(scale_g_.asDiagonal() * s_gg_ * scale_g_.asDiagonal());
        return llt_g_.info() == Eigen::Success && llt_g_.matrixL().toDenseMatrix().diagonal().minCoeff() > 1e-8;
    }

    template <class Rows> void forward(std::vector<Rows> &x, size_t first = 0) const // x := L^-1 x, zero before first
    {
        for (size_t i = first; i < count_; i++) {
            for (size_t k = std::max(first, i > band_ ? i - band_ : 0); k < i; k++) {
                x[i].noalias() -= s_ff_[at(i, i - k)] * x[k];
            }
            s_ff_[at(i, 0)].template triangularView<Eigen::Lower>().solveInPlace(x[i]);
        }
    }

    template <class Rows> void backward(std::vector<Rows> &x) const // x := L^-T x
    {
        for (size_t i = count_; i-- > 0;) {
            for (size_t k = i + 1; k < count_ && k <= i + band_; k++) {
                x[i].noalias() -= s_ff_[at(k, k - i)].transpose() * x[k];
            }
            s_ff_[at(i, 0)].template triangularView<Eigen::Lower>().transpose().solveInPlace(x[i]);
        }
    }

    Eigen::VectorXd solve_border(const Eigen::VectorXd &right) const
    {
        return scale_g_.asDiagonal() * llt_g_.solve(scale_g_.asDiagonal() * right);
    }

    // S_ff^-1 inside the band, z[i][d] between i and i - d, with the factor of the undamped matrix: Takahashi's
    // recursion, from the last block backwards.
    std::vector<MatrixF> banded_inverse() const
    {
        std::vector<MatrixF> z(count_ * (band_ + 1), MatrixF::Zero());
        const auto known = [&](size_t i, size_t j) -> MatrixF { // either order, within the band
            return i >= j ? z[at(i, i - j)] : MatrixF(z[at(j, j - i)].transpose());
        };
        for (size_t j = count_; j-- > 0;) {
            const MatrixF diagonal = s_ff_[at(j, 0)];
            const MatrixF inverse = diagonal.template triangularView<Eigen::Lower>().solve(MatrixF::Identity());
            const size_t last = std::min(count_ - 1, j + band_);
            for (size_t i = last; i > j; i--) {
                MatrixF sum = MatrixF::Zero();
                for (size_t k = j + 1; k <= last; k++) {
                    sum.noalias() -= known(i, k) * s_ff_[at(k, k - j)];
                }
                z[at(i, i - j)] = sum * inverse;
            }
            MatrixF sum = inverse;
            for (size_t k = j + 1; k <= last; k++) {
                sum.noalias() -= s_ff_[at(k, k - j)].transpose() * known(k, j);
            }
            // Made symmetric: the part that is not grows with every block, by 1.8 a frame in a survey, to nonsense.
            const MatrixF block = inverse.transpose() * sum;
            z[at(j, 0)] = 0.5 * (block + block.transpose());
        }
        return z;
    }

    MatrixE eliminated_covariance(const Normal &normal, const Covariance &known, size_t e) const
    {
        MatrixE middle = MatrixE::Zero();
        for (size_t a = normal.w_offset[e]; a < normal.w_offset[e + 1]; a++) {
            const size_t i = static_cast<size_t>(normal.w_index[a]);
            for (size_t b = normal.w_offset[e]; b < a; b++) {
                const MatrixE part =
                    normal.w[a] * known.f[i][i - static_cast<size_t>(normal.w_index[b])] * normal.w[b].transpose();
                middle += part + part.transpose();
            }
            middle += normal.w[a] * known.f[i][0] * normal.w[a].transpose();
            if (normal.border > 0) {
                const MatrixE part = normal.w[a] * known.fg[i] * normal.h_eg[e].transpose();
                middle += part + part.transpose();
            }
        }
        if (normal.border > 0) {
            middle += normal.h_eg[e] * known.g * normal.h_eg[e].transpose();
        }
        return inverse_e_[e] + inverse_e_[e] * middle * inverse_e_[e];
    }

    size_t count_ = 0, band_ = 0; // of f blocks
    std::vector<MatrixE> inverse_e_;
    std::vector<MatrixF> s_ff_;  // L
    std::vector<MatrixFG> s_fg_; // L^-1 S_fg
    Eigen::MatrixXd s_gg_;
    Eigen::VectorXd scale_g_;
    Eigen::LLT<Eigen::MatrixXd> llt_g_;
};

} // namespace pipefish::optim
