#include "segment/system.hpp"

#include <algorithm>
#include <stdexcept>

namespace pipefish::segment
{

namespace
{

// Of the blocks of one point: (reach + 1) rows of 2 reach + 1.
size_t slots_of(int reach)
{
    return static_cast<size_t>((reach + 1) * (2 * reach + 1));
}

} // namespace

Pattern::Pattern(int nx, int ny, int reach) : nx_(nx), ny_(ny), reach_(reach)
{
    divide(0, 0, nx, ny);
    std::vector<int> place(order_.size());
    for (size_t k = 0; k < order_.size(); k++)
        place[order_[k]] = static_cast<int>(k);
    near_.resize(order_.size());
    const int width = 2 * reach + 1;
    for (size_t p = 0; p < order_.size(); p++) {
        const int x = static_cast<int>(p) % nx, y = static_cast<int>(p) / nx;
        for (int dy = 0; dy <= reach && y + dy < ny; dy++)
            for (int dx = dy == 0 ? 1 : -std::min(reach, x); dx <= reach && x + dx < nx; dx++) {
                const int one = place[p], two = place[static_cast<size_t>((y + dy) * nx + x + dx)];
                const size_t block = p * slots_of(reach) + static_cast<size_t>(dy * width + dx + reach);
                near_[static_cast<size_t>(std::max(one, two))].push_back({std::min(one, two), block});
            }
    }
    factorise();
}

void Pattern::divide(int left, int top, int right, int bottom)
{
    const auto points = [&](int x0, int y0, int x1, int y1) {
        for (int y = y0; y < y1; y++)
            for (int x = x0; x < x1; x++)
                order_.push_back(static_cast<size_t>(y) * static_cast<size_t>(nx_) + static_cast<size_t>(x));
    };
    const int width = right - left, height = bottom - top;
    if (std::max(width, height) < 3 * reach_ + 2) {
        points(left, top, right, bottom);
    } else if (width > height) { // both halves before what parts them
        const int middle = left + (width - reach_) / 2;
        divide(left, top, middle, bottom);
        divide(middle + reach_, top, right, bottom);
        points(middle, top, middle + reach_, bottom);
    } else {
        const int middle = top + (height - reach_) / 2;
        divide(left, top, right, middle);
        divide(left, middle + reach_, right, bottom);
        points(left, middle, right, middle + reach_);
    }
}

// The factor's row k has entries in the columns of its neighbours and in those on their ways up the elimination tree.
void Pattern::factorise()
{
    const size_t n = order_.size();
    std::vector<int> parent(n, -1), seen(n, -1);
    std::vector<std::vector<int>> rows(n);
    column_.assign(n + 1, 0);
    row_.assign(n + 1, 0);
    for (size_t k = 0; k < n; k++) {
        const int own = static_cast<int>(k);
        seen[k] = own;
        for (const Near &near : near_[k])
            for (auto i = static_cast<size_t>(near.place); seen[i] != own; i = static_cast<size_t>(parent[i])) {
                if (parent[i] < 0)
                    parent[i] = own;
                seen[i] = own;
                rows[k].push_back(static_cast<int>(i));
                column_[i + 1]++;
            }
        row_[k + 1] = row_[k] + rows[k].size();
    }
    for (size_t k = 0; k < n; k++)
        column_[k + 1] += column_[k];
    in_column_.resize(row_[n]);
    in_row_.resize(row_[n]);
    std::vector<size_t> next(column_.begin(), column_.end() - 1);
    for (size_t k = 0; k < n; k++)
        for (const int i : rows[k])
            in_column_[next[static_cast<size_t>(i)]++] = static_cast<int>(k);
    next.assign(row_.begin(), row_.end() - 1);
    for (size_t i = 0; i < n; i++)
        for (size_t p = column_[i]; p < column_[i + 1]; p++)
            in_row_[next[static_cast<size_t>(in_column_[p])]++] = static_cast<int>(i);
}

System::System(std::shared_ptr<const Pattern> pattern)
    : pattern_(std::move(pattern)), width_(2 * pattern_->reach_ + 1), slots_(slots_of(pattern_->reach_)),
      block_(3 * slots_ * pattern_->order_.size(), 0.0),
      right_(Eigen::VectorXd::Zero(static_cast<Eigen::Index>(2 * pattern_->order_.size())))
{
}

Eigen::VectorXd System::solve() const
{
    return Factor(*this).solve(right_);
}

Eigen::VectorXd System::solve(std::shared_ptr<const Factor> &similar) const
{
    constexpr int most = 12;       // steps that take less time than a factor
    constexpr double share = 1e-6; // squared
    if (similar) {
        Eigen::VectorXd out = Eigen::VectorXd::Zero(right_.size()), rest = right_;
        Eigen::VectorXd way = similar->solve(rest), step = way;
        double left = rest.dot(way);
        const double enough = share * left;
        for (int k = 0; k < most && left > enough; k++) {
            const Eigen::VectorXd pushed = times(step);
            const double length = left / step.dot(pushed);
            out += length * step;
            rest -= length * pushed;
            way = similar->solve(rest);
            const double now = rest.dot(way);
            step = way + now / left * step;
            left = now;
        }
        if (left <= enough)
            return out;
    }
    similar = std::make_shared<const Factor>(*this);
    return similar->solve(right_);
}

Eigen::VectorXd System::times(const Eigen::VectorXd &v) const
{
    Eigen::VectorXd out = Eigen::VectorXd::Zero(v.size());
    const Pattern &p = *pattern_;
    for (size_t k = 0; k < p.order_.size(); k++) {
        const auto i = static_cast<Eigen::Index>(2 * p.order_[k]);
        const auto add = [&](size_t block, Eigen::Index j) {
            const double *b = &block_[3 * block];
            out[i] += b[0] * v[j] + b[1] * v[j + 1];
            out[i + 1] += b[1] * v[j] + b[2] * v[j + 1];
            if (i == j)
                return;
            out[j] += b[0] * v[i] + b[1] * v[i + 1];
            out[j + 1] += b[1] * v[i] + b[2] * v[i + 1];
        };
        add(p.order_[k] * slots_ + static_cast<size_t>(width_ / 2), i);
        for (const Pattern::Near &near : p.near_[k])
            add(near.block, static_cast<Eigen::Index>(2 * p.order_[static_cast<size_t>(near.place)]));
    }
    return out;
}

// Row by row.
Factor::Factor(const System &system)
    : pattern_(system.pattern_), below_(pattern_->in_column_.size()), inverse_(pattern_->order_.size())
{
    const Pattern &p = *pattern_;
    const size_t n = p.order_.size();
    std::vector<Block> work(n);
    std::vector<size_t> end(p.column_.begin(), p.column_.end() - 1); // of the entries that each column has so far
    for (size_t k = 0; k < n; k++) {
        const double *own = &system.block_[3 * (p.order_[k] * system.slots_ + static_cast<size_t>(p.reach_))];
        double xx = own[0], xy = own[1], yy = own[2];
        for (const Pattern::Near &near : p.near_[k]) {
            const double *b = &system.block_[3 * near.block];
            work[static_cast<size_t>(near.place)] = {{Double2{b[0], b[1]}, Double2{b[1], b[2]}}};
        }
        for (size_t r = p.row_[k]; r < p.row_[k + 1]; r++) {
            const auto i = static_cast<size_t>(p.in_row_[r]);
            const Block y = work[i];
            work[i] = {};
            for (size_t e = p.column_[i]; e < end[i]; e++) {
                Block &to = work[static_cast<size_t>(p.in_column_[e])];
                const Block &l = below_[e];
                to.row[0] -= l.row[0][0] * y.row[0] + l.row[0][1] * y.row[1];
                to.row[1] -= l.row[1][0] * y.row[0] + l.row[1][1] * y.row[1];
            }
            const Block &d = inverse_[i];
            const Double2 upper = y.row[0][0] * d.row[0] + y.row[1][0] * d.row[1];
            const Double2 lower = y.row[0][1] * d.row[0] + y.row[1][1] * d.row[1];
            below_[end[i]++] = {{upper, lower}};
            xx -= upper[0] * y.row[0][0] + upper[1] * y.row[1][0];
            xy -= upper[0] * y.row[0][1] + upper[1] * y.row[1][1];
            yy -= lower[0] * y.row[0][1] + lower[1] * y.row[1][1];
        }
        const double determinant = xx * yy - xy * xy;
        if (!(xx > 0) || !(determinant > 0))
            throw std::runtime_error("the normal equations of a layer's field are not positive");
        inverse_[k] = {{Double2{yy, -xy} / determinant, Double2{-xy, xx} / determinant}};
    }
}

Eigen::VectorXd Factor::solve(const Eigen::VectorXd &right) const
{
    const Pattern &p = *pattern_;
    const size_t n = p.order_.size();
    std::vector<Double2> z(n);
    for (size_t k = 0; k < n; k++) {
        const auto at = static_cast<Eigen::Index>(2 * p.order_[k]);
        z[k] = Double2{right[at], right[at + 1]};
    }
    for (size_t k = 0; k < n; k++)
        for (size_t e = p.column_[k]; e < p.column_[k + 1]; e++) {
            const Block &l = below_[e];
            const Double2 x = l.row[0] * z[k], y = l.row[1] * z[k];
            z[static_cast<size_t>(p.in_column_[e])] -= Double2{x[0] + x[1], y[0] + y[1]};
        }
    Eigen::VectorXd out(right.size());
    for (size_t k = n; k-- > 0;) {
        z[k] = z[k][0] * inverse_[k].row[0] + z[k][1] * inverse_[k].row[1];
        for (size_t e = p.column_[k]; e < p.column_[k + 1]; e++) {
            const Double2 above = z[static_cast<size_t>(p.in_column_[e])];
            z[k] -= above[0] * below_[e].row[0] + above[1] * below_[e].row[1];
        }
        const auto at = static_cast<Eigen::Index>(2 * p.order_[k]);
        out[at] = z[k][0], out[at + 1] = z[k][1];
    }
    return out;
}

} // namespace pipefish::segment
