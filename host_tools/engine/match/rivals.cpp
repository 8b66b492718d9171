#include "match/rivals.hpp"

#include "match/patch.hpp"
#include "parallel.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace pipefish::match
{

namespace
{

constexpr int kChunk = 512; // matches a thread takes at a time

// One way along the curve: steps of `step` pixels of image 2, as far beside it as the match is, or a match off its
// curve by a tenth of a pixel would look better than the same texture on it.
class Walk
{
public:
    Walk(const LineAt &line_at, const Match &m, double sense, double step)
        : line_at_(line_at), at_(m.x, m.y), place_(m.centre.cast<double>()), sense_(sense), step_(step)
    {
    }

    std::optional<Eigen::Vector2d> next()
    {
        const auto line = line_at_(at_, place_);
        if (!line || !(line->n_2.norm() > 0))
            return std::nullopt;
        const double beside = line->error / line->n_2.norm();
        Eigen::Vector2d along = Eigen::Vector2d(-line->n_2.y(), line->n_2.x()).normalized() * sense_;
        if (along.dot(before_) < 0)
            along = -along; // beyond the epipole the line's sense turns
        before_ = along;
        place_ += step_ * along;
        if (const auto there = line_at_(at_, place_)) {
            const double norm = there->n_2.norm(), off = there->error / norm - beside;
            if (std::abs(off) < step_)
                place_ -= off / norm * there->n_2;
        }
        return place_;
    }

private:
    const LineAt &line_at_;
    Eigen::Vector2d at_, place_, before_ = Eigen::Vector2d::Zero();
    double sense_, step_;
};

// The largest value near the middle of three places in a row: of the parabola through them where the middle one is the
// highest. A pattern's period is no whole number of steps.
double crest(double before, double here, double ahead)
{
    const double bend = before - 2 * here + ahead;
    if (!(before > 0) || !(ahead > 0) || here < before || here < ahead || !(bend < 0))
        return here;
    const double slope = 0.5 * (ahead - before);
    return std::min(here - 0.5 * slope * slope / bend, 1.0);
}

double rival_of(const ScaleStack &first, const ScaleStack &second, const Match &m, const LineAt &line_at,
                const Reach &reach)
{
    Local own{m.centre, m.a};
    if (!measure(first, second, m.x, m.y, reach.radius, reach.sigma_min, own) || !(own.zncc > 0))
        return 0;
    const double step = std::max(1.0, std::sqrt(std::abs(static_cast<double>(m.a.determinant()))));
    double best = 0;
    for (const double sense : {1.0, -1.0}) {
        Walk walk(line_at, m, sense, step);
        double before = 0, here = 0; // at the last two places
        for (int k = 1; k <= reach.farthest + 1; k++) {
            const auto place = walk.next();
            double ahead = 0;
            if (place && k >= reach.nearest - 1) {
                Local there{place->cast<float>(), m.a};
                if (measure(first, second, m.x, m.y, reach.radius, reach.sigma_min, there))
                    ahead = static_cast<double>(there.zncc);
            }
            if (k > reach.nearest)
                best = std::max(best, crest(before, here, ahead));
            if (!place)
                break;
            before = here;
            here = ahead;
        }
    }
    return best / static_cast<double>(own.zncc);
}

} // namespace

std::vector<double> rivals(const ScaleStack &first, const ScaleStack &second, const std::vector<Match> &matches,
                           const LineAt &line_at, const Reach &reach)
{
    std::vector<double> out(matches.size(), 0);
    const int count = static_cast<int>(matches.size());
    parallel_for((count + kChunk - 1) / kChunk, reach.threads, [&](int chunk) {
        for (int k = chunk * kChunk; k < std::min(count, (chunk + 1) * kChunk); k++)
            out[static_cast<size_t>(k)] = rival_of(first, second, matches[static_cast<size_t>(k)], line_at, reach);
    });
    return out;
}

} // namespace pipefish::match
