// Runs work items on threads. Items are independent and each writes its own memory, so results do not depend on
// `threads`.
#pragma once

#include <atomic>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace pipefish
{

// Calls body(i) for 0 <= i < items, on the calling thread and threads - 1 others, or as many as the system gives. The
// first exception is passed on.
template <typename Body> void parallel_for(int items, int threads, const Body &body)
{
    std::atomic<int> next{0};
    std::exception_ptr failure;
    std::mutex failure_lock;
    const auto work = [&] {
        try {
            for (int i = next++; i < items; i = next++) {
                body(i);
            }
        } catch (...) {
            const std::lock_guard<std::mutex> guard(failure_lock);
            failure = std::current_exception();
        }
    };
    {
        std::vector<std::jthread> team;
        try {
            for (int k = 1; k < threads && k < items; k++) {
                team.emplace_back(work);
            }
        } catch (const std::system_error &) { // no more threads: those that are there do it all
        }
        work();
    }
    if (failure) {
        std::rethrow_exception(failure);
    }
}

} // namespace pipefish
