// Calibration for Python: _engine.Bundle is one adjustment with its data; pipefish/calibration.py decides what is free,
// what is rejected and in which order. Poses are (3, 4) arrays [R | t].
#include "bind/arrays.hpp"
#include "calib/bundle.hpp"
#include "calib/centroid.hpp"
#include "calib/start.hpp"
#include "pipefish/profile.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <memory>
#include <stdexcept>

namespace nb = nanobind;

void bind_calib(nb::module_ &m);

namespace
{

using namespace pipefish::calib;
using namespace pipefish;

template <size_t Columns> using Rows = nb::ndarray<const double, nb::shape<-1, Columns>, nb::c_contig, nb::device::cpu>;
using Column = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix34 = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;

Array<double> from_pose(const Pose &pose)
{
    Eigen::Matrix<double, 3, 4> m;
    m << pose.rotation, pose.translation;
    return matrix_to_numpy(m);
}

Pose to_pose(const Matrix34 &given)
{
    const Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> m(given.data());
    return {m.leftCols<3>(), m.col(3)};
}

std::unique_ptr<Bundle> make(const std::vector<int> &camera, const std::vector<int> &board,
                             const std::vector<int> &frame, const std::vector<size_t> &first, const Rows<3> &drawn,
                             const Rows<2> &pixels, double circle_radius)
{
    const size_t count = camera.size();
    const auto numbers = [](const std::vector<int> &of) { return *std::min_element(of.begin(), of.end()) >= 0; };
    require(count > 0 && board.size() == count && frame.size() == count && first.size() == count + 1 &&
                std::is_sorted(first.begin(), first.end()) && first.back() == drawn.shape(0) &&
                drawn.shape(0) == pixels.shape(0) && numbers(camera) && numbers(board) && numbers(frame),
            "bundle: views and points do not go together");
    auto bundle = std::make_unique<Bundle>();
    bundle->circle_radius = circle_radius;
    bundle->cameras.resize(static_cast<size_t>(*std::max_element(camera.begin(), camera.end())) + 1);
    bundle->boards.resize(static_cast<size_t>(*std::max_element(board.begin(), board.end())) + 1);
    bundle->frames.resize(static_cast<size_t>(*std::max_element(frame.begin(), frame.end())) + 1);
    for (size_t v = 0; v < count; v++) {
        View view{camera[v], board[v], frame[v], {}};
        for (size_t i = first[v]; i < first[v + 1]; i++) {
            Observation point;
            point.drawn = Eigen::Map<const Eigen::Vector3d>(drawn.data() + 3 * i);
            point.pixel = Eigen::Map<const Eigen::Vector2d>(pixels.data() + 2 * i);
            view.points.push_back(point);
        }
        bundle->views.push_back(std::move(view));
    }
    return bundle;
}

template <class Each> void each_point(Bundle &bundle, size_t given, const Each &each)
{
    size_t i = 0;
    for (View &view : bundle.views)
        i += view.points.size();
    require(i == given, "bundle: not one value a point");
    i = 0;
    for (View &view : bundle.views)
        for (Observation &point : view.points)
            each(point, i++);
}

void set_sheets(Bundle &bundle, const Rows<3> &across, const Rows<3> &down, const Rows<3> &bend)
{
    require(down.shape(0) == across.shape(0) && bend.shape(0) == across.shape(0), "bundle: not one value a point");
    each_point(bundle, across.shape(0), [&](Observation &point, size_t i) {
        point.across = Eigen::Map<const Eigen::Vector3d>(across.data() + 3 * i);
        point.down = Eigen::Map<const Eigen::Vector3d>(down.data() + 3 * i);
        point.bend = Eigen::Map<const Eigen::Vector3d>(bend.data() + 3 * i);
    });
}

nb::tuple predict(Bundle &bundle)
{
    size_t count = 0;
    for (const View &view : bundle.views)
        count += view.points.size();
    std::unique_ptr<double[]> pixels(new double[2 * count + 1]), points(new double[3 * count + 1]);
    {
        nb::gil_scoped_release release;
        size_t i = 0;
        for (const View &view : bundle.views) {
            for (const Observation &point : view.points) {
                Eigen::Vector2d at;
                if (!bundle.project(view, point, at, nullptr, nullptr))
                    at.setConstant(std::numeric_limits<double>::quiet_NaN());
                const Eigen::Vector3d x = bundle.in_camera(view, point);
                std::copy_n(at.data(), 2, pixels.get() + 2 * i);
                std::copy_n(x.data(), 3, points.get() + 3 * i);
                i++;
            }
        }
    }
    return nb::make_tuple(to_numpy(std::move(pixels), {count, 2}), to_numpy(std::move(points), {count, 3}));
}

nb::tuple adjust(Bundle &bundle, int max_iterations, double cost_tolerance)
{
    optim::Options options;
    options.max_iterations = max_iterations;
    options.cost_tolerance = cost_tolerance;
    optim::Summary summary;
    try {
        nb::gil_scoped_release release;
        summary = bundle.adjust(options);
    } catch (const std::invalid_argument &) {
        return nb::make_tuple("outside", 0, std::numeric_limits<double>::infinity());
    }
    const char *names[] = {"converged", "out of iterations", "stalled", "singular"};
    return nb::make_tuple(names[static_cast<int>(summary.status)], summary.iterations, summary.final_cost);
}

nb::object uncertainty(Bundle &bundle)
{
    Eigen::MatrixXd border;
    bundle.arrange();
    try {
        nb::gil_scoped_release release;
        border = bundle.uncertainty();
    } catch (const std::domain_error &error) {
        throw nb::value_error(error.what());
    }
    return nb::cast(matrix_to_numpy(border));
}

nb::object view_pose_of(const Bundle &bundle, size_t index)
{
    const View &view = bundle.views.at(index);
    const auto pose = view_pose(bundle.cameras[static_cast<size_t>(view.camera)].model, view,
                                bundle.boards[static_cast<size_t>(view.board)].shape);
    return pose ? nb::cast(from_pose(*pose)) : nb::none();
}

nb::list sweep_of(const Bundle &bundle, int camera, uint32_t width, uint32_t height, double c_u, double c_v,
                  bool classical)
{
    std::vector<View> views;
    for (const View &view : bundle.views)
        if (view.camera == camera)
            views.push_back(view);
    nb::list out;
    for (const Start &start : sweep(views, width, height, c_u, c_v, classical)) {
        pf_profile profile{};
        profile.camera = start.camera;
        out.append(nb::make_tuple(profile, start.median_px, start.radial));
    }
    return out;
}

nb::tuple disc_centroid(const pf_profile &profile, const std::array<double, 3> &centre,
                        const std::array<double, 3> &across, const std::array<double, 3> &down)
{
    const std::array<Eigen::Vector2d, kRim> &directions = rim_directions();
    const Eigen::Map<const Eigen::Vector3d> c(centre.data()), a(across.data()), d(down.data());
    Eigen::Matrix<double, kRim, 2> rim;
    for (size_t i = 0; i < kRim; i++) {
        const Eigen::Vector3d edge = c + directions[i].x() * a + directions[i].y() * d;
        Eigen::Vector2d at;
        if (pf_camera_project(&profile.camera, edge.data(), at.data(), nullptr, nullptr) != PF_OK)
            throw nb::value_error("disc: a point of its edge is outside the camera's field");
        rim.row(static_cast<Eigen::Index>(i)) = at;
    }
    const Eigen::Vector2d at = centroid(rim, nullptr);
    return nb::make_tuple(at.x(), at.y());
}

} // namespace

void bind_calib(nb::module_ &m)
{
    nb::class_<Bundle>(m, "Bundle", "One bundle adjustment of a calibration with its data and its state.")
        .def(nb::new_(&make), nb::arg("camera"), nb::arg("board"), nb::arg("frame"), nb::arg("first"),
             nb::arg("drawn").noconvert(), nb::arg("pixels").noconvert(), nb::arg("circle_radius") = 0.0)
        .def("copy", [](const Bundle &b) { return std::make_unique<Bundle>(b); })
        .def("set_sheets", &set_sheets, nb::arg("across").noconvert(), nb::arg("down").noconvert(),
             nb::arg("bend").noconvert())
        .def("set_used",
             [](Bundle &b, const Flags &used) {
                 each_point(b, used.shape(0), [&](Observation &p, size_t i) { p.used = used.data()[i]; });
             })
        .def("set_parity",
             [](Bundle &b, const Column &parity) {
                 each_point(b, parity.shape(0), [&](Observation &p, size_t i) { p.parity = parity.data()[i]; });
             })
        .def("set_sigma",
             [](Bundle &b, const Column &sigma) {
                 each_point(b, sigma.shape(0), [&](Observation &p, size_t i) { p.sigma = sigma.data()[i]; });
             })
        .def("set_camera", [](Bundle &b, size_t i, const pf_profile &p) { b.cameras.at(i).model = p.camera; })
        .def("camera",
             [](const Bundle &b, size_t i) {
                 pf_profile profile{};
                 profile.camera = b.cameras.at(i).model;
                 return profile;
             })
        .def("set_camera_pose", [](Bundle &b, size_t i, const Matrix34 &p) { b.cameras.at(i).from_rig = to_pose(p); })
        .def("camera_pose", [](const Bundle &b, size_t i) { return from_pose(b.cameras.at(i).from_rig); })
        .def("set_corner",
             [](Bundle &b, size_t i, const std::array<double, 2> &corner, bool free) {
                 b.cameras.at(i).corner = corner;
                 b.cameras.at(i).corner_free = free;
             })
        .def("corner", [](const Bundle &b, size_t i) { return b.cameras.at(i).corner; })
        .def("set_board_pose", [](Bundle &b, size_t i, const Matrix34 &p) { b.boards.at(i).to_rig = to_pose(p); })
        .def("board_pose", [](const Bundle &b, size_t i) { return from_pose(b.boards.at(i).to_rig); })
        .def("set_frame", [](Bundle &b, size_t i, const Matrix34 &p) { b.frames.at(i) = to_pose(p); })
        .def("frame", [](const Bundle &b, size_t i) { return from_pose(b.frames.at(i)); })
        .def("set_shape",
             [](Bundle &b, size_t i, const std::array<double, kShape> &c, double x, double y, double half) {
                 b.boards.at(i).shape = {c, x, y, half};
             })
        .def("shape", [](const Bundle &b, size_t i) { return b.boards.at(i).shape.coefficient; })
        .def("shape_at",
             [](const Bundle &b, size_t i, const Rows<3> &drawn) {
                 Eigen::Matrix<double, Eigen::Dynamic, 3> out(static_cast<Eigen::Index>(drawn.shape(0)), 3);
                 for (Eigen::Index k = 0; k < out.rows(); k++)
                     out.row(k) =
                         b.boards.at(i).shape.at(Eigen::Map<const Eigen::Vector3d>(drawn.data() + 3 * k), nullptr);
                 return matrix_to_numpy(out);
             })
        .def("free_camera",
             [](Bundle &b, size_t i, const std::vector<uint32_t> &params, bool pose) {
                 if (!std::is_sorted(params.begin(), params.end()) || (!params.empty() && params.back() > 40))
                     throw nb::value_error("free_camera: not numbers of parameters in order");
                 b.cameras.at(i).free = params;
                 b.cameras.at(i).pose_free = pose;
             })
        .def("free_board",
             [](Bundle &b, size_t i, const std::vector<int> &terms, bool pose) {
                 if (!std::is_sorted(terms.begin(), terms.end()) ||
                     (!terms.empty() && (terms.front() < 0 || terms.back() >= kShape)))
                     throw nb::value_error("free_board: not numbers of coefficients in order");
                 b.boards.at(i).free = terms;
                 b.boards.at(i).pose_free = pose;
             })
        .def("set_theta_end", [](Bundle &b, size_t i, double theta) { b.cameras.at(i).theta_end = theta; })
        .def_rw("huber", &Bundle::huber)
        .def("adjust", &adjust, nb::arg("max_iterations") = 100, nb::arg("cost_tolerance") = 1e-12,
             "-> status, iterations, half the sum of squares; 'outside': a point has no projection at the start.")
        .def("predict", &predict, "-> pixels (N, 2), NaN outside the model, points in their camera's frame (N, 3)")
        .def("uncertainty", &uncertainty, "-> covariance of the border's unknowns (G, G)")
        .def("layout",
             [](Bundle &b) {
                 b.arrange();
                 const Bundle::Layout &l = b.layout();
                 return nb::make_tuple(l.camera, l.camera_pose, l.corner, l.shape, l.board_pose, l.size);
             })
        .def("parameter_slope",
             [](Bundle &b, size_t i) {
                 require(i < b.cameras.size(), "no such camera");
                 b.arrange();
                 return matrix_to_numpy(b.parameter_slope(static_cast<int>(i)));
             })
        .def("view_pose", &view_pose_of, nb::arg("view"), "Board to camera (3, 4) by rays alone, or None.")
        .def("sweep", &sweep_of, nb::arg("camera"), nb::arg("width"), nb::arg("height"), nb::arg("c_u"), nb::arg("c_v"),
             nb::arg("classical"));
    m.def(
        "rising_end", [](const pf_profile &p, double end) { return rising_end(p.camera, end); },
        "Largest angle, at most `end`, up to which the radius rises.");
    m.def("disc_centroid", &disc_centroid, nb::arg("camera"), nb::arg("centre"), nb::arg("across"), nb::arg("down"),
          "Centre of gravity of the image of a disc with two perpendicular radii.");
}
