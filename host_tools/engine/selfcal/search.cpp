#include "selfcal/search.hpp"

#include "geometry/degenerate.hpp"
#include "geometry/triangulate.hpp"
#include "parallel.hpp"
#include "selfcal/plane.hpp"
#include "selfcal/residual.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>
#include <stdexcept>

namespace pipefish::selfcal
{

namespace
{

using geometry::Sight;
using geometry::TwoView;
using geometry::TwoViewStatus;

constexpr double DEGREE = std::numbers::pi / 180.0;
constexpr int LEAST_MATCHES = 15, LEADS = 3, FINALISTS = 3;
constexpr size_t START_MATCHES = 500;       // of a pair, that starts are tried with: which minimum, not how well
constexpr double SAME_LENS = 0.25 * DEGREE; // starts that end nearer than this have found one minimum

std::vector<Sight> sights_of(const pf_camera &camera, const std::vector<double> &uv, double sigma)
{
    return geometry::make_sights(camera, uv.size() / 2, uv.data(), nullptr, sigma);
}

double median(std::vector<double> values)
{
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return values.empty() ? 0.0 : *middle;
}

double median_shift(const Pair &pair)
{
    std::vector<double> shift(pair.size());
    for (size_t i = 0; i < pair.size(); i++) {
        shift[i] = (pair.one(i) - pair.two(i)).norm();
    }
    return median(std::move(shift));
}

// How much a pair promises to tell: the shift that its matches have in common is mostly panning and tilting, which is
// what shows a lens; driving along the axis moves them apart. Weighed as the noise of so many averages out.
double promise(const Pair &pair)
{
    std::vector<double> across(pair.size()), down(pair.size());
    for (size_t i = 0; i < pair.size(); i++) {
        const Eigen::Vector2d shift = pair.two(i) - pair.one(i);
        across[i] = shift[0];
        down[i] = shift[1];
    }
    return std::hypot(median(std::move(across)), median(std::move(down))) * std::sqrt(static_cast<double>(pair.size()));
}

Pair thinned(const Pair &pair, size_t most)
{
    const size_t step = (pair.size() + most - 1) / most;
    Pair out;
    for (size_t i = 0; i < pair.size(); i += std::max<size_t>(step, 1)) {
        out.uv1.insert(out.uv1.end(), {pair.uv1[2 * i], pair.uv1[2 * i + 1]});
        out.uv2.insert(out.uv2.end(), {pair.uv2[2 * i], pair.uv2[2 * i + 1]});
    }
    return out;
}

// One node of the grid, and where it led.
struct Start {
    Adjustment at;
    double cost = std::numeric_limits<double>::infinity(); // truncated, per pair of views
    double sigma = 1.0;
    double rim = 0.0; // degrees that the farthest matches are off the axis at first
};

class Search
{
public:
    Search(const std::vector<Pair> &pairs, uint32_t width, uint32_t height, const Options &options)
        : pairs_(pairs), width_(width), height_(height), options_(options)
    {
        result_.pairs.resize(pairs.size());
        std::vector<int> order(pairs.size());
        std::vector<double> promises;
        std::iota(order.begin(), order.end(), 0);
        for (const Pair &pair : pairs) {
            thin_.push_back(thinned(pair, START_MATCHES));
            promises.push_back(promise(pair));
        }
        std::stable_sort(order.begin(), order.end(), [&](int a, int b) {
            return promises[static_cast<size_t>(a)] > promises[static_cast<size_t>(b)];
        });
        for (const int p : order) {
            PairReport &report = result_.pairs[static_cast<size_t>(p)];
            const Pair &pair = pairs[static_cast<size_t>(p)];
            report.inlier.assign(pair.size(), 0);
            report.median_shift = median_shift(pair);
            if (pair.size() < LEAST_MATCHES) {
                report.status = PairStatus::few;
            } else if (report.median_shift < std::max(1.0, 0.002 * width)) {
                report.status = PairStatus::standing;
            } else {
                report.status = PairStatus::ok;
                usable_.push_back(p);
            }
        }
        reach_ = 0.0;
        for (const int p : usable_) {
            for (const std::vector<double> *uv :
                 {&pairs[static_cast<size_t>(p)].uv1, &pairs[static_cast<size_t>(p)].uv2}) {
                for (size_t i = 0; i < uv->size(); i += 2) {
                    const Eigen::Vector2d out = Eigen::Vector2d((*uv)[i], (*uv)[i + 1]) - options.prior.centre;
                    radii_.push_back(out.norm());
                }
            }
        }
        if (!radii_.empty()) {
            std::sort(radii_.begin(), radii_.end());
            // Wrong matches may lie beside a circular image: a disc's 88 % are within .94 of its radius.
            reach_ = radii_[radii_.size() * 88 / 100] / 0.94;
        }
        coarse_ = std::max(1.5, 0.003 * reach_);
    }

    Result run()
    {
        if (usable_.empty()) {
            return std::move(result_);
        }
        std::vector<Start> starts = grid();
        result_.starts = static_cast<int>(starts.size());
        parallel_for(static_cast<int>(starts.size()), options_.threads,
                     [&](int i) { begin(starts[static_cast<size_t>(i)]); });
        keep_best_of_each(starts);
        result_.refined = static_cast<int>(starts.size());
        parallel_for(static_cast<int>(starts.size()), options_.threads,
                     [&](int i) { refine(starts[static_cast<size_t>(i)]); });
        finish(starts);
        return std::move(result_);
    }

private:
    // The best nominal projection of each field of view. By cost alone narrow fields, in which all curves are nearly
    // straight and little can be wrong, crowd out the one that leads to the right lens.
    static void keep_best_of_each(std::vector<Start> &starts)
    {
        std::vector<Start> kept;
        for (const Start &start : starts) {
            if (!std::isfinite(start.cost)) {
                continue;
            }
            if (kept.empty() || kept.back().rim != start.rim) {
                kept.push_back(start);
            } else if (start.cost < kept.back().cost) {
                kept.back() = start;
            }
        }
        starts = std::move(kept);
    }

    std::vector<Start> grid() const
    {
        std::vector<Start> out;
        for (const double rim : {12.0, 18.0, 25.0, 33.0, 42.0, 52.0, 63.0, 75.0, 88.0, 102.0, 118.0}) {
            for (const double q : {1.0, 0.25, 0.0, -0.125, -0.5}) {
                if (rim < 30.0 && q != 1.0 && q != 0.0) {
                    continue; // all the same there
                }
                const LensFamily family(1.1 * rim * DEGREE, options_.prior.bend);
                if (!family.holds(q)) {
                    continue;
                }
                Start start;
                start.rim = rim;
                start.at.width = width_;
                start.at.height = height_;
                start.at.family = family;
                start.at.prior = options_.prior;
                start.at.pairs = &thin_;
                start.at.lens[kLogF] = std::log(reach_ / nominal_radius(q, rim * DEGREE));
                start.at.lens[kShape] = q;
                start.at.lens[kMix] = kMixMean;
                start.at.lens.segment<2>(kCentre) = options_.prior.centre;
                start.at.poses.resize(pairs_.size());
                start.at.match.resize(pairs_.size());
                out.push_back(start);
            }
        }
        return out;
    }

    // Robust essential matrices on rays of the node's lens.
    void begin(Start &start) const
    {
        start.sigma = coarse_;
        const pf_camera camera = start.at.camera();
        double sum = 0.0;
        for (size_t lead = 0; lead < std::min<size_t>(LEADS, usable_.size()); lead++) {
            const int p = usable_[lead];
            const Pair &pair = thin_[static_cast<size_t>(p)];
            const std::vector<Sight> a = sights_of(camera, pair.uv1, coarse_), b = sights_of(camera, pair.uv2, coarse_);
            geometry::TwoViewOptions options;
            options.max_iterations = 300;
            options.seed = options_.seed;
            const TwoView found = geometry::two_view(a, b, options);
            if (found.status == TwoViewStatus::too_few || found.pose.t.squaredNorm() < 0.5) {
                sum += 9.0 * static_cast<double>(pair.size());
                continue;
            }
            start.at.used.push_back(p);
            start.at.poses[static_cast<size_t>(p)] = found.pose;
        }
        if (start.at.used.empty()) {
            return;
        }
        start.cost = sum + start.at.truncated(coarse_);
    }

    // By cost; those that failed go.
    static void sort_found(std::vector<Start> &starts)
    {
        std::stable_sort(starts.begin(), starts.end(), [](const Start &a, const Start &b) { return a.cost < b.cost; });
        while (!starts.empty() && !std::isfinite(starts.back().cost)) {
            starts.pop_back();
        }
    }

    // Matches within `limit` pixels of their epipolar curves, with depths ahead where there is parallax; the robust
    // spread of those errors. The pairs that have too few are dropped.
    static double select(Adjustment &at, double limit)
    {
        const pf_camera camera = at.camera();
        std::vector<double> errors;
        for (const int p : at.used) {
            std::vector<int> &match = at.match[static_cast<size_t>(p)];
            const Pair &pair = (*at.pairs)[static_cast<size_t>(p)];
            const Pose &pose = at.poses[static_cast<size_t>(p)];
            match.clear();
            for (size_t i = 0; i < pair.size(); i++) {
                const double e = std::abs(at.error(static_cast<size_t>(p), i));
                if (!(e < limit)) {
                    continue;
                }
                Eigen::Vector3d f1, f2;
                if (pf_camera_unproject(&camera, pair.one(i).data(), f1.data(), nullptr, nullptr) != PF_OK ||
                    pf_camera_unproject(&camera, pair.two(i).data(), f2.data(), nullptr, nullptr) != PF_OK) {
                    continue;
                }
                const Eigen::Vector3d g = pose.r * f1;
                if (g.dot(f2) < 0.99985 && geometry::midpoint_depths(g, f2, pose.t).minCoeff() <= 0.0) {
                    continue;
                }
                match.push_back(static_cast<int>(i));
                errors.push_back(e);
            }
        }
        std::erase_if(at.used, [&](int p) { return at.match[static_cast<size_t>(p)].size() < LEAST_MATCHES; });
        return errors.empty() ? limit : std::max(1.4826 * median(std::move(errors)), 0.02);
    }

    // A wrong match that happens to lie on its epipolar curve mostly has a parallax far beyond the others', and pulls
    // with it: two of 320 moved a mirror's centre by five sigmas. Where there are wrong matches at all, those whose
    // parallax is 2.5 standard deviations (of its logarithm) beyond the ordinary are dropped.
    static void drop_levers(Adjustment &at)
    {
        const pf_camera camera = at.camera();
        for (const int p : at.used) {
            std::vector<int> &match = at.match[static_cast<size_t>(p)];
            const Pair &pair = (*at.pairs)[static_cast<size_t>(p)];
            if (match.size() * 20 > pair.size() * 19) {
                continue;
            }
            std::vector<double> lever;
            for (const int i : match) {
                Eigen::Vector3d f1, f2;
                (void)pf_camera_unproject(&camera, pair.one(static_cast<size_t>(i)).data(), f1.data(), nullptr,
                                          nullptr);
                (void)pf_camera_unproject(&camera, pair.two(static_cast<size_t>(i)).data(), f2.data(), nullptr,
                                          nullptr);
                const Eigen::Vector3d g = at.poses[static_cast<size_t>(p)].r * f1;
                lever.push_back(std::log(std::max(std::atan2(g.cross(f2).norm(), g.dot(f2)), 1e-6)));
            }
            std::vector<double> above;
            const double middle = median(lever);
            for (const double value : lever) {
                if (value > middle) {
                    above.push_back(value - middle);
                }
            }
            const double limit = middle + 2.5 * 1.4826 * median(above);
            size_t kept = 0;
            for (size_t i = 0; i < match.size(); i++) {
                if (lever[i] <= limit) {
                    match[kept++] = match[i];
                }
            }
            match.resize(kept);
        }
        std::erase_if(at.used, [&](int p) { return at.match[static_cast<size_t>(p)].size() < LEAST_MATCHES; });
    }

    // The field that the lens is looked at in follows the lens.
    void follow(Adjustment &at) const
    {
        const pf_camera camera = at.camera();
        const double rim[2] = {camera.c_u + 1.05 * reach_, camera.c_v};
        double ray[3], theta = camera.theta_max;
        if (pf_camera_unproject(&camera, rim, ray, nullptr, nullptr) == PF_OK) {
            theta = std::atan2(std::hypot(ray[0], ray[1]), ray[2]);
        }
        const LensFamily next(std::clamp(theta, 0.1, 2.6), options_.prior.bend);
        if (next.holds(at.lens[kShape])) {
            at.family = next;
        }
    }

    // Poses, then with the radius, then the centre too; the spread of what fits shrinks towards the noise.
    void refine(Start &start) const
    {
        Adjustment &at = start.at;
        at.loss = {optim::RobustLoss::Kind::cauchy, 1.0, 0.0};
        at.sigma = coarse_;
        for (const Stage stage : {Stage::poses, Stage::radius, Stage::radius, Stage::centre, Stage::centre}) {
            const double spread = select(at, 6.0 * at.sigma);
            if (at.used.empty()) {
                start.cost = std::numeric_limits<double>::infinity();
                return;
            }
            at.sigma = std::clamp(spread, 0.1, at.sigma);
            if (stage >= Stage::radius) {
                follow(at);
            }
            at.adjust(stage, 15);
        }
        start.sigma = select(at, 4.0 * at.sigma);
        start.cost = 0.0;
    }

    void finish(std::vector<Start> &starts)
    {
        double least = std::numeric_limits<double>::infinity();
        for (const Start &start : starts) {
            if (std::isfinite(start.cost)) {
                least = std::min(least, start.sigma);
            }
        }
        for (Start &start : starts) {
            if (std::isfinite(start.cost)) {
                // Pairs that a start has lost count as outliers.
                double lost = 0.0;
                for (size_t lead = 0; lead < std::min<size_t>(LEADS, usable_.size()); lead++) {
                    if (std::find(start.at.used.begin(), start.at.used.end(), usable_[lead]) == start.at.used.end()) {
                        lost += 9.0 * static_cast<double>(thin_[static_cast<size_t>(usable_[lead])].size());
                    }
                }
                start.cost = lost + start.at.truncated(std::max(least, 0.2));
            }
        }
        std::vector<Start> finalists = starts;
        sort_found(finalists);
        std::vector<Start> different;
        for (const Start &start : finalists) {
            const bool known = std::any_of(different.begin(), different.end(),
                                           [&](const Start &other) { return same(start.at, other.at); });
            if (!known && different.size() < FINALISTS) {
                different.push_back(start);
            }
        }
        if (different.empty()) {
            return;
        }
        const std::vector<Start> entered = different;
        parallel_for(static_cast<int>(different.size()), options_.threads,
                     [&](int i) { complete(different[static_cast<size_t>(i)]); });
        std::vector<size_t> order(different.size());
        std::iota(order.begin(), order.end(), size_t{0});
        std::stable_sort(order.begin(), order.end(),
                         [&](size_t a, size_t b) { return different[a].cost < different[b].cost; });
        if (!std::isfinite(different[order[0]].cost)) {
            return;
        }
        for (size_t k = 1; k < order.size(); k++) {
            if (std::isfinite(different[order[k]].cost) && !same(different[order[0]].at, different[order[k]].at)) {
                result_.runner_up = different[order[k]].cost / different[order[0]].cost;
                break;
            }
        }
        for (const Start &start : starts) {
            // A start ends where the finalist ends that it is the same as.
            for (size_t k = 0; k < entered.size(); k++) {
                if (std::isfinite(start.cost) && same(start.at, entered[k].at)) {
                    result_.agreeing += k == order[0] || same(different[k].at, different[order[0]].at);
                    break;
                }
            }
        }
        report(different[order[0]]);
    }

    bool same(const Adjustment &a, const Adjustment &b) const
    {
        return bearing_difference(a.camera(), b.camera(), {a.lens[kCentre], a.lens[kCentre + 1]}, 0.9 * reach_) <
               SAME_LENS;
    }

    // All pairs, all unknowns, least squares on what lies within three sigmas.
    void complete(Start &start) const
    {
        Adjustment &at = start.at;
        at.pairs = &pairs_;
        const std::vector<int> had = at.used;
        const pf_camera camera = at.camera();
        for (const int p : usable_) {
            if (std::find(had.begin(), had.end(), p) != had.end()) {
                continue;
            }
            const Pair &pair = pairs_[static_cast<size_t>(p)];
            geometry::TwoViewOptions options;
            options.seed = options_.seed;
            const double sigma = 2.0 * start.sigma;
            const TwoView found =
                geometry::two_view(sights_of(camera, pair.uv1, sigma), sights_of(camera, pair.uv2, sigma), options);
            if (found.inliers >= LEAST_MATCHES && found.pose.t.squaredNorm() > 0.5) {
                at.used.push_back(p);
                at.poses[static_cast<size_t>(p)] = found.pose;
            }
        }
        std::sort(at.used.begin(), at.used.end());
        double noise = std::max(start.sigma, 0.1); // as residuals show it; what is right is chosen by it
        at.sigma = std::max(noise, options_.sigma_least);
        at.loss = {optim::RobustLoss::Kind::cauchy, 1.5, 0.0};
        select(at, 5.0 * noise);
        follow(at);
        at.adjust(Stage::all, 30);
        at.loss = {};
        for (int round = 0; round < 3; round++) {
            select(at, 3.0 * noise);
            drop_levers(at);
            at.adjust(Stage::all, 20);
            noise = std::max(spread(at), 0.02);
            at.sigma = std::max(noise, options_.sigma_least);
        }
        if (at.used.empty()) {
            start.cost = std::numeric_limits<double>::infinity();
            return;
        }
        start.sigma = noise;
        start.cost = 0.0;
        const double common = std::max(start.sigma, 0.2);
        start.cost = at.truncated(common) * common * common;
    }

    // Standard deviation of what lies within three sigmas, which is .9866 of all.
    static double spread(const Adjustment &at)
    {
        double sum = 0.0;
        size_t count = 0;
        for (const int p : at.used) {
            for (const int i : at.match[static_cast<size_t>(p)]) {
                const double e = at.error(static_cast<size_t>(p), static_cast<size_t>(i));
                if (std::isfinite(e)) {
                    sum += e * e;
                    count++;
                }
            }
        }
        const double free = static_cast<double>(count) - 5.0 * static_cast<double>(at.used.size()) - 4.0;
        return std::sqrt(sum / std::max(free, 1.0)) / 0.9866;
    }

    // What each pair is, by the lens found; those that tell nothing are left out of what is said of the lens.
    void report(Start &start)
    {
        Adjustment at = start.at;
        const pf_camera camera = at.camera();
        std::vector<int> good;
        for (const int p : usable_) {
            PairReport &out = result_.pairs[static_cast<size_t>(p)];
            const Pair &pair = pairs_[static_cast<size_t>(p)];
            out.pose = at.poses[static_cast<size_t>(p)];
            if (std::find(at.used.begin(), at.used.end(), p) == at.used.end()) {
                out.status = PairStatus::few;
                continue;
            }
            const std::vector<int> &match = at.match[static_cast<size_t>(p)];
            double sum = 0.0;
            for (const int i : match) {
                out.inlier[static_cast<size_t>(i)] = 1;
                sum += std::pow(at.error(static_cast<size_t>(p), static_cast<size_t>(i)), 2);
            }
            out.inliers = static_cast<int>(match.size());
            out.rms = std::sqrt(sum / static_cast<double>(match.size()));
            const std::vector<Sight> a = sights_of(camera, pair.uv1, at.sigma),
                                     b = sights_of(camera, pair.uv2, at.sigma);
            out.status = PairStatus::ok;
            if (geometry::explaining_rotation(out.pose, a, b, match, options_.seed)) {
                out.status = PairStatus::turning;
            } else if (const Flat flat = flatness(at, static_cast<size_t>(p)); flat != Flat::no) {
                out.status = flat == Flat::plane ? PairStatus::plane : PairStatus::turning;
            } else {
                good.push_back(p);
            }
        }
        if (!good.empty()) {
            at.used = good;
        }
        result_.found = true;
        result_.camera = camera;
        result_.lens = at.lens;
        result_.family = at.family;
        result_.sigma = at.sigma;
        try {
            result_.covariance = at.covariance();
        } catch (const std::domain_error &) {
            result_.covariance = 1e6 * LensMatrix::Identity();
        }
        result_.observed = observe(at, result_.covariance, options_.alpha_limit, options_.alone_limit);
    }

    const std::vector<Pair> &pairs_;
    uint32_t width_, height_;
    Options options_;
    std::vector<Pair> thin_;  // of pairs_
    std::vector<int> usable_; // pairs with enough matches that moved, the most promising first
    std::vector<double> radii_;
    double reach_ = 0.0;  // pixels from the prior's centre that nearly all right matches are within
    double coarse_ = 1.5; // pixels that a wrong lens is forgiven at first
    Result result_;
};

} // namespace

Result self_calibrate(const std::vector<Pair> &pairs, uint32_t width, uint32_t height, const Options &options)
{
    return Search(pairs, width, height, options).run();
}

} // namespace pipefish::selfcal
