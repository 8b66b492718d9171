#include "segment/segment.hpp"

#include "segment/state.hpp"

#include <cmath>
#include <stdexcept>

namespace pipefish::segment
{

namespace
{

void check(const std::vector<Image> (&planes)[2])
{
    for (const std::vector<Image> &picture : planes) {
        if (picture.size() != planes[0].size() || (picture.size() != 1 && picture.size() != 3))
            throw std::invalid_argument("both pictures need one plane, or both three");
        for (const Image &plane : picture)
            if (plane.size() != picture[0].size() || plane.rows < 8 || plane.cols < 8)
                throw std::invalid_argument("planes of a picture differ in size, or are below 8 pixels a side");
    }
}

} // namespace

Result segment(const std::vector<Image> (&planes)[2], const std::vector<match::Match> &matches,
               const group::Groups &groups, const Options &options, const std::function<void(double)> &progress)
{
    check(planes);
    State state(planes, matches, groups, options);
    std::vector<Step> trace;
    const double steps = 5.0 + 4 * options.rounds;
    const auto note = [&](const char *name) {
        trace.push_back({name, state.energy(), static_cast<int>(state.layers())});
        progress(static_cast<double>(trace.size()) / steps);
    };
    note("start");
    state.refine(4);
    note("fields");
    state.merge();
    note("merge");
    state.finer(); // the same fields; their stiffness is measured on the new grid from here on
    note("grid halved");
    for (int k = 0; k < 3; k++) {
        state.claim();
        state.refine(2);
    }
    note("claim");
    for (int round = 0; round < options.rounds && state.layers() > 0; round++) {
        const double before = trace.back().energy;
        if (round == 1) {
            state.trust_pictures(); // the energy alone changes here, too
            note("matches count less");
        }
        state.relabel(round == 0 ? 2 : 3);
        note("labels");
        state.remove();
        note("remove");
        state.claim();
        state.refine(3);
        note("fields");
        if (round == 0) {
            state.merge();
            note("merge");
        }
        if (round > 1 && before - trace.back().energy < 5e-3 * std::abs(before)) // labels of 0.2 % of pixels
            break;
    }
    if (state.layers() > 0)
        state.relabel(3);
    note("labels");
    Result out = state.result();
    out.trace = std::move(trace);
    return out;
}

} // namespace pipefish::segment
