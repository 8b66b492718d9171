// Growth without maps, in whole pixels: the windows are those of the images themselves, so their means and deviations
// are computed once.
#pragma once

#include "match/grow.hpp"
#include "match/search.hpp"

namespace pipefish::match
{

class WholeSearch
{
public:
    // Refers to all of these. `counts` gets what is turned away.
    WholeSearch(const Image &first, const Image &second, const Options &options, const Free &free, Growth &counts);

    // The best of 3 x 3 places for each free neighbour, by the parent's shift.
    void look_around(const Match &m, std::vector<Candidate> &found);
    // One Gauss-Newton step of the place alone, in whole windows with the mean gradient of both, gain and offset
    // removed.
    Eigen::Vector2f nudged(const Candidate &c) const;

private:
    // Of each window: its mean, and 1 / (deviation x side), 0 where flat.
    struct Statistics {
        cv::Mat1f mean, inverse;
    };
    Statistics statistics_of(const Image &image) const;
    void try_place(int x, int y, int tx, int ty, int order, std::vector<Candidate> &found);

    const Image &first_, &second_;
    const Options &options_;
    const Free &free_;
    Growth &counts_;
    Statistics one_, two_;
    // Of each pixel of image 1, the shift it was last tried with and failed: it would fail again, as windows stay the
    // same and what is taken stays taken. Saves a third of the work.
    cv::Mat1i last_shift_;
};

} // namespace pipefish::match
