// Stretches of frames: the smallest ones from three and more views, resection, merging.
#pragma once

#include "sfm/bundle.hpp"

#include <cstdint>
#include <optional>
#include <string>

namespace pipefish::sfm
{

// Why a stretch could not be measured.
enum class Trouble {
    none,
    weak_texture,   // too few tracks in common
    no_baseline,    // the camera stood or only turned
    no_rigid_scene, // the tracks agree with no motion: wrong profile, reversed rays, a scene that moves
    low_parallax,   // the motion is there, but the points' depths are not determined
    merge_failed,   // two halves that do not fit together
};
const char *trouble_name(Trouble trouble);

struct Limits {
    double chi2 = 9.21;           // of a view's whitened error, 2 degrees of freedom: 99 %
    int leaf_points = 25;         // points with at least three views that a leaf must have
    double leaf_share = 0.5;      // of the tracks seen in all its frames that agree in the first and the last
    double leaf_parallax = 0.035; // radians, median
    int wanted_common = 80;   // tracks common to first and last frame of a leaf: more frames while there are as many
    int longest_leaf = 6;     // frames
    int merge_points = 15;    // common points that two submaps must have
    double merge_share = 0.6; // of them consistent
    double min_parallax = 0.0262; // radians (1.5 degrees): points with less are dropped
    uint64_t seed = 0;
};

struct Leaf {
    Submap map;
    Trouble trouble = Trouble::none;
    int common = 0;     // tracks in first and last frame
    double sigma = 0.0; // robust, of the whitened residuals
};

// A map of frames first .. first + count - 1 (count >= 3), the distance from its first to its last frame 1.
Leaf make_leaf(const TrackTable &table, const pf_camera &camera, int first, int count, const Limits &limits);

// Pose of a frame from the points of a map; from `guess` where that fits, else by three-point samples. Nothing where
// fewer than 8 points, or less than half, agree.
std::optional<Pose> resect(const TrackTable &table, const Submap &map, int frame, const std::optional<Pose> &guess,
                           const Limits &limits);

// Adds points for tracks that have none and are seen in at least `min_views` frames from `from` on, and triangulates
// again those that have; drops what does not fit. Views further off than the limit are ignored in deciding.
void fuse_points(Submap &map, const TrackTable &table, const Limits &limits, int min_views, int from, int to);

// Drops points with fewer than `min_views` views within `gate` sigmas, behind an eye, or with too little parallax.
void clean(Submap &map, const TrackTable &table, const pf_camera &camera, double gate, int min_views,
           const Limits &limits);

// Robust standard deviation of the map's whitened residuals, per coordinate.
double robust_sigma(const Submap &map, const TrackTable &table, const pf_camera &camera);

struct Similarity {
    double scale = 1.0;
    Matrix3d r = Matrix3d::Identity();
    Vector3d t = Vector3d::Zero();
    double log_scale_sigma = 0.0; // of the scale: what a merge adds to the drift
    int common = 0, consistent = 0;

    Vector3d operator*(const Vector3d &x) const { return scale * (r * x) + t; }
};

// Takes b's frame to a's, from shared frames (>= 2) and common points.
Similarity align(const Submap &a, const Submap &b);
void transform(Submap &map, const Similarity &s);

// b goes on where a ends, with two frames in common at least. `trouble` says why not.
std::optional<Submap> merge(const Submap &a, const Submap &b, const TrackTable &table, const pf_camera &camera,
                            const Limits &limits, Trouble &trouble);

} // namespace pipefish::sfm
