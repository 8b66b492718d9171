#include "sfm/pupil.hpp"

#include "median.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::sfm
{

namespace
{

// Of a pipe that nobody said anything of, metres; and how far the wall's distance in a map may be off what it is taken
// for, relative: drifts of its scale, nominal diameters, what has grown on the wall.
constexpr double RADIUS = 0.15, RADIUS_SIGMA = 1.0, KNOWN_RADIUS_SIGMA = 0.2;

constexpr size_t LEAST = 5; // points that tell how wide the pipe is at a frame

// Where a point is beside the camera's way: by the frame that saw it last, -1 where none of the map's did.
struct Beside {
    int frame;
    double away;
};

std::vector<Beside> beside_the_way(const Submap &map, const TrackTable &table)
{
    std::vector<Beside> out;
    for (size_t p = 0; p < map.tracks.size(); p++) {
        const std::span<const Observation> seen = table.of_track(map.tracks[p]);
        const auto last =
            std::find_if(seen.rbegin(), seen.rend(), [&](const Observation &o) { return map.has(o.frame); });
        if (last == seen.rend()) {
            out.push_back({-1, 0.0});
            continue;
        }
        const Vector3d before = map.pose(std::max(last->frame - 1, map.first)).centre();
        const Vector3d after = map.pose(std::min(last->frame + 1, map.end() - 1)).centre();
        const Vector3d ahead = (after - before).stableNormalized();
        out.push_back({last->frame - map.first, ahead.cross(map.points[p] - map.pose(last->frame).centre()).norm()});
    }
    return out;
}

// How far the points are off the camera's way, median, in the map's unit.
double wall_radius(const Submap &map, const TrackTable &table)
{
    std::vector<double> away;
    for (const Beside &point : beside_the_way(map, table)) {
        if (point.frame >= 0) {
            away.push_back(point.away);
        }
    }
    return away.empty() ? 0.0 : median_of(away);
}

// The same at each frame; where too few points tell it, as at the frame before.
std::vector<double> radius_along(const std::vector<Beside> &points, size_t frames, double everywhere)
{
    std::vector<std::vector<double>> away(frames);
    for (const Beside &point : points) {
        if (point.frame >= 0) {
            away[static_cast<size_t>(point.frame)].push_back(point.away);
        }
    }
    std::vector<double> radius(frames, everywhere);
    for (size_t f = 0; f < frames; f++) {
        if (away[f].size() >= LEAST) {
            radius[f] = std::max(median_of(away[f]), 1e-6 * everywhere);
        } else if (f > 0) {
            radius[f] = radius[f - 1];
        }
    }
    return radius;
}

// By how much the logarithm of the radius grows for each radius of the way; way (n,) in radii. Theil's median of the
// slopes between either half: a reducer or a wide chamber on the way has no say.
double taper(const std::vector<double> &radius, const std::vector<double> &way)
{
    std::vector<double> slopes;
    const size_t half = radius.size() / 2;
    for (size_t f = 0; f + half < radius.size(); f++) {
        if (way[f + half] > way[f]) {
            slopes.push_back(std::log(radius[f + half] / radius[f]) / (way[f + half] - way[f]));
        }
    }
    return slopes.empty() ? 0.0 : median_of(slopes);
}

} // namespace

void straighten(Submap &map, const TrackTable &table)
{
    const std::vector<Beside> points = beside_the_way(map, table);
    const double everywhere = wall_radius(map, table);
    if (!(everywhere > 0.0)) {
        return;
    }
    const size_t frames = map.poses.size();
    const std::vector<double> radius = radius_along(points, frames, everywhere);
    std::vector<Vector3d> old, centre;
    std::vector<double> way{0.0};
    for (const Pose &pose : map.poses) {
        old.push_back(pose.centre());
    }
    for (size_t f = 0; f + 1 < frames; f++) {
        way.push_back(way[f] + (old[f + 1] - old[f]).norm() / std::sqrt(radius[f] * radius[f + 1]));
    }
    const double rate = taper(radius, way);
    centre.push_back(old.front());
    for (size_t f = 0; f + 1 < frames; f++) {
        centre.push_back(centre[f] + (old[f + 1] - old[f]) * std::exp(-0.5 * rate * (way[f] + way[f + 1])));
    }
    const double length = (centre.back() - centre.front()).norm(), before = (old.back() - old.front()).norm();
    const double scale = length > 0.0 ? before / length : 1.0;
    const Vector3d start = old.front();
    for (size_t p = 0; p < points.size(); p++) {
        if (points[p].frame >= 0) {
            const size_t f = static_cast<size_t>(points[p].frame);
            const Vector3d there = centre[f] + (map.points[p] - old[f]) * std::exp(-rate * way[f]);
            map.points[p] = start + scale * (there - start);
        }
    }
    for (size_t f = 0; f < frames; f++) {
        Pose &pose = map.poses[f];
        pose.t = -pose.r * (start + scale * (centre[f] - start));
    }
}

bool is_unread(const Submap &map, const TrackTable &table, const Odometry &odometry)
{
    double run = 0.0, longest = 0.0;
    for (int f = map.first; f + 1 < map.end(); f++) {
        const bool read = std::isfinite(odometry.step[static_cast<size_t>(f)]);
        run = read ? 0.0 : run + (map.pose(f + 1).centre() - map.pose(f).centre()).norm();
        longest = std::max(longest, run);
    }
    return longest > wall_radius(map, table);
}

void guess_pupil(BundleOptions &settings, const Submap &map, const TrackTable &table, const pf_camera &camera,
                 double pupil_sigma, double pipe_radius)
{
    const double radius = wall_radius(map, table);
    if (!(pupil_sigma > 0.0 && radius > 0.0)) {
        return;
    }
    const bool known = pipe_radius > 0.0;
    const double unit = radius / (known ? pipe_radius : RADIUS); // a metre in the map's units
    settings.pupil = unit * camera.pupil_e1;
    settings.pupil_sigma =
        unit * std::hypot(pupil_sigma, (known ? KNOWN_RADIUS_SIGMA : RADIUS_SIGMA) * camera.pupil_e1);
}

} // namespace pipefish::sfm
