#include "sfm/submap.hpp"

#include "counter_random.hpp"
#include "geometry/minimal.hpp"
#include "geometry/triangulate.hpp"
#include "geometry/two_view.hpp"
#include "median.hpp"

#include <Eigen/Cholesky>

#include <algorithm>
#include <cmath>

namespace pipefish::sfm
{

namespace
{

using geometry::View;

constexpr uint64_t STREAM_LEAF = 10, STREAM_RESECT = 11;

// Calls body(place of the point in the map, observation) for each observation in `frame` of a track that has a point.
template <typename Body> void for_seen(const TrackTable &table, const Submap &map, int frame, const Body &body)
{
    const std::span<const int> seen = table.of_frame(frame);
    size_t p = 0;
    for (const int place : seen) {
        const Observation &o = table[place];
        while (p < map.tracks.size() && map.tracks[p] < o.track) {
            p++;
        }
        if (p < map.tracks.size() && map.tracks[p] == o.track) {
            body(p, o);
        }
    }
}

// Whitened error of a ray against a point, 2 degrees of freedom; large behind the eye.
double angular_squared(const Pose &pose, const Vector3d &x, const Sight &sight)
{
    const Vector3d y = (pose * x - sight.origin).normalized();
    if (!(y.dot(sight.ray) > 0.0)) {
        return 1e12;
    }
    const Vector3d across = y - sight.ray * y.dot(sight.ray);
    const Eigen::Matrix2d gram = sight.b.transpose() * sight.b;
    const Vector2d error = gram.inverse() * (sight.b.transpose() * across);
    return error.squaredNorm();
}

struct Seen {
    Vector3d point;
    const Sight *sight;
};

// Gauss-Newton on the pose with a Cauchy loss of 2 sigmas.
void refine_pose(Pose &pose, std::span<const Seen> seen, int steps)
{
    for (int step = 0; step < steps; step++) {
        Eigen::Matrix<double, 6, 6> h = Eigen::Matrix<double, 6, 6>::Zero();
        Eigen::Matrix<double, 6, 1> g = Eigen::Matrix<double, 6, 1>::Zero();
        for (const Seen &s : seen) {
            const Vector3d turned = pose.r * s.point, y = turned + pose.t - s.sight->origin;
            const double length = y.norm();
            const Vector3d d = y / length;
            if (!(d.dot(s.sight->ray) > 0.0)) {
                continue;
            }
            const Eigen::Matrix2d gram = s.sight->b.transpose() * s.sight->b;
            const Matrix23 whiten = gram.inverse() * s.sight->b.transpose();
            const Vector2d error = whiten * d;
            const Matrix23 by_y = whiten * (Matrix3d::Identity() - d * d.transpose()) / length;
            Eigen::Matrix<double, 2, 6> j;
            j << -by_y * geometry::cross_matrix(turned), by_y;
            const double weight = 1.0 / (1.0 + error.squaredNorm() / 4.0);
            h.noalias() += weight * j.transpose() * j;
            g.noalias() += weight * j.transpose() * error;
        }
        const Eigen::Matrix<double, 6, 1> delta = -h.ldlt().solve(g);
        if (!delta.allFinite()) {
            return;
        }
        const double turn = delta.head<3>().norm();
        pose.r = geometry::rotation_exp(delta.head<3>() * std::min(1.0, 0.5 / std::max(turn, 1e-12))) * pose.r;
        pose.t += delta.tail<3>();
        if (delta.head<3>().squaredNorm() < 1e-18) {
            return;
        }
    }
}

struct Fit {
    double cost = 0.0;
    size_t inliers = 0;
};

Fit judge(const Pose &pose, std::span<const Seen> seen, double limit)
{
    Fit fit;
    for (const Seen &s : seen) {
        const double d = angular_squared(pose, s.point, *s.sight);
        fit.cost += std::min(d, limit);
        fit.inliers += d < limit;
    }
    return fit;
}

// `rooms`: what the views' poses may be kept in.
std::vector<View> views_of(const Submap &map, const TrackTable &table, int track, std::vector<Pose> &rooms)
{
    std::vector<View> views;
    const std::span<const Observation> seen = table.of_track(track);
    rooms.resize(seen.size());
    for (size_t i = 0; i < seen.size(); i++) {
        if (map.has(seen[i].frame)) {
            views.push_back({&pose_of(map, table, seen[i], rooms[i]), &seen[i].sight});
        }
    }
    return views;
}

// Triangulates from all views; where they disagree, from all but the worst, while `min_views` remain.
std::optional<Vector3d> robust_point(std::vector<View> views, const Limits &limits, int min_views)
{
    while (views.size() >= static_cast<size_t>(min_views)) {
        double chi2 = 0.0;
        const std::optional<Vector3d> x = geometry::triangulate(views, 2, &chi2);
        size_t worst = 0;
        if (x) {
            double most = -1.0;
            for (size_t i = 0; i < views.size(); i++) {
                const double d = angular_squared(*views[i].pose, *x, *views[i].sight);
                if (d > most) {
                    most = d;
                    worst = i;
                }
            }
            if (most < 2.0 * limits.chi2) {
                return geometry::parallax(views, *x) >= limits.min_parallax ? x : std::nullopt;
            }
        }
        if (views.size() == 2) {
            return std::nullopt;
        }
        views.erase(views.begin() + static_cast<std::ptrdiff_t>(x ? worst : views.size() - 1));
    }
    return std::nullopt;
}

void set_points(Submap &map, std::vector<std::pair<int, Vector3d>> &points)
{
    std::sort(points.begin(), points.end(), [](const auto &a, const auto &b) { return a.first < b.first; });
    map.tracks.clear();
    map.points.clear();
    for (const auto &[track, point] : points) {
        map.tracks.push_back(track);
        map.points.push_back(point);
    }
}

} // namespace

const char *trouble_name(Trouble trouble)
{
    switch (trouble) {
    case Trouble::weak_texture:
        return "weak_texture";
    case Trouble::no_baseline:
        return "no_baseline";
    case Trouble::no_rigid_scene:
        return "no_rigid_scene";
    case Trouble::low_parallax:
        return "low_parallax";
    case Trouble::merge_failed:
        return "merge_failed";
    default:
        return "none";
    }
}

std::optional<Pose> resect(const TrackTable &table, const Submap &map, int frame, const std::optional<Pose> &guess,
                           const Limits &limits)
{
    std::vector<Seen> seen;
    for_seen(table, map, frame, [&](size_t p, const Observation &o) { seen.push_back({map.points[p], &o.sight}); });
    if (seen.size() < 8) {
        return std::nullopt;
    }
    const double limit = 2.0 * limits.chi2; // the points have errors of their own
    const auto enough = [&](const Fit &fit) { return fit.inliers >= 8 && 2 * fit.inliers >= seen.size(); };
    if (guess) {
        Pose pose = *guess;
        refine_pose(pose, seen, 10);
        const Fit fit = judge(pose, seen, limit);
        if (fit.inliers >= 8 && 10 * fit.inliers >= 7 * seen.size()) {
            return pose;
        }
    }
    Pose best;
    Fit best_fit{1e300, 0};
    double needed = 500.0;
    for (int iteration = 0; iteration < 500 && iteration < needed; iteration++) {
        std::array<Vector3d, 3> f, x;
        size_t sample[3];
        for (uint64_t k = 0, counter = 0; k < 3; k++) {
            do {
                const uint64_t stream = hash64(limits.seed, STREAM_RESECT, static_cast<uint64_t>(frame));
                const double u = uniform_of(hash64(stream, STREAM_RESECT, static_cast<uint64_t>(iteration), counter++));
                sample[k] = static_cast<size_t>(u * static_cast<double>(seen.size()));
            } while (std::find(sample, sample + k, sample[k]) != sample + k);
            f[k] = seen[sample[k]].sight->ray;
            x[k] = seen[sample[k]].point;
        }
        for (const Pose &candidate : geometry::three_point(f, x)) {
            const Fit fit = judge(candidate, seen, limit);
            if (fit.cost < best_fit.cost) {
                best = candidate;
                best_fit = fit;
                const double share = static_cast<double>(fit.inliers) / static_cast<double>(seen.size());
                const double miss = 1.0 - share * share * share;
                needed = miss <= 0.0 ? 10.0 : std::max(10.0, std::log(1e-3) / std::log(miss));
            }
        }
    }
    refine_pose(best, seen, 10);
    return enough(judge(best, seen, limit)) ? std::optional(best) : std::nullopt;
}

void fuse_points(Submap &map, const TrackTable &table, const Limits &limits, int min_views, int from, int to)
{
    std::vector<int> wanted;
    for (int frame = std::max(from, map.first); frame < std::min(to, map.end()); frame++) {
        for (const int place : table.of_frame(frame)) {
            wanted.push_back(table[place].track);
        }
    }
    std::sort(wanted.begin(), wanted.end());
    wanted.erase(std::unique(wanted.begin(), wanted.end()), wanted.end());
    std::vector<std::pair<int, Vector3d>> points;
    for (size_t p = 0; p < map.tracks.size(); p++) {
        if (!std::binary_search(wanted.begin(), wanted.end(), map.tracks[p])) {
            points.emplace_back(map.tracks[p], map.points[p]);
        }
    }
    std::vector<Pose> rooms;
    for (const int track : wanted) {
        std::vector<View> views = views_of(map, table, track, rooms);
        if (const auto x = robust_point(std::move(views), limits, min_views)) {
            points.emplace_back(track, *x);
        }
    }
    set_points(map, points);
}

void clean(Submap &map, const TrackTable &table, const pf_camera &camera, double gate, int min_views,
           const Limits &limits)
{
    size_t kept = 0;
    std::vector<View> views;
    std::vector<Pose> rooms;
    for (size_t p = 0; p < map.tracks.size(); p++) {
        views.clear();
        const std::span<const Observation> seen = table.of_track(map.tracks[p]);
        rooms.resize(seen.size());
        for (size_t i = 0; i < seen.size(); i++) {
            if (map.has(seen[i].frame)) {
                const Pose &pose = pose_of(map, table, seen[i], rooms[i]);
                if (reprojection_squared(camera, pose, map.points[p], seen[i]) < gate * gate) {
                    views.push_back({&pose, &seen[i].sight});
                }
            }
        }
        if (views.size() < static_cast<size_t>(min_views) ||
            geometry::parallax(views, map.points[p]) < limits.min_parallax) {
            continue;
        }
        map.tracks[kept] = map.tracks[p];
        map.points[kept++] = map.points[p];
    }
    map.tracks.resize(kept);
    map.points.resize(kept);
}

double robust_sigma(const Submap &map, const TrackTable &table, const pf_camera &camera)
{
    std::vector<double> squared;
    Pose room;
    for (size_t p = 0; p < map.tracks.size(); p++) {
        for (const Observation &o : table.of_track(map.tracks[p])) {
            if (map.has(o.frame)) {
                squared.push_back(reprojection_squared(camera, pose_of(map, table, o, room), map.points[p], o));
            }
        }
    }
    return std::sqrt(median_of(squared) / 1.38629436112); // the median of chi^2 with 2 degrees of freedom
}

Leaf make_leaf(const TrackTable &table, const pf_camera &camera, int first, int count, const Limits &limits)
{
    Leaf leaf;
    const int last = first + count - 1;
    std::vector<Sight> a, b;
    std::vector<int> track;
    table.for_pairs(first, last, [&](const Observation &x, const Observation &y) {
        a.push_back(x.sight);
        b.push_back(y.sight);
        track.push_back(x.track);
    });
    leaf.common = static_cast<int>(track.size());
    leaf.trouble = Trouble::weak_texture;
    if (leaf.common < limits.leaf_points) {
        return leaf;
    }
    geometry::TwoViewOptions options;
    options.seed = hash64(limits.seed, STREAM_LEAF, static_cast<uint64_t>(first), static_cast<uint64_t>(count));
    const geometry::TwoView pair = geometry::two_view(a, b, options);
    switch (pair.status) {
    case geometry::TwoViewStatus::no_baseline:
        leaf.trouble = Trouble::no_baseline;
        return leaf;
    case geometry::TwoViewStatus::behind:
        leaf.trouble = Trouble::no_rigid_scene;
        return leaf;
    case geometry::TwoViewStatus::too_few:
        leaf.trouble = Trouble::no_rigid_scene;
        return leaf;
    default:
        break;
    }
    // Points of the pair, then the frames between from them.
    Submap ends;
    ends.first = first;
    ends.poses.assign(static_cast<size_t>(count), Pose{});
    ends.poses.back() = pair.pose;
    std::vector<std::pair<int, Vector3d>> points;
    for (size_t i = 0; i < track.size(); i++) {
        if (pair.inlier[i]) {
            const View views[2] = {{&ends.poses.front(), &a[i]}, {&ends.poses.back(), &b[i]}};
            const auto x = geometry::triangulate(views);
            if (x && geometry::parallax(views, *x) >= limits.min_parallax) {
                points.emplace_back(track[i], *x);
            }
        }
    }
    set_points(ends, points);
    leaf.trouble = Trouble::low_parallax;
    if (static_cast<int>(points.size()) < limits.leaf_points) {
        return leaf;
    }
    leaf.trouble = Trouble::no_rigid_scene;
    const Vector3d turn = geometry::rotation_log(pair.pose.r);
    for (int k = 1; k + 1 < count; k++) {
        const double share = static_cast<double>(k) / (count - 1);
        const Pose guess{geometry::rotation_exp(share * turn), share * pair.pose.t};
        const auto pose = resect(table, ends, first + k, guess, limits);
        if (!pose) {
            return leaf;
        }
        ends.poses[static_cast<size_t>(k)] = *pose;
    }
    leaf.map = std::move(ends);
    fuse_points(leaf.map, table, limits, 3, first, last + 1);
    if (static_cast<int>(leaf.map.tracks.size()) < limits.leaf_points) {
        return leaf;
    }
    BundleOptions settings;
    settings.loss = {optim::RobustLoss::Kind::cauchy, 2.0};
    settings.max_iterations = 8;
    settings.cost_tolerance = 1e-3;
    settings.gate = 30.0;
    settings.min_views = 3;
    adjust(leaf.map, table, camera, settings);
    leaf.sigma = robust_sigma(leaf.map, table, camera);
    clean(leaf.map, table, camera, 3.5 * std::max(leaf.sigma, 0.5), 3, limits);
    // Of the tracks that agree in first and last frame: how many of all do is a matter of wrong matches, not of the
    // leaf.
    int seen_by_all = 0, measured = 0;
    std::vector<Pose> rooms;
    std::vector<double> angles;
    for (size_t i = 0; i < track.size(); i++) {
        const int t = track[i];
        if (!pair.inlier[i]) {
            continue;
        }
        const std::vector<View> views = views_of(leaf.map, table, t, rooms);
        if (static_cast<int>(views.size()) == count) {
            seen_by_all++;
            const auto at = std::lower_bound(leaf.map.tracks.begin(), leaf.map.tracks.end(), t);
            if (at != leaf.map.tracks.end() && *at == t) {
                measured++;
                const size_t p = static_cast<size_t>(at - leaf.map.tracks.begin());
                angles.push_back(geometry::parallax(views, leaf.map.points[p]));
            }
        }
    }
    if (static_cast<int>(leaf.map.tracks.size()) < limits.leaf_points || measured < limits.leaf_share * seen_by_all ||
        leaf.sigma > 3.0) {
        return leaf;
    }
    leaf.trouble = median_of(angles) < limits.leaf_parallax ? Trouble::low_parallax : Trouble::none;
    return leaf;
}

Similarity align(const Submap &a, const Submap &b)
{
    Similarity s;
    const int from = std::max(a.first, b.first), to = std::min(a.end(), b.end());
    Matrix3d sum = Matrix3d::Zero();
    for (int f = from; f < to; f++) {
        sum += a.pose(f).r.transpose() * b.pose(f).r;
    }
    s.r = geometry::nearest_rotation(sum);
    std::vector<double> ratio, spread;
    for (size_t i = 0, j = 0; i < a.tracks.size() && j < b.tracks.size();) {
        if (a.tracks[i] == b.tracks[j]) {
            for (int f = from; f < to; f++) {
                ratio.push_back(std::log((a.pose(f) * a.points[i]).norm() / (b.pose(f) * b.points[j]).norm()));
            }
            s.common++;
        }
        const bool step_i = a.tracks[i] <= b.tracks[j], step_j = b.tracks[j] <= a.tracks[i];
        i += step_i;
        j += step_j;
    }
    if (ratio.empty()) {
        return s;
    }
    const double log_scale = median_of(ratio);
    for (const double r : ratio) {
        spread.push_back(std::abs(r - log_scale));
    }
    s.scale = std::exp(log_scale);
    s.log_scale_sigma = 1.858 * median_of(spread) / std::sqrt(static_cast<double>(s.common));
    for (int f = from; f < to; f++) {
        s.t += (a.pose(f).centre() - s.scale * (s.r * b.pose(f).centre())) / (to - from);
    }
    return s;
}

void transform(Submap &map, const Similarity &s)
{
    for (Pose &pose : map.poses) {
        const Vector3d centre = s * pose.centre();
        pose.r = pose.r * s.r.transpose();
        pose.t = -pose.r * centre;
    }
    for (Vector3d &x : map.points) {
        x = s * x;
    }
}

std::optional<Submap> merge(const Submap &a, const Submap &b, const TrackTable &table, const pf_camera &camera,
                            const Limits &limits, Trouble &trouble)
{
    Similarity s = align(a, b);
    trouble = Trouble::weak_texture;
    if (s.common < limits.merge_points) {
        return std::nullopt;
    }
    Submap moved = b;
    transform(moved, s);
    // b's points in a's frames, where both must agree.
    int seen = 0;
    for (int f = std::max(a.first, b.first); f < std::min(a.end(), b.end()); f++) {
        for_seen(table, moved, f, [&](size_t p, const Observation &o) {
            seen++;
            s.consistent += reprojection_squared(camera, a.pose(f), moved.points[p], o) < 4.0 * limits.chi2;
        });
    }
    trouble = Trouble::merge_failed;
    if (s.consistent < limits.merge_share * seen) {
        return std::nullopt;
    }
    trouble = Trouble::none;
    Submap out = a;
    out.poses.insert(out.poses.end(), moved.poses.begin() + (a.end() - b.first), moved.poses.end());
    std::vector<std::pair<int, Vector3d>> points;
    for (size_t p = 0; p < a.tracks.size(); p++) {
        points.emplace_back(a.tracks[p], a.points[p]);
    }
    for (size_t p = 0; p < moved.tracks.size(); p++) {
        if (!std::binary_search(a.tracks.begin(), a.tracks.end(), moved.tracks[p])) {
            points.emplace_back(moved.tracks[p], moved.points[p]);
        }
    }
    set_points(out, points);
    // Tracks across the seam: again, from all their views.
    fuse_points(out, table, limits, 3, b.first, a.end());
    return out;
}

} // namespace pipefish::sfm
