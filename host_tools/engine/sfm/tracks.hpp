// Observations of tracks, as reconstruction reads them.
#pragma once

#include "geometry/sight.hpp"

#include <cmath>
#include <cstdint>
#include <span>
#include <vector>

namespace pipefish::sfm
{

using geometry::Matrix23;
using geometry::Matrix32;
using geometry::Matrix3d;
using geometry::Pose;
using geometry::Sight;
using geometry::Vector2d;
using geometry::Vector3d;

struct Observation {
    int frame, track;
    Sight sight;
    Eigen::Matrix2d whiten; // of a pixel error: root^-1
    double late = 0.0;      // seconds after its frame's time: of its row, where the shutter rolls
};

// A rolling shutter exposes row v line_time (v - middle_row) after the frame's time.
struct Shutter {
    std::vector<double> time; // of each frame, seconds; NaN where unknown
    double line_time = 0.0;   // seconds, below 0 from the last row upwards
    double middle_row = 0.0;
};

// When an observation was made, on the way from its frame to a neighbour.
struct Moment {
    int other;    // frame
    double share; // of the way there; below 0: on the other side of its frame
};

// Of what was seen `late` seconds after `frame`, among frames first .. end - 1 (two at least) with these times:
// towards the neighbour on whose side it was, or away from the only one. Where a time is not known the share is 0.
Moment moment_of(double late, int frame, int first, int end, std::span<const double> time);

// A window that is fitted by an affine map, as trackers do, follows the mean of the motion over it, which is its
// centre's only where the motion has no curvature. In a tube, seen along its axis, the polar angle moves by
// sin(theta)^2 times the distance driven over the radius, whose second derivative pulls the window by half its second
// moment each step. Summed up from the track's first sight to now: moment / f (E(first) - E(now)) outwards, E =
// cot(theta) + 2 theta. All tracks share it, so that it does not average out: it bends the scale along the pipe.
// Radians to px per px^2 of the moment, for a lens of f pixels a radian.
double sag_of(double first, double now, double f);

// Of a ray from the axis, radians.
inline double polar_angle(const Vector3d &ray)
{
    return std::atan2(ray.head<2>().norm(), ray.z());
}

// What the sag's three parts, px^2, do to a pixel that is off by `sag` for each px^2: all around alike, and along the
// image's axes and its diagonals. They are the window's second moment as a tensor: along a radius at phi it is
// a + b cos 2 phi + c sin 2 phi, and a pipe whose tracks have more of it to the sides than up and down comes out oval.
inline Eigen::Matrix<double, 2, 3> sag_columns(const Vector2d &sag)
{
    const double square = std::max(sag.squaredNorm(), 1e-300);
    Eigen::Matrix<double, 2, 3> out;
    out << sag, sag * ((sag[0] * sag[0] - sag[1] * sag[1]) / square), sag * (2.0 * sag[0] * sag[1] / square);
    return out;
}

// Sorted by track, then frame; at most one observation a track and frame, all of them inside the camera's model.
class TrackTable
{
public:
    // `frame`, `track`: n, any order, 0 <= frame < frames, 0 <= track < tracks.
    TrackTable(const pf_camera &camera, int frames, int tracks, std::span<const int> frame, std::span<const int> track,
               const double *uv, const double *covariance, double sigma);

    // The same observations in frames `kept` only (ascending), numbered in their order.
    TrackTable only(std::span<const int> kept) const;

    int frames() const { return static_cast<int>(by_frame_.size()); }
    int tracks() const { return static_cast<int>(begin_.size()) - 1; }
    std::span<const Observation> observations() const { return all_; }
    std::span<const Observation> of_track(int track) const
    {
        const size_t from = begin_[static_cast<size_t>(track)];
        return {all_.data() + from, begin_[static_cast<size_t>(track) + 1] - from};
    }
    // Places in observations(), by track.
    std::span<const int> of_frame(int frame) const { return by_frame_[static_cast<size_t>(frame)]; }
    const Observation &operator[](int place) const { return all_[static_cast<size_t>(place)]; }

    int outside() const { return outside_; }   // observations left out: beyond the model
    int repeated() const { return repeated_; } // observations left out: their track was there already in their frame

    // From here on rows count. `shutter`: by frame of this table.
    void roll(const Shutter &shutter);
    // From here on rays start where a pupil that shifts by e1 lets them; in the unit of what they are to meet.
    void shift_pupil(double e1);
    bool rolls() const { return !time_.empty(); }
    Moment moment(const Observation &o, int first, int end) const
    {
        return moment_of(o.late, o.frame, first, end, time_);
    }

    // Calls body(first, second) with the observations of each track that two frames share.
    template <typename Body> void for_pairs(int first, int second, const Body &body) const
    {
        const std::span<const int> a = of_frame(first), b = of_frame(second);
        for (size_t i = 0, j = 0; i < a.size() && j < b.size();) {
            const Observation &x = (*this)[a[i]], &y = (*this)[b[j]];
            if (x.track == y.track) {
                body(x, y);
            }
            i += x.track <= y.track;
            j += y.track <= x.track;
        }
    }

private:
    TrackTable() = default;
    void index(int frames, int tracks);

    std::vector<Observation> all_;
    std::vector<size_t> begin_; // of each track
    std::vector<std::vector<int>> by_frame_;
    std::vector<double> time_; // of each frame, where rows count
    double pupil_ = 0.0;       // e1 by which the rays start
    int outside_ = 0, repeated_ = 0;
};

} // namespace pipefish::sfm
