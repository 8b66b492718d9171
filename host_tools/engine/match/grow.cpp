#include "match/grow.hpp"

#include "match/grow_whole.hpp"
#include "match/moments.hpp"
#include "match/refine.hpp"
#include "parallel.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>
#include <optional>

namespace pipefish::match
{

namespace
{

constexpr float kFitted = 0.8F; // least correlation of what is fitted: below, a step goes anywhere
constexpr int kBlockMost = 2 * (kReach + 4 * (kRadiusMost + 1)) + 1; // steps of at most 4
constexpr size_t kStride = kBlockMost + 3;                           // of the block's rows, in whole Float4s

// Best first, in constant time: classes of correlation, and within a class last in first out, which keeps to one part
// of the images and so to the cache.
class Queue
{
public:
    explicit Queue(int classes) : head_(static_cast<size_t>(classes), -1) {}

    void push(float zncc, int id)
    {
        const auto classes = static_cast<int>(head_.size());
        const int k = std::clamp(static_cast<int>(zncc * static_cast<float>(classes)), 0, classes - 1);
        int &head = head_[static_cast<size_t>(k)];
        next_.push_back(head); // ids come in order: this is next_[id]
        head = id;
        top_ = std::max(top_, k);
    }

    // -1 when empty.
    int pop()
    {
        while (top_ >= 0 && head_[static_cast<size_t>(top_)] < 0)
            top_--;
        if (top_ < 0)
            return -1;
        int &head = head_[static_cast<size_t>(top_)];
        const int id = head;
        head = next_[static_cast<size_t>(id)];
        return id;
    }

private:
    std::vector<int> head_, next_;
    int top_ = -1;
};

// The window at `from` (top left), values `step` apart. False where flat.
bool take(Window &window, const float *from, size_t stride, int step, int radius, double sigma_min)
{
    const int side = window.side = 2 * radius + 1;
    const int vectors = window.vectors = (side + 3) / 4;
    const Float4 rest = first_of(side - 4 * (vectors - 1));
    Float4 sum = {};
    for (int j = 0; j < side; j++) {
        const float *row = from + static_cast<size_t>(j * step) * stride;
        float *to = window.v + j * 4 * vectors;
        for (int k = 0; k < vectors; k++, row += 4 * step) {
            Float4 v = step == 1 ? load(row) : Float4{row[0], row[step], row[2 * step], row[3 * step]};
            v = k + 1 < vectors ? v : v * rest;
            store(to + 4 * k, v);
            sum += v;
        }
    }
    const auto count = static_cast<float>(side * side);
    const float mean = total(sum) / count;
    Float4 squares = {};
    for (int j = 0; j < side; j++)
        for (int k = 0; k < vectors; k++) {
            float *at = window.v + 4 * (j * vectors + k);
            const Float4 v = k + 1 < vectors ? load(at) - mean : (load(at) - mean) * rest;
            store(at, v);
            squares += v * v;
        }
    window.inverse_sigma = 1 / std::sqrt(total(squares));
    return total(squares) >= static_cast<float>(sigma_min * sigma_min) * count;
}

// What is looked at around a match: offsets from it.
struct Box {
    int left = kReach, top = kReach, right = -kReach, bottom = -kReach;
};
struct Neighbour {
    int order, dx, dy;
};

class Grower
{
public:
    Grower(const ScaleStack &first, const ScaleStack &second, const Options &options, const Epipolar *epipolar)
        : first_(first), second_(second), options_(options), epipolar_(epipolar), queue_(options.classes)
    {
        free_.first = textured(first.image(), options.texture);
        free_.second = textured(second.image(), options.texture);
        if (options.mode == Mode::kTranslation)
            whole_.emplace(first.image(), second.image(), options, free_, out_);
    }

    Growth run(const std::vector<Seed> &seeds)
    {
        // Once for all: growing it would copy, and touch new pages of memory, twice over.
        out_.matches.reserve(std::min(free_.first.total(), free_.second.total()));
        plant(seeds);
        std::vector<Candidate> found;
        for (int id = queue_.pop(); id >= 0; id = queue_.pop()) {
            const Match parent = out_.matches[static_cast<size_t>(id)];
            found.clear();
            if (whole_)
                whole_->look_around(parent, found);
            else
                look_around(parent, found);
            std::sort(found.begin(), found.end(), [](const Candidate &p, const Candidate &q) {
                return p.zncc != q.zncc ? p.zncc > q.zncc : p.order < q.order;
            });
            for (const Candidate &c : found)
                accept(c, parent, id);
        }
        return std::move(out_);
    }

private:
    uint8_t *cell_2(const Eigen::Vector2f &at)
    {
        const auto x = static_cast<int>(std::lround(at.x())), y = static_cast<int>(std::lround(at.y()));
        return x >= 0 && y >= 0 && x < free_.second.cols && y < free_.second.rows ? &free_.second(y, x) : nullptr;
    }

    // Whether a place in image 2 is free among the nine where a search of steps `a` looks. The search may end up to
    // half a step beside them; what is missed so costs a match now and then, what is saved is most of the work where
    // image 1 is the finer one.
    bool any_free_2(const Eigen::Vector2f &at, const Eigen::Matrix2f &a)
    {
        const int reach = std::abs(a.determinant()) < 1 ? 0 : 1;
        for (int j = -reach; j <= reach; j++)
            for (int i = -reach; i <= reach; i++) {
                const uint8_t *cell = cell_2(at + a * Eigen::Vector2f(static_cast<float>(i), static_cast<float>(j)));
                if (cell && *cell)
                    return true;
            }
        return false;
    }

    bool is_free(int x, int y) const
    {
        return x >= 0 && y >= 0 && x < free_.first.cols && y < free_.first.rows && free_.first(y, x) != 0;
    }

    void commit(const Match &m)
    {
        const int id = static_cast<int>(out_.matches.size());
        free_.first(m.y, m.x) = 0;
        *cell_2(m.centre) = 0;
        out_.matches.push_back(m);
        queue_.push(m.zncc, id);
    }

    // Seeds are fitted on a larger patch first: they come from detectors, to a pixel or two.
    void plant(const std::vector<Seed> &seeds)
    {
        std::vector<Match> ready(seeds.size());
        parallel_for(static_cast<int>(seeds.size()), options_.threads, [&](int k) {
            const Seed &s = seeds[static_cast<size_t>(k)];
            if (!(s.at.cwiseAbs().maxCoeff() < 32768)) // an int holds it; what is outside the image goes below
                return;
            Match &m = ready[static_cast<size_t>(k)];
            m.x = static_cast<int>(std::lround(s.at.x()));
            m.y = static_cast<int>(std::lround(s.at.y()));
            m.seed = k;
            Local local;
            local.a = s.a.cast<float>();
            local.centre = (s.centre + s.a * (Eigen::Vector2d(m.x, m.y) - s.at)).cast<float>();
            if (!sane(local.a))
                return;
            const Local given = local;
            for (int i = 0; i < (options_.refine_seeds ? 10 : 0); i++)
                if (!refine(first_, second_, m.x, m.y, kPatchMost, options_.sigma_min, 3.0F, 0.4F, local))
                    break;
            if ((local.centre - given.centre).norm() > 3 * std::sqrt(std::abs(given.a.determinant())) + 1 ||
                !measure(first_, second_, m.x, m.y, 7, options_.sigma_min, local))
                return;
            if (options_.mode == Mode::kTranslation)
                local.a.setIdentity();
            m.centre = local.centre;
            m.a = local.a;
            m.zncc = local.zncc;
        });
        std::vector<size_t> order(ready.size());
        for (size_t k = 0; k < order.size(); k++)
            order[k] = k;
        std::stable_sort(order.begin(), order.end(), [&](size_t p, size_t q) { return ready[p].zncc > ready[q].zncc; });
        for (const size_t k : order) {
            const Match &m = ready[k];
            if (static_cast<double>(m.zncc) < options_.seed_zncc_min || !is_free(m.x, m.y))
                continue;
            const uint8_t *cell = cell_2(m.centre);
            const auto line = line_at(m.x, m.y, m.centre);
            if (!cell || !*cell || off(line))
                continue;
            commit(m);
            out_.seeds_used++;
        }
    }

    std::optional<EpipolarLine> line_at(int x, int y, const Eigen::Vector2f &centre) const
    {
        return epipolar_ ? epipolar_->at({x, y}, centre.cast<double>()) : std::nullopt;
    }

    bool off(const std::optional<EpipolarLine> &line) const
    {
        return epipolar_ && (!line || line->distance() > options_.epipolar_px);
    }

    // The best of 3 x 3 predicted places for each free neighbour. Both surroundings are resampled once, as far as these
    // neighbours ask: all their windows are then windows of two small pictures. Where image 1 is the finer one, samples
    // are `step` apart.
    void look_around(const Match &m, std::vector<Candidate> &found)
    {
        uint64_t free = 0;
        for (int dy = -kReach; dy <= kReach; dy++)
            free |= free_.row(m.x, m.y + dy);
        if (!free)
            return;
        const Sampling s = sampling_for(first_, second_, m.a);
        near_.clear();
        Box box;
        int order = 0;
        for (int dy = -kReach; dy <= kReach; dy++)
            for (int dx = -kReach; dx <= kReach; dx++, order++)
                if (is_free(m.x + dx, m.y + dy) && worth_trying(m, s.step, dx, dy)) {
                    near_.push_back({order, dx, dy});
                    box = {std::min(box.left, dx), std::min(box.top, dy), std::max(box.right, dx),
                           std::max(box.bottom, dy)};
                }
        if (near_.empty())
            return;
        const int half = kReach + s.step * (options_.radius + 1);
        sample_block(m, s, half, box);
        for (const Neighbour &n : near_)
            try_neighbour(m, s, half, n, found);
    }

    // Whether a neighbour's patch is within image 1, and its place in image 2 may be free.
    bool worth_trying(const Match &m, int step, int dx, int dy)
    {
        const int reach = reach_of(step), x = m.x + dx, y = m.y + dy;
        if (x < reach || y < reach || x + reach >= first_.width() || y + reach >= first_.height())
            return false;
        if (any_free_2(m.centre + m.a * Eigen::Vector2f(static_cast<float>(dx), static_cast<float>(dy)),
                       m.a * static_cast<float>(step)))
            return true;
        out_.taken++;
        return false;
    }

    // Of the patch that is fitted next, with its rim.
    int reach_of(int step) const { return (options_.radius + 2) * step; }

    // Image 2 around the match, brought into the frame of image 1: what the windows of the neighbours in `box` need,
    // the match itself at (half, half).
    void sample_block(const Match &m, const Sampling &s, int half, const Box &box)
    {
        const int rim = s.step * (options_.radius + 1);
        const Float4 middle = bilinear(*s.second, Float4{} + m.centre.x(), Float4{} + m.centre.y());
        for (int j = box.top - rim; j <= box.bottom + rim; j++) {
            const Eigen::Vector2f row = m.centre + m.a.col(1) * static_cast<float>(j);
            float *out = block_ + static_cast<size_t>(j + half) * kStride + half;
            for (int i = box.left - rim; i <= box.right + rim; i += 4) {
                const Float4 t = counted(i);
                store(out + i, bilinear(*s.second, row.x() + m.a(0, 0) * t, row.y() + m.a(1, 0) * t) - middle);
            }
        }
        if (s.step == 1)
            box_sums(box);
        else
            std::fill(std::begin(known_), std::end(known_), false);
    }

    // Sums over all windows of a block of samples one apart: those of columns, from one row of places to the next, and
    // along them.
    void box_sums(const Box &box)
    {
        const int n = 2 * options_.radius + 1, begin = box.left + kReach, end = box.right + kReach + n + 2;
        alignas(16) float sums[kStride] = {}, squares[kStride] = {};
        for (int j = box.top + kReach; j <= box.bottom + kReach + 2; j++) {
            const bool fresh = j == box.top + kReach;
            for (int i = begin; i < end; i += 4) {
                Float4 sum = load(sums + i), square = load(squares + i);
                for (int v = fresh ? j : j + n - 1; v < j + n; v++) {
                    const Float4 come = load(block_ + static_cast<size_t>(v) * kStride + i);
                    sum += come;
                    square += come * come;
                }
                if (!fresh) {
                    const Float4 go = load(block_ + static_cast<size_t>(j - 1) * kStride + i);
                    sum -= go;
                    square -= go * go;
                }
                store(sums + i, sum);
                store(squares + i, square);
            }
            float sum = 0, square = 0;
            for (int i = begin; i < end; i++) {
                sum += sums[i];
                square += squares[i];
                if (i + 1 < begin + n)
                    continue;
                keep(j, i + 1 - n, sum, square);
                sum -= sums[i + 1 - n];
                square -= squares[i + 1 - n];
            }
        }
    }

    void keep(int j, int i, float sum, float squares)
    {
        const auto key = static_cast<size_t>(j * (2 * (kReach + 4) + 1) + i);
        const auto count = static_cast<float>((2 * options_.radius + 1) * (2 * options_.radius + 1));
        const float variance = squares - sum * sum / count;
        const auto floor = static_cast<float>(options_.sigma_min * options_.sigma_min);
        inverse_[key] = variance >= floor * count ? 1 / std::sqrt(variance) : 0;
        known_[key] = true;
    }

    // Mean-free norm of the window of the block whose top left is (i, j): kept, up to nine neighbours ask for it. 0 if
    // flat.
    float inverse_sigma_at(int i, int j, int step)
    {
        const auto key = static_cast<size_t>(j * (2 * (kReach + 4) + 1) + i);
        if (!known_[key]) {
            const int n = 2 * options_.radius + 1;
            float sum = 0, squares = 0;
            for (int v = 0; v < n; v++) {
                const float *row = block_ + static_cast<size_t>(j + v * step) * kStride + i;
                for (int u = 0; u < n; u++) {
                    sum += row[u * step];
                    squares += row[u * step] * row[u * step];
                }
            }
            keep(j, i, sum, squares);
        }
        return inverse_[key];
    }

    void try_neighbour(const Match &m, const Sampling &s, int half, const Neighbour &n, std::vector<Candidate> &found)
    {
        const int r = options_.radius, k = s.step, dx = n.dx, dy = n.dy, x = m.x + dx, y = m.y + dy;
        out_.tried++;
        Window window;
        if (!take(window, (*s.first)[y - r * k] + x - r * k, s.first->step1(), k, r, options_.sigma_min))
            return;
        float z[3][3];
        for (int ej = -1; ej <= 1; ej++)
            for (int ei = -1; ei <= 1; ei++) {
                const int i = half + dx + (ei - r) * k, j = half + dy + (ej - r) * k;
                const Eigen::Vector2f offset(static_cast<float>(dx + ei * k), static_cast<float>(dy + ej * k));
                float &out = z[ej + 1][ei + 1];
                out = -1;
                if (!inside(*s.second, m.centre + m.a * offset, m.a, static_cast<float>(reach_of(k))))
                    continue;
                const float scale = inverse_sigma_at(i, j, k);
                if (scale > 0)
                    out = scale * window.inverse_sigma * product(window, i, j, k);
            }
        if (z[1][1] <= -1)
            return; // where it should be is not in image 2: what is beside it is not it
        const Peak peak(z);
        if (static_cast<double>(peak.zncc) < options_.zncc_min) {
            out_.low_zncc++;
            return;
        }
        const Eigen::Vector2f offset =
            Eigen::Vector2f(static_cast<float>(dx), static_cast<float>(dy)) + peak.at * static_cast<float>(k);
        found.push_back({n.order, x, y, m.centre + m.a * offset, peak.zncc, peak.at_border});
    }

    float product(const Window &window, int i, int j, int step)
    {
        const float *from = block_ + static_cast<size_t>(j) * kStride + i;
        if (step == 1)
            return window.dot(from, kStride);
        float sum = 0;
        for (int v = 0; v < window.side; v++)
            for (int u = 0; u < window.side; u++)
                sum += window.v[v * 4 * window.vectors + u] *
                       from[static_cast<size_t>(v * step) * kStride + static_cast<size_t>(u * step)];
        return sum;
    }

    // ---- taking a candidate

    void accept(const Candidate &c, const Match &parent, int id)
    {
        if (!free_.first(c.y, c.x))
            return;
        const uint8_t *cell = cell_2(c.centre);
        if (!cell || !*cell) {
            out_.taken++;
            return;
        }
        const auto line = line_at(c.x, c.y, c.centre);
        if (off(line)) {
            out_.off_line++;
            return;
        }
        Local local{c.centre, parent.a, c.zncc};
        if (whole_)
            local.centre = whole_->nudged(c);
        else if (!adapt(c, line ? &*line : nullptr, local) && c.at_border)
            return; // found at the rim of its search, and no fit confirms it
        if (static_cast<double>(local.zncc) < options_.zncc_min) {
            out_.low_zncc++;
            return;
        }
        cell = cell_2(local.centre);
        if (!cell || !*cell) {
            out_.taken++;
            return;
        }
        if (epipolar_ && off(line_at(c.x, c.y, local.centre))) { // the fit may leave the line by a pixel
            out_.off_line++;
            return;
        }
        out_.at_border += c.at_border;
        commit({c.x, c.y, local.centre, local.a, std::min(local.zncc, 1.0F), id, parent.seed}); // 1 but for rounding
    }

    // Whether a fit was taken.
    bool adapt(const Candidate &c, const EpipolarLine *line, Local &local)
    {
        const int r = options_.radius;
        if (options_.mode == Mode::kConstant)
            return refine(first_, second_, c.x, c.y, r + 1, options_.sigma_min, 1.0F, 0.0F, local);
        if (options_.adaptation != Adaptation::kFit)
            adapt_by_moments(first_, second_, c.x, c.y, options_, line, local);
        const bool fitted =
            options_.adaptation == Adaptation::kIntensity ||
            (c.zncc >= kFitted && refine(first_, second_, c.x, c.y, r + 1, options_.sigma_min, 1.0F, 0.4F, local));
        if (line) {
            Local held = local;
            held.a = line->corrected(local.a);
            if (sane(held.a) && (held.a - local.a).norm() <= 0.4F * local.a.norm() &&
                measure(first_, second_, c.x, c.y, r + 1, options_.sigma_min, held) &&
                held.zncc >= local.zncc - 0.001F - 0.1F * (1 - local.zncc)) // the constraint is exact, the fit noisy
                local = held;
        }
        return fitted;
    }

    const ScaleStack &first_, &second_;
    const Options &options_;
    const Epipolar *epipolar_;
    Free free_;
    Queue queue_;
    Growth out_;
    std::optional<WholeSearch> whole_; // for translation
    std::vector<Neighbour> near_;
    alignas(16) float block_[kBlockMost * kStride] = {};
    bool known_[(2 * (kReach + 4) + 1) * (2 * (kReach + 4) + 1)] = {};
    float inverse_[(2 * (kReach + 4) + 1) * (2 * (kReach + 4) + 1)] = {};
};

} // namespace

Growth grow(const ScaleStack &first, const ScaleStack &second, const std::vector<Seed> &seeds, const Options &options,
            const Epipolar *epipolar)
{
    return Grower(first, second, options, epipolar).run(seeds);
}

} // namespace pipefish::match
