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

// How far the points are off the camera's way, median, in the map's unit.
double wall_radius(const Submap &map, const TrackTable &table)
{
    std::vector<double> away;
    for (size_t p = 0; p < map.tracks.size(); p++) {
        const std::span<const Observation> seen = table.of_track(map.tracks[p]);
        const auto last =
            std::find_if(seen.rbegin(), seen.rend(), [&](const Observation &o) { return map.has(o.frame); });
        if (last == seen.rend()) {
            continue;
        }
        const Vector3d before = map.pose(std::max(last->frame - 1, map.first)).centre();
        const Vector3d after = map.pose(std::min(last->frame + 1, map.end() - 1)).centre();
        const Vector3d ahead = (after - before).stableNormalized();
        away.push_back(ahead.cross(map.points[p] - map.pose(last->frame).centre()).norm());
    }
    return away.empty() ? 0.0 : median_of(away);
}

} // namespace

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
