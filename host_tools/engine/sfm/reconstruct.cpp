#include "sfm/reconstruct.hpp"

#include "geometry/triangulate.hpp"
#include "median.hpp"
#include "sfm/pupil.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace pipefish::sfm
{

namespace
{

constexpr double LEAST_FACTOR = 1e-6; // of the pixels' variance: sharper ones would leave the encoder no digits
constexpr double LATE_SIGMA = 10.0;   // stated line times may have the other sign, or be of other units
constexpr int LEAST_SEEN = 6;         // points: twice the numbers of a pose

int common_tracks(const TrackTable &table, int first, int last)
{
    int common = 0;
    table.for_pairs(first, last, [&](const Observation &, const Observation &) { common++; });
    return common;
}

BundleOptions building(int min_views)
{
    BundleOptions options;
    options.loss = {optim::RobustLoss::Kind::cauchy, 2.0};
    options.max_iterations = 4;
    options.cost_tolerance = 1e-2;
    options.gate = 30.0;
    options.min_views = min_views;
    return options;
}

// Part of a map, with the points seen there.
Submap part_of(const Submap &map, const TrackTable &table, int from, int to)
{
    Submap part;
    part.first = std::max(from, map.first);
    const int end = std::min(to, map.end());
    part.poses.assign(map.poses.begin() + (part.first - map.first), map.poses.begin() + (end - map.first));
    std::vector<int> seen;
    for (int f = part.first; f < end; f++) {
        for (const int place : table.of_frame(f)) {
            seen.push_back(table[place].track);
        }
    }
    std::sort(seen.begin(), seen.end());
    seen.erase(std::unique(seen.begin(), seen.end()), seen.end());
    for (const int track : seen) {
        const auto at = std::lower_bound(map.tracks.begin(), map.tracks.end(), track);
        if (at != map.tracks.end() && *at == track) {
            part.tracks.push_back(track);
            part.points.push_back(map.points[static_cast<size_t>(at - map.tracks.begin())]);
        }
    }
    return part;
}

void put_back(Submap &map, const Submap &part)
{
    std::copy(part.poses.begin(), part.poses.end(), map.poses.begin() + (part.first - map.first));
    for (size_t p = 0; p < part.tracks.size(); p++) {
        const auto at = std::lower_bound(map.tracks.begin(), map.tracks.end(), part.tracks[p]);
        map.points[static_cast<size_t>(at - map.tracks.begin())] = part.points[p];
    }
}

// Adjusts frames from .. to - 1; outside them `held` frames on each side stay.
void adjust_window(Submap &map, const TrackTable &table, const pf_camera &camera, int from, int to, int held)
{
    Submap part = part_of(map, table, from - held, to + held);
    BundleOptions options = building(2);
    options.held_front = std::max(1, from - part.first);
    options.held_back = std::max(0, part.end() - to);
    options.hold_scale = options.held_front < 2 && options.held_back == 0;
    adjust(part, table, camera, options);
    put_back(map, part);
}

// One more frame, from the points of the map; new points with it. False where it cannot be placed.
bool grow(Submap &map, const TrackTable &table, const pf_camera &camera, const Limits &limits, int window)
{
    const int frame = map.end();
    const Pose &last = map.poses.back(), &before = map.poses[map.poses.size() - 2];
    const Pose guess = last * before.inverse() * last;
    const auto pose = resect(table, map, frame, guess, limits);
    if (!pose) {
        return false;
    }
    map.poses.push_back(*pose);
    fuse_points(map, table, limits, 3, frame, frame + 1);
    const int from = std::max(map.first + 2, frame + 1 - window);
    adjust_window(map, table, camera, from, frame + 1, 2);
    return true;
}

struct Building {
    std::vector<Submap> maps;
    std::vector<Gap> gaps;
};

// Leaves one after the other, each with two frames of the one before; as long as their ends share enough tracks.
struct LeafPlan {
    int first, count;
};

LeafPlan leaf_from(const TrackTable &table, int first, const Limits &limits)
{
    int count = 3;
    while (count < limits.longest_leaf && first + count < table.frames() &&
           common_tracks(table, first, first + count) >= limits.wanted_common) {
        count++;
    }
    return {first, count};
}

std::vector<LeafPlan> plan_leaves(const TrackTable &table, const Limits &limits)
{
    std::vector<LeafPlan> plans;
    for (int first = 0; first + 2 < table.frames(); first += plans.back().count - 2) {
        plans.push_back(leaf_from(table, first, limits));
    }
    return plans;
}

// A leaf that failed for want of parallax may do when longer, one without enough tracks when shorter.
Leaf try_leaf(const TrackTable &table, const pf_camera &camera, const LeafPlan &plan, const Limits &limits)
{
    Leaf leaf = make_leaf(table, camera, plan.first, plan.count, limits);
    for (uint64_t again = 1; leaf.trouble != Trouble::none && again <= 2; again++) {
        Limits other = limits;
        other.seed = limits.seed + again;
        Leaf next = make_leaf(table, camera, plan.first, plan.count, other);
        if (next.trouble == Trouble::none) {
            return next;
        }
    }
    return leaf;
}

// Merges neighbours, level by level; those that do not fit leave a gap.
class Tree
{
public:
    Tree(const TrackTable &table, const pf_camera &camera, const ReconstructOptions &options)
        : table_(table), camera_(camera), options_(options)
    {
    }

    Building build()
    {
        const std::vector<LeafPlan> plans = plan_leaves(table_, options_.limits);
        std::vector<Leaf> leaves(plans.size());
        parallel_for(static_cast<int>(plans.size()), options_.threads, [&](int i) {
            const size_t k = static_cast<size_t>(i);
            leaves[k] = try_leaf(table_, camera_, plans[k], options_.limits);
        });
        Building out;
        std::vector<Submap> run;
        for (size_t i = 0; i < leaves.size(); i++) {
            if (leaves[i].trouble == Trouble::none) {
                run.push_back(std::move(leaves[i].map));
                continue;
            }
            close(run, out);
            const int from = plans[i].first, to = plans[i].first + plans[i].count - 1;
            out.gaps.push_back({from, to, leaves[i].trouble, leaves[i].common});
        }
        close(run, out);
        return out;
    }

private:
    void close(std::vector<Submap> &run, Building &out)
    {
        while (run.size() > 1) {
            std::vector<Submap> next((run.size() + 1) / 2);
            std::vector<Trouble> trouble(next.size(), Trouble::none);
            std::vector<Submap> left_over(next.size());
            parallel_for(static_cast<int>(next.size()), options_.threads, [&](int i) {
                const size_t k = static_cast<size_t>(i), a = 2 * k, b = 2 * k + 1;
                if (b >= run.size()) {
                    next[k] = std::move(run[a]);
                    return;
                }
                auto merged = merge(run[a], run[b], table_, camera_, options_.limits, trouble[k]);
                if (trouble[k] == Trouble::weak_texture) {
                    merged = merge_grown(run[a], run[b], trouble[k]);
                }
                if (!merged) {
                    next[k] = std::move(run[a]);
                    left_over[k] = std::move(run[b]);
                    return;
                }
                next[k] = std::move(*merged);
                settle(next[k], run[b].first);
            });
            // A failed merge breaks the run: what lies before it is closed by itself.
            const auto broken =
                std::find_if(trouble.begin(), trouble.end(), [](Trouble t) { return t != Trouble::none; });
            if (broken == trouble.end()) {
                run = std::move(next);
                continue;
            }
            const size_t k = static_cast<size_t>(broken - trouble.begin());
            std::vector<Submap> before, after;
            for (size_t i = 0; i < next.size(); i++) {
                (i <= k ? before : after).push_back(std::move(next[i]));
                if (!left_over[i].poses.empty()) {
                    after.push_back(std::move(left_over[i]));
                }
            }
            const Gap gap{after.front().first, before.back().end() - 1, *broken, 0};
            close(before, out);
            out.gaps.push_back(gap);
            run = std::move(after);
        }
        if (!run.empty()) {
            out.maps.push_back(std::move(run.front()));
        }
        run.clear();
    }

    // Short tracks, of which some are wrong, leave few points in both of two maps: one that goes further into the
    // other shares more of them.
    std::optional<Submap> merge_grown(Submap a, const Submap &b, Trouble &trouble) const
    {
        while (a.end() < b.end() && grow(a, table_, camera_, options_.limits, static_cast<int>(b.poses.size()))) {
            auto merged = merge(a, b, table_, camera_, options_.limits, trouble);
            if (merged || trouble != Trouble::weak_texture || a.end() > b.first + LONGEST_OVERLAP) {
                return merged;
            }
        }
        return std::nullopt;
    }

    void settle(Submap &map, int seam) const
    {
        if (map.poses.size() <= 18) {
            BundleOptions options = building(3);
            adjust(map, table_, camera_, options);
        } else {
            adjust_window(map, table_, camera_, std::max(seam - 7, map.first + 1), seam + 9, 2);
        }
        clean(map, table_, camera_, 5.0, 3, options_.limits);
    }

    static constexpr int LONGEST_OVERLAP = 5; // frames

    const TrackTable &table_;
    const pf_camera &camera_;
    const ReconstructOptions &options_;
};

// One frame after the other: resection, new points, adjustment of the last frames.
class Chain
{
public:
    static constexpr int WINDOW = 10;

    Chain(const TrackTable &table, const pf_camera &camera, const ReconstructOptions &options)
        : table_(table), camera_(camera), options_(options)
    {
    }

    Building build()
    {
        Building out;
        for (int first = 0; first + 2 < table_.frames();) {
            Leaf leaf = try_leaf(table_, camera_, leaf_from(table_, first, options_.limits), options_.limits);
            if (leaf.trouble != Trouble::none) {
                note(out, {first, first + 1, leaf.trouble, leaf.common});
                first++;
                continue;
            }
            Submap map = std::move(leaf.map);
            while (map.end() < table_.frames() && grow(map, table_, camera_, options_.limits, WINDOW)) {
            }
            first = map.end();
            if (first < table_.frames()) {
                note(out, {first - 1, first, Trouble::weak_texture, common_tracks(table_, first - 1, first)});
            }
            first -= 1;
            out.maps.push_back(std::move(map));
            if (out.maps.back().end() >= table_.frames()) {
                break;
            }
        }
        return out;
    }

private:
    static void note(Building &out, const Gap &gap)
    {
        if (!out.gaps.empty() && out.gaps.back().to == gap.from && out.gaps.back().trouble == gap.trouble) {
            out.gaps.back().to = gap.to;
        } else {
            out.gaps.push_back(gap);
        }
    }

    const TrackTable &table_;
    const pf_camera &camera_;
    const ReconstructOptions &options_;
};

double path_ratio(const Submap &map, const Odometry &odometry, double *sigma)
{
    std::vector<double> ratio, spread;
    for (int f = map.first; f + 1 < map.end(); f++) {
        const double step = std::abs(odometry.step[static_cast<size_t>(f)]);
        if (std::isfinite(step) && step > 3.0 * odometry.sigma[static_cast<size_t>(f)]) {
            ratio.push_back(std::log(step / (map.pose(f + 1).centre() - map.pose(f).centre()).norm()));
        }
    }
    if (ratio.empty()) {
        return 0.0;
    }
    const double n = static_cast<double>(ratio.size()), middle = median_of(ratio);
    for (const double r : ratio) {
        spread.push_back(std::abs(r - middle));
    }
    *sigma = 1.858 * median_of(spread) / std::sqrt(n);
    return std::exp(middle);
}

// First frame at the origin, distance to the last one 1.
void normalise(Submap &map)
{
    Similarity s;
    s.scale = 1.0 / (map.poses.back().centre() - map.poses.front().centre()).norm();
    s.r = map.poses.front().r;
    s.t = s.scale * map.poses.front().t;
    transform(map, s);
}

// Robust adjustment and selection in turn, until hardly a point comes or goes; how many observations there were. The
// camera gets the pupil's shift, where that is estimated.
int select(Segment &segment, TrackTable &table, pf_camera &camera, BundleOptions settings, const Limits &limits)
{
    Submap &map = segment.map;
    int observations = 0;
    settings.loss = {optim::RobustLoss::Kind::huber, 3.0};
    for (int cycle = 0; cycle < 3; cycle++) {
        settings.max_iterations = cycle == 0 ? 30 : 15;
        settings.cost_tolerance = 1e-6;
        settings.gate = cycle == 0 ? 50.0 : 15.0;
        const BundleReport report = adjust(map, table, camera, settings);
        observations = report.observations;
        if (settings.pupil_sigma > 0.0) {
            camera.pupil_e1 = report.pupil;
            table.shift_pupil(report.pupil);
        }
        // Residuals are smaller than errors: poses and points were fitted to them.
        segment.sigma = robust_sigma(map, table, camera) *
                        std::sqrt(2.0 * report.observations / static_cast<double>(report.redundancy));
        const size_t before = map.tracks.size();
        fuse_points(map, table, limits, 3, map.first, map.end());
        clean(map, table, camera, 3.5 * std::max(segment.sigma, 0.5), 3, limits);
        const size_t after = map.tracks.size(), change = after > before ? after - before : before - after;
        if (change * 200 < after) {
            break;
        }
    }
    return observations;
}

// The longest run of frames in each of which LEAST_SEEN points or more are where they should be: others have no pose of
// their own. A camera's model that does not fit leaves such, and where it does not fit at all no frame.
Submap seeing_part(const Submap &map, const TrackTable &table, const pf_camera &camera, double gate)
{
    std::vector<int> seen(map.poses.size()), views;
    Pose room;
    for (size_t p = 0; p < map.tracks.size(); p++) {
        views.clear();
        for (const Observation &o : table.of_track(map.tracks[p])) {
            if (map.has(o.frame) &&
                reprojection_squared(camera, pose_of(map, table, o, room), map.points[p], o) < gate * gate) {
                views.push_back(o.frame - map.first);
            }
        }
        for (const int frame : views) {
            seen[static_cast<size_t>(frame)] += views.size() >= 3; // those with fewer are left out
        }
    }
    int from = 0, to = 0, run = 0;
    for (size_t f = 0; f < seen.size(); f++) {
        run = seen[f] >= LEAST_SEEN ? run + 1 : 0;
        if (run > to - from) {
            to = static_cast<int>(f) + 1;
            from = to - run;
        }
    }
    if (to - from < 3) {
        return {};
    }
    const Submap part = part_of(map, table, map.first + from, map.first + to);
    return part.poses.size() == map.poses.size() ? part : seeing_part(part, table, camera, gate);
}

// The segment's gauge, and its unit where the encoder tells one.
void anchor(Segment &segment, const ReconstructOptions &options)
{
    segment.metric = false;
    segment.scale_sigma = 0.0;
    normalise(segment.map);
    const double ratio = options.odometry ? path_ratio(segment.map, *options.odometry, &segment.scale_sigma) : 0.0;
    if (ratio > 0.0) {
        segment.metric = true;
        Similarity s;
        s.scale = ratio;
        transform(segment.map, s);
    }
}

// Whether the camera's own uncertainty holds that of its pupil's shift, in metres.
bool knows_pupil(const ReconstructOptions &options)
{
    return options.camera_prior && std::count(options.camera_prior->parameter.begin(),
                                              options.camera_prior->parameter.end(), PF_PARAM_PUPIL_E1) > 0;
}

// False: too little of it agrees for poses.
bool finish(Segment &segment, TrackTable &table, const pf_camera &camera, const ReconstructOptions &options)
{
    Submap &map = segment.map;
    if (options.pupil_sigma > 0.0 || (options.odometry && camera.pupil_e1 != 0.0)) {
        straighten(map, table);
    }
    anchor(segment, options);
    pf_camera central = camera;
    BundleOptions settings;
    if (!segment.metric) { // the pupil's shift is a length, and lengths are not known
        guess_pupil(settings, map, table, camera, options.pupil_sigma, options.radius);
        central.pupil_e1 = settings.pupil;
    } else if (options.pupil_sigma > 0.0 && !knows_pupil(options) && is_unread(map, table, *options.odometry)) {
        settings.pupil = camera.pupil_e1;
        settings.pupil_sigma = options.pupil_sigma;
    }
    table.shift_pupil(central.pupil_e1);
    settings.threads = options.threads;
    settings.odometry = segment.metric ? options.odometry : nullptr;
    settings.gravity = options.gravity;
    settings.sag_sigma = options.sag_sigma;
    settings.min_views = 3;
    // Hardly damped: the softest bend of 300 m has 1e-12 of the diagonal's curvature, and steps damped by more than
    // that straighten it bit by bit (26 of them from 1e-9, which fell by a third each; now 3).
    settings.lambda = 1e-15;
    const int observations = select(segment, table, central, settings, options.limits);
    // Least squares on what is left, for an honest covariance.
    settings.loss = {};
    settings.gate = 3.5 * std::max(segment.sigma, 0.5);
    Submap part = seeing_part(map, table, central, settings.gate);
    if (part.poses.size() < 3) {
        return false;
    }
    if (part.poses.size() < map.poses.size()) {
        map = std::move(part);
        const double length = (map.poses.back().centre() - map.poses.front().centre()).norm();
        anchor(segment, options);
        settings.odometry = segment.metric ? options.odometry : nullptr;
        if (!segment.metric) {
            central.pupil_e1 /= length;
        }
    }
    if (!segment.metric) { // once more, by the map as it is now: its start had been built without the pupil
        guess_pupil(settings, map, table, camera, options.pupil_sigma, options.radius);
    }
    segment.frees_pupil = settings.pupil_sigma > 0.0;
    settings.max_iterations = 30;
    // Where a step gains less than a hundredth of a unit nothing moves by more than a seventh of its sigma.
    settings.cost_tolerance = 0.01 / std::max(observations, 1);
    settings.camera_prior = options.camera_prior;
    segment.report = adjust(map, table, central, settings);
    const std::vector<int> used = segment.report.used; // or the covariances would be of different points
    settings.only = &used;
    // The residuals tell the pixels' noise, not that of the encoder, the inclinometer or a prior: beside those the
    // pixels count by what they are.
    segment.noise = std::sqrt(std::max(segment.report.variance_factor, options.common_errors ? 1.0 : LEAST_FACTOR));
    settings.noise = segment.noise;
    settings.camera_prior = nullptr;
    const int before = segment.report.summary.iterations;
    segment.report = adjust(map, table, central, settings, &segment.random);
    segment.iterations = before + segment.report.summary.iterations;
    if (table.rolls()) { // what the rows themselves say of their time: a wrong sign or unit bends the pipe in silence
        Submap again = map;
        settings.late_sigma = LATE_SIGMA;
        BundleCovariance known;
        const BundleReport report = adjust(again, table, central, settings, &known);
        if (report.late_at >= 0) {
            segment.late = report.late;
            segment.late_sigma = std::sqrt(known.border()(report.late_at, report.late_at));
        }
        settings.late_sigma = 0.0;
    }
    if (options.drift_prior) {
        segment.drift.map = map;
        settings.camera_prior = options.drift_prior;
        settings.noise = options.drift_noise;
        BundleCovariance known;
        segment.drift.camera = adjust(segment.drift.map, table, central, settings, &known).camera;
        settings.noise = segment.noise;
        const Eigen::MatrixXd &root = options.drift_prior->root;
        segment.drift.covariance = root * known.border().bottomRightCorner(root.cols(), root.cols()) * root.transpose();
    }
    if (options.camera_prior) {
        settings.camera_prior = options.camera_prior;
        segment.report = adjust(map, table, central, settings, &segment.total);
    }
    return true;
}

// Frames that two neighbours have stay with the first; what has then fewer than three is dropped.
void trim(std::vector<Submap> &maps, const TrackTable &table)
{
    std::vector<Submap> kept;
    for (Submap &map : maps) {
        const int from = kept.empty() ? map.first : std::max(map.first, kept.back().end());
        if (map.end() - from >= 3) {
            kept.push_back(from > map.first ? part_of(map, table, from, map.end()) : std::move(map));
        }
    }
    maps = std::move(kept);
}

// What lies between the segments, before and after them, with what was noted most there.
std::vector<Gap> gaps_between(const std::vector<Segment> &segments, const std::vector<Gap> &notes, int frames)
{
    std::vector<Gap> gaps;
    int reached = 0;
    for (size_t i = 0; i <= segments.size(); i++) {
        const bool first = i == 0, last = i == segments.size();
        const int to = last ? frames - 1 : segments[i].map.first;
        if (to > reached || (!first && !last)) {
            Gap gap{reached, to, Trouble::weak_texture, 0};
            int counts[6] = {};
            for (const Gap &note : notes) {
                if (note.from <= to && note.to >= reached) {
                    int &count = counts[static_cast<size_t>(note.trouble)];
                    if (++count >= *std::max_element(counts, counts + 6)) {
                        gap.trouble = note.trouble;
                        gap.common = note.common;
                    }
                }
            }
            gaps.push_back(gap);
        }
        if (!last) {
            reached = segments[i].map.end() - 1;
        }
    }
    return gaps;
}

} // namespace

std::vector<int> moving_frames(const TrackTable &table, double still)
{
    std::vector<int> frames;
    std::vector<double> moved;
    for (int f = 0; f < table.frames(); f++) {
        if (!frames.empty()) {
            moved.clear();
            table.for_pairs(frames.back(), f, [&](const Observation &a, const Observation &b) {
                moved.push_back((a.sight.uv - b.sight.uv).norm());
            });
            if (moved.size() >= 8 && median_of(moved) < still) {
                continue;
            }
        }
        frames.push_back(f);
    }
    return frames;
}

Reconstruction reconstruct(TrackTable table, const pf_camera &camera, const ReconstructOptions &options)
{
    Reconstruction out;
    out.frames = moving_frames(table, options.still);
    if (out.frames.size() < static_cast<size_t>(table.frames())) {
        table = table.only(out.frames);
    }
    ReconstructOptions inner = options;
    Odometry odometry;
    if (options.odometry) { // steps between the frames used
        odometry = *options.odometry;
        odometry.step.assign(out.frames.size(), 0.0);
        odometry.sigma.assign(out.frames.size(), 0.0);
        for (size_t i = 0; i + 1 < out.frames.size(); i++) {
            double variance = 0.0;
            for (int f = out.frames[i]; f < out.frames[i + 1]; f++) {
                odometry.step[i] += options.odometry->step[static_cast<size_t>(f)];
                variance += std::pow(options.odometry->sigma[static_cast<size_t>(f)], 2);
            }
            odometry.sigma[i] = std::sqrt(variance);
        }
        inner.odometry = &odometry;
    }
    Gravity gravity;
    if (options.gravity) {
        gravity.sigma = options.gravity->sigma;
        for (const int f : out.frames) {
            gravity.down.push_back(options.gravity->down[static_cast<size_t>(f)]);
        }
        inner.gravity = &gravity;
    }
    pf_camera central = camera;
    central.pupil_e1 = 0.0;
    if (!options.odometry) {
        table.shift_pupil(0.0);
    }
    Building building = options.method == Method::hierarchical ? Tree(table, central, inner).build()
                                                               : Chain(table, central, inner).build();
    trim(building.maps, table);
    if (options.shutter) { // the maps are built as if all rows were seen at once: near enough to start from
        Shutter shutter = *options.shutter;
        shutter.time.clear();
        for (const int f : out.frames) {
            shutter.time.push_back(options.shutter->time[static_cast<size_t>(f)]);
        }
        table.roll(shutter);
    }
    for (Submap &map : building.maps) {
        Segment segment;
        segment.map = std::move(map);
        try {
            if (finish(segment, table, camera, inner)) {
                out.segments.push_back(std::move(segment));
            }
        } catch (const std::domain_error &) {
            continue; // not determined: a gap, and the other segments stay
        }
    }
    out.gaps = gaps_between(out.segments, building.gaps, table.frames());
    return out;
}

} // namespace pipefish::sfm
