// The minimum of a submodular function of binary variables, by a cut of a graph.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::segment
{

// Costs are whole numbers, so that a minimum is a minimum, not one up to rounding.
class Cut
{
public:
    explicit Cut(int variables) : term_(static_cast<size_t>(variables), 0) {}

    // Adds `zero` where variable i is 0, `one` where it is 1.
    void add(int i, int64_t zero, int64_t one)
    {
        constant_ += zero;
        term_[static_cast<size_t>(i)] += one - zero;
    }

    // Adds c[2 i + j] where the variables are i and j; c[0] + c[3] <= c[1] + c[2], or std::invalid_argument.
    void add(int i, int j, const int64_t (&c)[4]);

    // What it comes to where all variables are 0; before solve().
    int64_t all_zero() const { return constant_; }

    // Finds the minimum; one() tells where it is. Of several minima always the same one. May be called once.
    int64_t solve();
    bool one(int i) const { return one_[static_cast<size_t>(i)]; }

private:
    struct Pair {
        int i, j;
        int64_t there; // paid where i is 0 and j is 1
    };
    struct Arcs;

    int64_t constant_ = 0;
    std::vector<int64_t> term_; // paid where the variable is 1, less what is paid where it is 0
    std::vector<Pair> pairs_;
    std::vector<bool> one_;
};

} // namespace pipefish::segment
