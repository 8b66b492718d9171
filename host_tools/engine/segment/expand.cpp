#include "segment/expand.hpp"

#include "segment/cut.hpp"

namespace pipefish::segment
{

int64_t Problem::energy(const Labels &labels) const
{
    int64_t sum = 0;
    for (size_t p = 0; p < nodes(); p++) {
        const size_t k = labels[p];
        sum += cost[k][p];
        if (k > 0 && partner[k][p] >= 0 && labels[static_cast<size_t>(partner[k][p])] != k)
            sum += lonely;
    }
    for (const Edge &e : edges)
        if (labels[static_cast<size_t>(e.i)] != labels[static_cast<size_t>(e.j)])
            sum += e.cost;
    return sum;
}

namespace
{

// One expansion as a cut: a variable for each node that can change, 1 where it takes alpha.
class Expansion
{
public:
    Expansion(const Problem &problem, int alpha, const Labels &labels)
        : problem_(problem), labels_(labels), alpha_(static_cast<uint8_t>(alpha)), variable_(problem.nodes(), -1)
    {
        const std::vector<int32_t> &cost = problem.cost[alpha_];
        for (size_t p = 0; p < labels.size(); p++)
            if (labels[p] != alpha_ && cost[p] < Problem::kNever)
                variable_[p] = count_++;
    }

    bool run(Labels &labels)
    {
        if (count_ == 0)
            return false;
        Cut cut(count_);
        for (size_t p = 0; p < labels.size(); p++) {
            if (variable_[p] >= 0) {
                cut.add(variable_[p], problem_.cost[labels[p]][p], problem_.cost[alpha_][p]);
                couple(cut, p, alpha_);
            }
            couple(cut, p, labels[p]);
        }
        for (const Problem::Edge &e : problem_.edges)
            pair(cut, static_cast<size_t>(e.i), static_cast<size_t>(e.j),
                 [&](uint8_t a, uint8_t b) { return a != b ? e.cost : 0; });
        const int64_t before = cut.all_zero();
        if (cut.solve() >= before)
            return false;
        for (size_t p = 0; p < labels.size(); p++)
            if (variable_[p] >= 0 && cut.one(variable_[p]))
                labels[p] = alpha_;
        return true;
    }

private:
    // What p pays if it has label k and its partner has not.
    void couple(Cut &cut, size_t p, uint8_t k)
    {
        if (k > 0 && problem_.partner[k][p] >= 0)
            pair(cut, p, static_cast<size_t>(problem_.partner[k][p]),
                 [&](uint8_t a, uint8_t b) { return a == k && b != k ? problem_.lonely : 0; });
    }

    // Adds a cost of two nodes' labels, of which each, one or none may change.
    template <typename Cost> void pair(Cut &cut, size_t p, size_t q, const Cost &cost)
    {
        const uint8_t a = labels_[p], b = labels_[q];
        if (variable_[p] >= 0 && variable_[q] >= 0)
            cut.add(variable_[p], variable_[q], {cost(a, b), cost(a, alpha_), cost(alpha_, b), cost(alpha_, alpha_)});
        else if (variable_[p] >= 0)
            cut.add(variable_[p], cost(a, b), cost(alpha_, b));
        else if (variable_[q] >= 0)
            cut.add(variable_[q], cost(a, b), cost(a, alpha_));
    }

    const Problem &problem_;
    const Labels &labels_;
    uint8_t alpha_;
    std::vector<int> variable_;
    int count_ = 0;
};

} // namespace

bool expand_once(const Problem &problem, int alpha, Labels &labels)
{
    return Expansion(problem, alpha, labels).run(labels);
}

void expand(const Problem &problem, int cycles, Labels &labels)
{
    int idle = 0; // labels in a row that gained nothing
    for (int k = 0; k < cycles * problem.labels() && idle < problem.labels(); k++)
        idle = expand_once(problem, k % problem.labels(), labels) ? 1 : idle + 1;
}

} // namespace pipefish::segment
