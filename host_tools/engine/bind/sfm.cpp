// Two views and whole reconstructions for Python; pipefish.twoview.py and pipefish/structure.py check the arguments.
#include "arrays.hpp"
#include "geometry/between.hpp"
#include "geometry/minimal.hpp"
#include "geometry/two_view.hpp"
#include "pipefish/profile.h"
#include "sfm/reconstruct.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace nb = nanobind;
namespace geometry = pipefish::geometry;
namespace sfm = pipefish::sfm;

void bind_sfm(nb::module_ &m);

namespace
{

using Pixels = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Triples = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const int, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Square = nb::ndarray<const double, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Jacobians = nb::ndarray<const double, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Matrix34 = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;
using Poses = nb::ndarray<const double, nb::shape<-1, 3, 4>, nb::c_contig, nb::device::cpu>;
using Covariances = nb::ndarray<const double, nb::shape<-1, 2, 2>, nb::c_contig, nb::device::cpu>;

const char *status_name(geometry::TwoViewStatus status)
{
    switch (status) {
    case geometry::TwoViewStatus::ok:
        return "ok";
    case geometry::TwoViewStatus::plane:
        return "plane";
    case geometry::TwoViewStatus::no_baseline:
        return "no_baseline";
    case geometry::TwoViewStatus::behind:
        return "behind";
    default:
        return "too_few";
    }
}

// As many rows as `count`, where they are given.
template <typename Rows> void require_rows(const std::optional<Rows> &rows, size_t count, const char *otherwise)
{
    require(!rows || rows->shape(0) == count, otherwise);
}

// Observations that a TrackTable can hold.
void check_tracks(int frames, int tracks, const Indices &frame, const Indices &track, const Pixels &uv,
                  const std::optional<Covariances> &covariance)
{
    const size_t n = frame.shape(0);
    require(frames >= 0 && tracks >= 0, "frames and tracks: below 0");
    require(track.shape(0) == n && uv.shape(0) == n, "frame, track and uv: must be as long as each other");
    require_rows(covariance, n, "covariance: not one for each observation");
    require(all_within(frame, 0, frames - 1.0), "frame: no such frame");
    require(all_within(track, 0, tracks - 1.0), "track: no such track");
}

nb::dict two_view(const pf_profile &first, const pf_profile &second, const Pixels &uv1, const Pixels &uv2,
                  const std::optional<Covariances> &covariance1, const std::optional<Covariances> &covariance2,
                  double sigma, uint64_t seed)
{
    require(uv2.shape(0) == uv1.shape(0), "uv1 and uv2: must be as long as each other");
    require_rows(covariance1, uv1.shape(0), "covariance1: not one for each pixel");
    require_rows(covariance2, uv2.shape(0), "covariance2: not one for each pixel");
    geometry::TwoView found;
    {
        const nb::gil_scoped_release release;
        const auto sights = [sigma](const pf_profile &profile, const Pixels &uv, const std::optional<Covariances> &c) {
            return geometry::make_sights(profile.camera, uv.shape(0), uv.data(), c ? c->data() : nullptr, sigma);
        };
        geometry::TwoViewOptions options;
        options.seed = seed;
        found = geometry::two_view(sights(first, uv1, covariance1), sights(second, uv2, covariance2), options);
    }
    nb::dict out;
    out["status"] = status_name(found.status);
    out["rotation"] = matrix_to_numpy(found.pose.r);
    out["direction"] = to_numpy<double>(found.pose.t.data(), {3});
    out["inlier"] = to_numpy<bool>(found.inlier.data(), {found.inlier.size()});
    out["iterations"] = found.iterations;
    out["sigma"] = found.sigma;
    out["median_parallax"] = found.median_parallax;
    Eigen::Matrix<double, 6, 5> spread = Eigen::Matrix<double, 6, 5>::Zero();
    spread.topLeftCorner<3, 3>().setIdentity();
    spread.bottomRightCorner<3, 2>() = found.direction_basis;
    out["covariance"] = matrix_to_numpy(spread * found.covariance * spread.transpose());
    return out;
}

geometry::Pose pose_at(const Poses &poses, size_t i)
{
    const Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> m(poses.data() + 12 * i);
    return {m.leftCols<3>(), m.col(3)};
}

template <size_t N> std::array<geometry::Vector3d, N> vectors(const Triples &rows)
{
    require(rows.shape(0) == N, "wrong number of vectors");
    std::array<geometry::Vector3d, N> out;
    for (size_t i = 0; i < N; i++) {
        out[i] = {rows.data()[3 * i], rows.data()[3 * i + 1], rows.data()[3 * i + 2]};
    }
    return out;
}

Array<double> sampson_squared(const pf_profile &profile, const Matrix34 &pose, const Pixels &uv1, const Pixels &uv2,
                              double sigma)
{
    const Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> m(pose.data());
    const geometry::Pose relative{m.leftCols<3>(), m.col(3)};
    const size_t n = uv1.shape(0);
    require(uv2.shape(0) == n, "uv1 and uv2: must be as long as each other");
    const auto a = geometry::make_sights(profile.camera, n, uv1.data(), nullptr, sigma);
    const auto b = geometry::make_sights(profile.camera, n, uv2.data(), nullptr, sigma);
    std::vector<double> out(n);
    for (size_t i = 0; i < n; i++) {
        out[i] = geometry::sampson_squared(relative, a[i], b[i]);
    }
    return to_numpy(std::move(out), {n});
}

Array<double> row_poses(const Poses &poses, const Indices &segment, const Values &time, const Indices &place,
                        const Values &late)
{
    const int frames = static_cast<int>(poses.shape(0));
    const size_t n = place.shape(0);
    require(segment.shape(0) == poses.shape(0) && time.shape(0) == poses.shape(0) && late.shape(0) == n,
            "not one segment and time a pose, or not one time a place");
    require(std::is_sorted(segment.data(), segment.data() + frames), "segment: not in order");
    require(all_within(place, 0, frames - 1.0), "place: no such frame");
    std::vector<double> out(12 * n);
    for (size_t i = 0; i < n; i++) {
        const int frame = place.data()[i];
        const auto range = std::equal_range(segment.data(), segment.data() + frames, segment.data()[frame]);
        const int first = static_cast<int>(range.first - segment.data());
        const int end = static_cast<int>(range.second - segment.data());
        geometry::Pose pose = pose_at(poses, static_cast<size_t>(frame));
        if (end - first > 1) {
            const sfm::Moment moment = sfm::moment_of(late.data()[i], frame, first, end, {time.data(), time.shape(0)});
            pose = geometry::pose_between(pose, pose_at(poses, static_cast<size_t>(moment.other)), moment.share);
        }
        Eigen::Map<Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> row(out.data() + 12 * i);
        row << pose.r, pose.t;
    }
    return to_numpy(std::move(out), {n, 3, 4});
}

// (m,m) covariance of m linear functions of points: jacobian (m, n, 3) of points (n,).
Array<double> functions(const sfm::BundleCovariance &covariance, const Indices &points, const Jacobians &jacobian)
{
    const size_t m = jacobian.shape(0), n = points.shape(0);
    require(jacobian.shape(1) == n, "jacobian: not one column for each point");
    require(all_within(points, 0, static_cast<double>(covariance.points().size()) - 1), "points: no such point");
    std::vector<sfm::BundleCovariance::Solver::MatrixEG> a(n);
    for (size_t k = 0; k < n; k++) {
        a[k].resize(3, static_cast<Eigen::Index>(m));
        for (size_t row = 0; row < m; row++) {
            const double *from = jacobian.data() + 3 * (row * n + k);
            a[k].col(static_cast<Eigen::Index>(row)) << from[0], from[1], from[2];
        }
    }
    return matrix_to_numpy(covariance.functions({points.data(), n}, a));
}

Array<double> pose_covariances(const sfm::BundleCovariance &covariance)
{
    std::vector<double> flat;
    for (size_t f = 0; f < covariance.frames(); f++) { // symmetric: the order of storage does not matter
        flat.insert(flat.end(), covariance.pose(f).data(), covariance.pose(f).data() + 36);
    }
    return to_numpy(std::move(flat), {covariance.frames(), 6, 6});
}

Array<double> point_covariances(const sfm::BundleCovariance &covariance)
{
    std::vector<double> flat;
    for (const geometry::Matrix3d &m : covariance.points()) {
        flat.insert(flat.end(), m.data(), m.data() + 9);
    }
    return to_numpy(std::move(flat), {covariance.points().size(), 3, 3});
}

// Poses (K,3,4), points (N,3) and their tracks (N,).
void add_map(const sfm::Submap &map, nb::dict &out)
{
    std::vector<double> poses, points;
    for (const geometry::Pose &pose : map.poses) {
        for (Eigen::Index row = 0; row < 3; row++) {
            poses.insert(poses.end(), {pose.r(row, 0), pose.r(row, 1), pose.r(row, 2), pose.t[row]});
        }
    }
    for (const geometry::Vector3d &x : map.points) {
        points.insert(points.end(), x.data(), x.data() + 3);
    }
    out["first"] = map.first;
    out["poses"] = to_numpy(std::move(poses), {map.poses.size(), 3, 4});
    out["points"] = to_numpy(std::move(points), {map.points.size(), 3});
    out["tracks"] = to_numpy<int>(map.tracks.data(), {map.tracks.size()});
}

nb::dict segment_dict(sfm::Segment &segment)
{
    nb::dict out;
    add_map(segment.map, out);
    out["drift"] = nb::none();
    if (segment.drift.camera.size() > 0) {
        nb::dict drift;
        add_map(segment.drift.map, drift);
        drift["camera"] =
            to_numpy<double>(segment.drift.camera.data(), {static_cast<size_t>(segment.drift.camera.size())});
        drift["covariance"] = matrix_to_numpy(segment.drift.covariance);
        out["drift"] = drift;
    }
    const bool uncertain = !segment.total.empty();
    out["random"] = nb::cast(std::move(segment.random));
    out["total"] = uncertain ? nb::cast(std::move(segment.total)) : nb::object(nb::none());
    out["metric"] = segment.metric;
    out["sigma"] = segment.sigma;
    out["scale_sigma"] = segment.scale_sigma;
    out["variance_factor"] = segment.report.variance_factor;
    out["observations"] = segment.report.observations;
    out["noise"] = segment.noise;
    out["cost"] = segment.report.cost;
    out["iterations"] = segment.iterations;
    out["converged"] = segment.report.summary.status == pipefish::optim::Status::converged;
    out["wheel"] = segment.report.wheel;
    out["sag"] = to_numpy<double>(segment.report.sag.data(), {3});
    out["pupil"] = segment.report.pupil;
    out["frees_pupil"] = segment.frees_pupil;
    out["late"] = segment.late;
    out["late_sigma"] = segment.late_sigma;
    out["down"] = to_numpy<double>(segment.report.down.data(), {3});
    out["camera"] = to_numpy<double>(segment.report.camera.data(), {static_cast<size_t>(segment.report.camera.size())});
    return out;
}

// Adjusts given poses (K,3,4) and points (N,3), which tracks 0..N-1 see: first pose and the distance to the last held.
nb::dict adjust(const pf_profile &profile, const Poses &poses, const Triples &points, const Indices &frame,
                const Indices &track, const Pixels &uv, double sigma, int max_iterations)
{
    const int frames = static_cast<int>(poses.shape(0)), tracks = static_cast<int>(points.shape(0));
    require(frames >= 2, "poses: fewer than two");
    check_tracks(frames, tracks, frame, track, uv, std::nullopt);
    const sfm::TrackTable table(profile.camera, frames, tracks, {frame.data(), frame.shape(0)},
                                {track.data(), track.shape(0)}, uv.data(), nullptr, sigma);
    sfm::Submap map;
    for (int f = 0; f < frames; f++) {
        map.poses.push_back(pose_at(poses, static_cast<size_t>(f)));
    }
    for (int t = 0; t < tracks; t++) {
        map.tracks.push_back(t);
        map.points.emplace_back(points.data()[3 * t], points.data()[3 * t + 1], points.data()[3 * t + 2]);
    }
    sfm::BundleOptions options;
    options.max_iterations = max_iterations;
    sfm::Segment segment;
    segment.report = sfm::adjust(map, table, profile.camera, options, &segment.random);
    segment.iterations = segment.report.summary.iterations;
    segment.map = std::move(map);
    return segment_dict(segment);
}

struct Extras { // what may be known beside the tracks
    sfm::Odometry odometry;
    sfm::Gravity gravity;
    sfm::CameraPrior camera, drift;
    sfm::Shutter shutter;
};

// Null where there is no covariance.
const sfm::CameraPrior *prior_of(const std::vector<uint32_t> &parameters, const std::optional<Square> &covariance,
                                 sfm::CameraPrior &room)
{
    if (!covariance) {
        return nullptr;
    }
    const Eigen::Index n = static_cast<Eigen::Index>(parameters.size());
    require(covariance->shape(0) == parameters.size() && covariance->shape(1) == parameters.size(),
            "not a row and a column of covariance for each parameter");
    require(std::all_of(parameters.begin(), parameters.end(), [](uint32_t p) { return p < PF_CAMERA_PARAMS; }),
            "no such parameter of a camera");
    room = sfm::CameraPrior(parameters, Eigen::Map<const Eigen::MatrixXd>(covariance->data(), n, n));
    return &room;
}

nb::dict reconstruct(const pf_profile &profile, int frames, int tracks, const Indices &frame, const Indices &track,
                     const Pixels &uv, const std::optional<Covariances> &covariance, double sigma,
                     const std::string &method, uint64_t seed, int threads, double still,
                     const std::optional<Values> &step, const std::optional<Values> &step_sigma, double scale_sigma,
                     const std::optional<Triples> &down, double down_sigma, const std::vector<uint32_t> &uncertain,
                     const std::optional<Square> &uncertainty, const std::vector<uint32_t> &drifting,
                     const std::optional<Square> &drift, double drift_noise, bool common_errors, double sag_sigma,
                     const std::optional<Values> &frame_time, double line_time, double middle_row, double pupil_sigma,
                     double radius)
{
    check_tracks(frames, tracks, frame, track, uv, covariance);
    const size_t count = static_cast<size_t>(frames);
    require_rows(step, count, "step: not one for each frame");
    require_rows(step_sigma, count, "step_sigma: not one for each frame");
    require_rows(down, count, "down: not one for each frame");
    require_rows(frame_time, count, "frame_time: not one for each frame");
    Extras extras;
    sfm::ReconstructOptions options;
    options.method = method == "incremental" ? sfm::Method::incremental : sfm::Method::hierarchical;
    options.limits.seed = seed;
    options.threads = threads;
    options.still = still;
    options.sag_sigma = sag_sigma;
    options.pupil_sigma = pupil_sigma;
    options.radius = radius;
    if (step && step_sigma) {
        extras.odometry.step.assign(step->data(), step->data() + step->shape(0));
        extras.odometry.sigma.assign(step_sigma->data(), step_sigma->data() + step_sigma->shape(0));
        extras.odometry.scale_sigma = scale_sigma;
        options.odometry = &extras.odometry;
    }
    if (down) {
        for (size_t i = 0; i < down->shape(0); i++) {
            extras.gravity.down.emplace_back(down->data()[3 * i], down->data()[3 * i + 1], down->data()[3 * i + 2]);
        }
        extras.gravity.sigma = down_sigma;
        options.gravity = &extras.gravity;
    }
    options.camera_prior = prior_of(uncertain, uncertainty, extras.camera);
    options.drift_prior = prior_of(drifting, drift, extras.drift);
    options.drift_noise = drift_noise;
    options.common_errors = common_errors;
    if (frame_time) {
        extras.shutter.time.assign(frame_time->data(), frame_time->data() + frame_time->shape(0));
        extras.shutter.line_time = line_time;
        extras.shutter.middle_row = middle_row;
        options.shutter = &extras.shutter;
    }
    sfm::Reconstruction found;
    int outside = 0, repeated = 0;
    {
        const nb::gil_scoped_release release;
        sfm::TrackTable table(profile.camera, frames, tracks, {frame.data(), frame.shape(0)},
                              {track.data(), track.shape(0)}, uv.data(), covariance ? covariance->data() : nullptr,
                              sigma);
        outside = table.outside();
        repeated = table.repeated();
        found = sfm::reconstruct(std::move(table), profile.camera, options);
    }
    nb::dict out;
    nb::list segments, gaps;
    for (sfm::Segment &segment : found.segments) {
        segments.append(segment_dict(segment));
    }
    for (const sfm::Gap &gap : found.gaps) {
        gaps.append(nb::make_tuple(gap.from, gap.to, sfm::trouble_name(gap.trouble), gap.common));
    }
    out["frames"] = to_numpy<int>(found.frames.data(), {found.frames.size()});
    out["segments"] = segments;
    out["gaps"] = gaps;
    out["outside"] = outside;
    out["repeated"] = repeated;
    return out;
}

} // namespace

void bind_sfm(nb::module_ &m)
{
    m.def("two_view", &two_view, nb::arg("first"), nb::arg("second"), nb::arg("uv1").noconvert(),
          nb::arg("uv2").noconvert(), nb::arg("covariance1").noconvert().none(),
          nb::arg("covariance2").noconvert().none(), nb::arg("sigma"), nb::arg("seed"),
          "Relative pose of two views; see pipefish.twoview.");
    nb::class_<sfm::BundleCovariance>(m, "BundleCovariance", "Covariance of an adjustment, correlations kept.")
        .def_prop_ro("pose", &pose_covariances, nb::rv_policy::move, "(K,6,6): rotation on the left, centre.")
        .def_prop_ro("point", &point_covariances, nb::rv_policy::move, "(N,3,3)")
        .def_prop_ro(
            "border", [](const sfm::BundleCovariance &c) { return matrix_to_numpy(c.border()); }, nb::rv_policy::move,
            "Of wheel, gravity (2), sag (3), line time and camera, those that were estimated.")
        .def("functions", &functions, nb::arg("points").noconvert(), nb::arg("jacobian").noconvert(),
             "(m,m) covariance of m linear functions of points (n,) int32: jacobian (m,n,3).");
    m.def("reconstruct", &reconstruct, nb::arg("camera"), nb::arg("frames"), nb::arg("tracks"),
          nb::arg("frame").noconvert(), nb::arg("track").noconvert(), nb::arg("uv").noconvert(),
          nb::arg("covariance").noconvert().none(), nb::arg("sigma"), nb::arg("method"), nb::arg("seed"),
          nb::arg("threads"), nb::arg("still"), nb::arg("step").noconvert().none(),
          nb::arg("step_sigma").noconvert().none(), nb::arg("scale_sigma"), nb::arg("down").noconvert().none(),
          nb::arg("down_sigma"), nb::arg("uncertain"), nb::arg("uncertainty").noconvert().none(), nb::arg("drifting"),
          nb::arg("drift").noconvert().none(), nb::arg("drift_noise"), nb::arg("common_errors"), nb::arg("sag_sigma"),
          nb::arg("frame_time").noconvert().none(), nb::arg("line_time"), nb::arg("middle_row"), nb::arg("pupil_sigma"),
          nb::arg("radius"), "Poses and points from tracks; see pipefish.structure.");
    m.def("adjust", &adjust, nb::arg("camera"), nb::arg("poses").noconvert(), nb::arg("points").noconvert(),
          nb::arg("frame").noconvert(), nb::arg("track").noconvert(), nb::arg("uv").noconvert(), nb::arg("sigma"),
          nb::arg("max_iterations"), "Least squares from a start, as a segment of reconstruct().");
    m.def(
        "sag",
        [](const Values &first, const Values &now, double f) {
            require(first.shape(0) == now.shape(0), "first and now: must be as long as each other");
            std::vector<double> out;
            for (size_t i = 0; i < now.shape(0); i++) {
                out.push_back(sfm::sag_of(first.data()[i], now.data()[i], f));
            }
            return to_numpy(std::move(out), {out.size()});
        },
        nb::arg("first").noconvert(), nb::arg("now").noconvert(), nb::arg("f"),
        "Pixels outwards for each px^2 of the sag, of tracks seen first and now at these angles (N,) from the axis.");
    m.def("row_poses", &row_poses, nb::arg("poses").noconvert(), nb::arg("segment").noconvert(),
          nb::arg("time").noconvert(), nb::arg("place").noconvert(), nb::arg("late").noconvert(),
          "(n,3,4) where the camera was `late` (n,) seconds after frames `place` (n,), of poses (K,3,4) with segments "
          "and times (K,).");
    m.def(
        "turn_between",
        [](const Poses &first, const Poses &second, double share) {
            require(first.shape(0) > 0 && second.shape(0) > 0, "no pose");
            const geometry::Matrix3d r1 = pose_at(first, 0).r, r2 = pose_at(second, 0).r;
            const geometry::TurnBetween out =
                geometry::turn_between(r1, geometry::rotation_log(r2 * r1.transpose()), share);
            return nb::make_tuple(matrix_to_numpy(out.r), matrix_to_numpy(out.by_first),
                                  matrix_to_numpy(out.by_second));
        },
        nb::arg("first").noconvert(), nb::arg("second").noconvert(), nb::arg("share"),
        "Rotation (3,3) between two poses (1,3,4), and how it turns with each of them (3,3).");
    m.def("sampson_squared", &sampson_squared, nb::arg("camera"), nb::arg("pose").noconvert(),
          nb::arg("uv1").noconvert(), nb::arg("uv2").noconvert(), nb::arg("sigma"),
          "Squared Sampson distances (N,) of pairs of pixels with noise sigma under cam2_from_cam1 (3,4).");
    m.def(
        "five_point",
        [](const Triples &f1, const Triples &f2) {
            std::vector<Array<double>> out;
            for (const geometry::Matrix3d &e : geometry::five_point(vectors<5>(f1), vectors<5>(f2))) {
                out.push_back(matrix_to_numpy(e));
            }
            return out;
        },
        nb::arg("f1").noconvert(), nb::arg("f2").noconvert(), "Essential matrices of five pairs of unit rays (5,3).");
    m.def(
        "three_point",
        [](const Triples &f, const Triples &x) {
            std::vector<Array<double>> out;
            for (const geometry::Pose &pose : geometry::three_point(vectors<3>(f), vectors<3>(x))) {
                Eigen::Matrix<double, 3, 4> m34;
                m34 << pose.r, pose.t;
                out.push_back(matrix_to_numpy(m34));
            }
            return out;
        },
        nb::arg("f").noconvert(), nb::arg("x").noconvert(), "Poses (3,4) of three unit rays to three points (3,3).");
    m.def(
        "ray_angles_squared",
        [](const Triples &essential, const Triples &f1, const Triples &f2) {
            const auto rows = vectors<3>(essential);
            geometry::Matrix3d e;
            e << rows[0].transpose(), rows[1].transpose(), rows[2].transpose();
            return geometry::ray_angles_squared(e, vectors<1>(f1)[0], vectors<1>(f2)[0]);
        },
        nb::arg("essential").noconvert(), nb::arg("f1").noconvert(), nb::arg("f2").noconvert(),
        "Least sum of squared sines by which two unit rays (1,3) turn to meet.");
}
