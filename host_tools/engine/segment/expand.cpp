#include "segment/expand.hpp"

#include "segment/cut.hpp"

namespace pipefish::segment
{

int64_t Grid::boundary(const uint8_t *labels, int from, int to) const
{
    const std::array<int, 4> step = steps();
    const auto columns = static_cast<size_t>(width);
    int64_t sum = 0;
    for (size_t p = columns * static_cast<size_t>(from); p < columns * static_cast<size_t>(to); p++)
        for (size_t k = 0; k < 4; k++)
            if (cost[p][k] != 0 && labels[p] != labels[p + static_cast<size_t>(step[k])])
                sum += cost[p][k];
    return sum;
}

int64_t Problem::energy(const Labels &labels) const
{
    int64_t sum = 0;
    for (size_t p = 0; p < nodes(); p++) {
        const size_t k = labels[p];
        sum += cost[k][p];
        if (k > 0 && partner[k][p] >= 0 && labels[static_cast<size_t>(partner[k][p])] != k)
            sum += lonely;
    }
    size_t first = 0;
    for (const Grid *grid : grids) {
        sum += grid->boundary(labels.data() + first, 0, grid->height());
        first += grid->cost.size();
    }
    return sum;
}

namespace
{

// Expansions as cuts: a variable for each node that can change, 1 where it takes alpha.
class Expansion
{
public:
    Expansion(const Problem &problem, Labels &labels) : problem_(problem), labels_(labels), variable_(problem.nodes())
    {
    }

    bool run(int alpha, Flows &flows)
    {
        alpha_ = static_cast<uint8_t>(alpha);
        flows.resize(labels_.size(), {});
        flows_ = flows.data()->data();
        pairs_.clear();
        const std::vector<int32_t> &own = problem_.cost[alpha_];
        free_.clear();
        for (size_t p = 0; p < labels_.size(); p++) {
            const bool changes = labels_[p] != alpha_ && own[p] < Problem::kNever;
            variable_[p] = changes ? static_cast<int>(free_.size()) : -1;
            if (changes)
                free_.push_back(p);
        }
        if (free_.empty())
            return false;
        cut_.start(static_cast<int>(free_.size()));
        for (const size_t p : free_) {
            cut_.add(variable_[p], problem_.cost[labels_[p]][p], own[p]);
            couple(p, alpha_, 6 * p + 4);
        }
        for (size_t p = 0; p < labels_.size(); p++)
            couple(p, labels_[p], 6 * p + 5);
        neighbours();
        const int64_t before = cut_.all_zero();
        const int64_t after = cut_.solve();
        for (size_t k = 0; k < pairs_.size(); k++)
            flows_[pairs_[k]] = cut_.flow(static_cast<int>(k));
        if (after >= before)
            return false;
        for (size_t k = 0; k < free_.size(); k++)
            if (cut_.one(static_cast<int>(k)))
                labels_[free_[k]] = alpha_;
        return true;
    }

private:
    // What p pays if it has label k and its partner has not.
    void couple(size_t p, uint8_t k, size_t slot)
    {
        if (k > 0 && problem_.partner[k][p] >= 0)
            pair(p, static_cast<size_t>(problem_.partner[k][p]), slot,
                 [&](uint8_t a, uint8_t b) { return a == k && b != k ? problem_.lonely : 0; });
    }

    // All neighbours of which one can change at least.
    void neighbours()
    {
        const auto differ = [&](size_t p, size_t q, size_t slot, int32_t cost) {
            if (cost != 0)
                pair(p, q, 6 * p + slot, [&](uint8_t a, uint8_t b) { return a != b ? cost : 0; });
        };
        size_t first = 0, k = 0;
        for (const Grid *grid : problem_.grids) {
            const std::array<int, 4> steps = grid->steps();
            for (; k < free_.size() && free_[k] < first + grid->cost.size(); k++) {
                const size_t p = free_[k], at = p - first;
                for (size_t n = 0; n < 4; n++) {
                    const auto step = static_cast<size_t>(steps[n]);
                    differ(p, p + step, n, grid->cost[at][n]);
                    if (at >= step && variable_[p - step] < 0)
                        differ(p - step, p, n, grid->cost[at - step][n]);
                }
            }
            first += grid->cost.size();
        }
    }

    // Adds a cost of two nodes' labels, of which each, one or none may change. `slot`: of its flow.
    template <typename Cost> void pair(size_t p, size_t q, size_t slot, const Cost &cost)
    {
        const uint8_t a = labels_[p], b = labels_[q];
        if (variable_[p] >= 0 && variable_[q] >= 0) {
            cut_.add(variable_[p], variable_[q], {cost(a, b), cost(a, alpha_), cost(alpha_, b), cost(alpha_, alpha_)},
                     flows_[slot]);
            pairs_.push_back(slot);
        } else if (variable_[p] >= 0)
            cut_.add(variable_[p], cost(a, b), cost(alpha_, b));
        else if (variable_[q] >= 0)
            cut_.add(variable_[q], cost(a, b), cost(a, alpha_));
    }

    const Problem &problem_;
    Labels &labels_;
    uint8_t alpha_ = 0;
    std::vector<int> variable_;
    std::vector<size_t> free_;  // the nodes of the variables
    int32_t *flows_ = nullptr;  // of the label
    std::vector<size_t> pairs_; // of the cut: where in them
    Cut cut_;
};

} // namespace

bool expand_once(const Problem &problem, int alpha, Labels &labels)
{
    Flows flows;
    return Expansion(problem, labels).run(alpha, flows);
}

void expand(const Problem &problem, int cycles, Labels &labels, std::vector<Flows> &flows)
{
    flows.resize(static_cast<size_t>(problem.labels()));
    Expansion expansion(problem, labels);
    int idle = 0; // labels in a row that gained nothing
    for (int k = 0; k < cycles * problem.labels() && idle < problem.labels(); k++) {
        const int alpha = k % problem.labels();
        idle = expansion.run(alpha, flows[static_cast<size_t>(alpha)]) ? 1 : idle + 1;
    }
}

} // namespace pipefish::segment
