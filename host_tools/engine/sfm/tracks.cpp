#include "sfm/tracks.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace pipefish::sfm
{

double sag_of(double first, double now, double f)
{
    const auto potential = [](double theta) {
        const double t = std::clamp(theta, 0.2, 2.9); // nearer to the axis nothing is tracked over any angle
        return std::cos(t) / std::sin(t) + 2.0 * t;
    };
    return (potential(first) - potential(now)) / f;
}

TrackTable::TrackTable(const pf_camera &camera, int frames, int tracks, std::span<const int> frame,
                       std::span<const int> track, const double *uv, const double *covariance, double sigma)
    : pupil_(camera.pupil_e1)
{
    all_.reserve(frame.size());
    for (size_t i = 0; i < frame.size(); i++) {
        const Sight sight = geometry::make_sight(camera, uv + 2 * i, covariance ? covariance + 4 * i : nullptr, sigma);
        if (!sight.valid) {
            outside_++;
            continue;
        }
        all_.push_back({frame[i], track[i], sight, sight.root.inverse()});
    }
    const auto before = [](const Observation &a, const Observation &b) {
        return a.track != b.track ? a.track < b.track : a.frame < b.frame;
    };
    if (!std::is_sorted(all_.begin(), all_.end(), before)) {
        std::stable_sort(all_.begin(), all_.end(), before);
    }
    const auto same = [](const Observation &a, const Observation &b) {
        return a.track == b.track && a.frame == b.frame;
    };
    const auto end = std::unique(all_.begin(), all_.end(), same);
    repeated_ = static_cast<int>(all_.end() - end);
    all_.erase(end, all_.end());
    index(frames, tracks);
}

TrackTable TrackTable::only(std::span<const int> kept) const
{
    std::vector<int> number(by_frame_.size(), -1);
    for (size_t i = 0; i < kept.size(); i++) {
        number[static_cast<size_t>(kept[i])] = static_cast<int>(i);
    }
    TrackTable out;
    for (const Observation &o : all_) {
        if (number[static_cast<size_t>(o.frame)] >= 0) {
            out.all_.push_back(o);
            out.all_.back().frame = number[static_cast<size_t>(o.frame)];
        }
    }
    out.index(static_cast<int>(kept.size()), tracks());
    out.pupil_ = pupil_;
    out.outside_ = outside_;
    out.repeated_ = repeated_;
    return out;
}

void TrackTable::index(int frames, int tracks)
{
    by_frame_.assign(static_cast<size_t>(frames), {});
    begin_.assign(static_cast<size_t>(tracks) + 1, all_.size());
    for (size_t i = all_.size(); i-- > 0;) {
        begin_[static_cast<size_t>(all_[i].track)] = i;
    }
    for (size_t k = begin_.size() - 1; k-- > 0;) {
        begin_[k] = std::min(begin_[k], begin_[k + 1]);
    }
    for (size_t i = 0; i < all_.size(); i++) {
        by_frame_[static_cast<size_t>(all_[i].frame)].push_back(static_cast<int>(i));
    }
}

void TrackTable::roll(const Shutter &shutter)
{
    time_ = shutter.time;
    for (Observation &o : all_) {
        o.late = shutter.line_time * (o.sight.uv.y() - shutter.middle_row);
    }
}

void TrackTable::shift_pupil(double e1)
{
    if (e1 == pupil_) {
        return;
    }
    pupil_ = e1;
    for (Observation &o : all_) {
        const double theta = polar_angle(o.sight.ray);
        o.sight.origin = {0.0, 0.0, e1 * theta * theta};
    }
}

Moment moment_of(double late, int frame, int first, int end, std::span<const double> time)
{
    int other = late < 0.0 ? frame - 1 : frame + 1;
    if (other < first || other >= end) {
        other = 2 * frame - other;
    }
    const double apart = time[static_cast<size_t>(other)] - time[static_cast<size_t>(frame)];
    const bool known = std::isfinite(apart) && (other > frame ? apart > 0.0 : apart < 0.0);
    return {other, known ? late / apart : 0.0};
}

} // namespace pipefish::sfm
