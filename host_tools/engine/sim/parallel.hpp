// Rows of work over a few threads. What a row computes must not depend on the thread.
#pragma once

#include <algorithm>
#include <atomic>
#include <thread>
#include <vector>

namespace pipefish::sim
{

template <typename Row> void parallel_rows(int rows, unsigned threads, const Row &row)
{
    std::atomic<int> next{0};
    const auto work = [&] {
        for (int y = next++; y < rows; y = next++)
            row(y);
    };
    std::vector<std::thread> helpers;
    for (unsigned i = 1; i < std::max(1u, threads); i++)
        helpers.emplace_back(work);
    work();
    for (std::thread &t : helpers)
        t.join();
}

} // namespace pipefish::sim
