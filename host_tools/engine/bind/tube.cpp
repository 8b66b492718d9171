// The tube for Python: arrays in, arrays and dictionaries out. pipefish/tube.py is what people use.
#include "bind/arrays.hpp"
#include "tube/cylinder.hpp"
#include "tube/scan.hpp"
#include "tube/section.hpp"
#include "tube/surface.hpp"
#include "tube/trace.hpp"

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <numeric>

namespace nb = nanobind;
using namespace pipefish::tube;

void bind_tube(nb::module_ &m);

namespace
{

using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Numbers = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr double FARTHEST = 1e60; // metres: fourth powers stay finite, and so does every distance

// noise: None, (N,) standard deviations or (N,3,3) covariances.
Cloud cloud_of(const Points &points, const nb::object &noise)
{
    const size_t n = points.shape(0);
    require(all_within(points, -FARTHEST, FARTHEST), "points: not finite, or beyond all bounds");
    Cloud cloud;
    cloud.points = Eigen::Map<const Eigen::Matrix3Xd>(points.data(), 3, static_cast<Eigen::Index>(n));
    if (noise.is_none()) {
        return cloud;
    }
    const Numbers values = nb::cast<Numbers>(noise);
    require(all_within(values, -FARTHEST, FARTHEST), "noise: not finite, or beyond all bounds");
    if (values.ndim() == 1 && values.shape(0) == n) {
        cloud.sigma.assign(values.data(), values.data() + n);
    } else if (values.ndim() == 3 && values.shape(0) == n && values.shape(1) == 3 && values.shape(2) == 3) {
        for (size_t i = 0; i < n; i++) {
            cloud.covariance.push_back(Eigen::Map<const Eigen::Matrix3d>(values.data() + 9 * i));
        }
    } else {
        throw nb::value_error("noise: neither (N,) nor (N,3,3)");
    }
    return cloud;
}

const char *name_of(FitStatus status)
{
    switch (status) {
    case FitStatus::ok:
        return "ok";
    case FitStatus::circle_only:
        return "circle_only";
    case FitStatus::one_sided:
        return "one_sided";
    case FitStatus::too_few_points:
        return "too_few_points";
    case FitStatus::not_determined:
        return "not_determined";
    case FitStatus::no_cylinder:
        return "no_cylinder";
    }
    return "?";
}

nb::dict dict_of(const Cylinder &c)
{
    nb::dict out;
    out["status"] = name_of(c.status);
    out["centre"] = c.centre;
    out["axis"] = c.axis;
    out["basis"] = Eigen::Matrix<double, 3, 2>(c.basis);
    out["rho"] = c.rho;
    out["ec"] = c.ec;
    out["es"] = c.es;
    out["covariance"] = Eigen::Matrix<double, 7, 7>(c.covariance);
    out["roughness"] = c.roughness;
    out["gap"] = c.gap;
    out["inliers"] = c.inliers;
    return out;
}

nb::dict fit_one(const Points &points, const nb::object &noise, const Eigen::Vector3d &centre,
                 const Eigen::Vector3d &axis, double radius, bool ellipse, double cone, int min_inliers)
{
    const Cloud cloud = cloud_of(points, noise);
    std::vector<int> index(points.shape(0));
    std::iota(index.begin(), index.end(), 0);
    Cylinder start;
    start.centre = centre;
    start.axis = axis;
    start.rho = radius;
    Cylinder found;
    {
        const nb::gil_scoped_release release;
        found = fit_cylinder(cloud, index, start, {.ellipse = ellipse, .cone = cone, .min_inliers = min_inliers});
    }
    return dict_of(found);
}

nb::dict find_one(const Points &points, const nb::object &noise, int threads)
{
    const Cloud cloud = cloud_of(points, noise);
    require(cloud.size() > 0, "no points");
    const nb::gil_scoped_release release;
    const Cylinder found = find_cylinder(cloud, threads);
    const nb::gil_scoped_acquire acquire;
    return dict_of(found);
}

// path: (K,3), or (0,3) for a bare cloud.
nb::list trace_all(const Points &points, const nb::object &noise, const Points &path, int threads)
{
    const Cloud cloud = cloud_of(points, noise);
    require(cloud.size() > 0 && all_within(path, -FARTHEST, FARTHEST), "no points, or a path beyond all bounds");
    std::vector<Cylinder> found;
    {
        const nb::gil_scoped_release release;
        if (path.shape(0) > 0) {
            found = along(cloud,
                          Eigen::Map<const Eigen::Matrix3Xd>(path.data(), 3, static_cast<Eigen::Index>(path.shape(0))),
                          threads);
        } else {
            found.push_back(find_cylinder(cloud, threads));
        }
        if (path.shape(0) == 0 && (found[0].status == FitStatus::ok || found[0].status == FitStatus::circle_only)) {
            found = trace(cloud, found[0]);
        }
    }
    nb::list out;
    for (const Cylinder &c : found) {
        out.append(dict_of(c));
    }
    return out;
}

// A surface with the cloud it was fitted to.
struct Fitted {
    Cloud cloud;
    std::unique_ptr<Surface> surface;
};

std::unique_ptr<Fitted> fit_surface(const Points &points, const nb::object &noise, const Points &centres,
                                    const std::vector<double> &rho, const std::vector<double> &breaks, double knot,
                                    int order, int rounds, bool smooth_only, double ovality)
{
    auto out = std::make_unique<Fitted>();
    out->cloud = cloud_of(points, noise);
    require(all_within(centres, -FARTHEST, FARTHEST), "centres: not finite, or beyond all bounds");
    require(rho.size() == centres.shape(0) && std::all_of(rho.begin(), rho.end(), [](double r) { return r > 0.0; }),
            "rho: not a radius for each centre");
    require(std::is_sorted(breaks.begin(), breaks.end()) && (breaks.empty() || breaks.front() > 0.0),
            "breaks: not ascending from above 0");
    require(knot > 1e-3 && (order == 0 || (order >= 2 && order <= MAX_ORDER)) && rounds >= 1,
            "knot, order or rounds: out of range");
    const Reference reference{
        Eigen::Map<const Eigen::Matrix3Xd>(centres.data(), 3, static_cast<Eigen::Index>(centres.shape(0))), rho,
        breaks};
    const nb::gil_scoped_release release;
    out->surface = std::make_unique<Surface>(
        out->cloud, reference,
        SurfaceOptions{.knot = knot, .order = order, .rounds = rounds, .ovality = ovality, .smooth_only = smooth_only});
    return out;
}

using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// Columns: chainage, angle, r, distance, sigma, weight, piece.
Rows placed(const Fitted &fitted)
{
    Rows out(fitted.cloud.size(), 7);
    for (Eigen::Index i = 0; i < out.rows(); i++) {
        const OnSurface p = fitted.surface->place(static_cast<int>(i));
        out.row(i) << p.s, p.angle, p.r, p.distance, p.sigma, p.weight, p.piece;
    }
    return out;
}

Rows project(const Fitted &fitted, const Points &points)
{
    Rows out(static_cast<Eigen::Index>(points.shape(0)), 7);
    for (Eigen::Index i = 0; i < out.rows(); i++) {
        const OnSurface p = fitted.surface->project(Eigen::Map<const Eigen::Vector3d>(points.data() + 3 * i));
        out.row(i) << p.s, p.angle, p.r, p.distance, p.sigma, p.weight, p.piece;
    }
    return out;
}

std::vector<OnSurface> all_placed(const Fitted &fitted)
{
    std::vector<OnSurface> out;
    for (int i = 0; i < fitted.cloud.size(); i++) {
        out.push_back(fitted.surface->place(i));
    }
    return out;
}

// Rows: s, chi2, the 7 differences, their 7 standard deviations.
Rows steps(const Fitted &fitted, double window, double every, double radius)
{
    require(window > 0.0 && every > 1e-9 * fitted.surface->length() && radius > 0.0,
            "window, every or radius: not above 0");
    const std::vector<Step> found = scan_steps(all_placed(fitted), fitted.surface->length(), window, every, radius);
    Rows out(static_cast<Eigen::Index>(found.size()), 16);
    for (size_t i = 0; i < found.size(); i++) {
        out.row(static_cast<Eigen::Index>(i)) << found[i].s, found[i].chi2, found[i].difference.transpose(),
            found[i].covariance.diagonal().cwiseSqrt().transpose();
    }
    return out;
}

Eigen::VectorXd medians(const Fitted &fitted, double radius, int k, int every, double reach, double most)
{
    require(radius > 0.0 && radius <= FARTHEST && k >= 1 && every >= 1 && reach > 0.0,
            "radius, k, every or reach: out of range");
    const std::vector<double> found = local_medians(all_placed(fitted), radius, k, every, reach, most);
    return Eigen::Map<const Eigen::VectorXd>(found.data(), static_cast<Eigen::Index>(found.size()));
}

// Of stations: chainages and pieces, -1 where the chainage tells it.
void check_places(const Fitted &fitted, const std::vector<double> &s, const std::vector<int> &piece)
{
    const int pieces = static_cast<int>(fitted.surface->pieces().size());
    require(piece.size() == s.size(), "piece: not one for each chainage");
    require(std::all_of(piece.begin(), piece.end(), [&](int p) { return p >= -1 && p < pieces; }),
            "piece: the tube has no such piece");
}

// Each key an array with one row a station.
nb::dict stations(const Fitted &fitted, const std::vector<double> &s, const std::vector<int> &piece)
{
    check_places(fitted, s, piece);
    const Eigen::Index n = static_cast<Eigen::Index>(s.size()), shape = shape_parameters(fitted.surface->order());
    Rows centre(n, 3), tangent(n, 3), first(n, 3), second(n, 3), sections(n, shape),
        covariance(n, (shape + 2) * (shape + 2));
    Rows turn(n, 4), rest(n, 8);
    for (Eigen::Index i = 0; i < n; i++) {
        const Station a = fitted.surface->station(s[static_cast<size_t>(i)], piece[static_cast<size_t>(i)]);
        centre.row(i) = a.centre;
        tangent.row(i) = a.tangent;
        first.row(i) = a.first;
        second.row(i) = a.second;
        sections.row(i) = a.shape;
        covariance.row(i) = Eigen::Map<const Eigen::RowVectorXd>(a.covariance.data(), a.covariance.size());
        turn.row(i) = Eigen::Map<const Eigen::RowVector4d>(a.tangent_covariance.data());
        rest.row(i) << a.piece, a.curvature, a.curvature_sigma, a.inliers, a.gap, a.rms, a.roughness, a.ellipse;
    }
    nb::dict out;
    out["centre"] = centre;
    out["tangent"] = tangent;
    out["first"] = first;
    out["second"] = second;
    out["shape"] = sections;
    out["covariance"] = covariance;
    out["tangent_covariance"] = turn;
    const char *names[] = {"piece", "curvature", "curvature_sigma", "inliers", "gap", "rms", "roughness", "ellipse"};
    for (int k = 0; k < 8; k++) {
        out[names[k]] = Eigen::VectorXd(rest.col(k));
    }
    return out;
}

// Of the sum over stations of weight . shape.
double variance(const Fitted &fitted, const std::vector<double> &s, const std::vector<int> &piece, const Rows &weight)
{
    check_places(fitted, s, piece);
    require(std::all_of(piece.begin(), piece.end(), [](int p) { return p >= 0; }), "piece: not told");
    require(weight.rows() == static_cast<Eigen::Index>(s.size()) &&
                weight.cols() == shape_parameters(fitted.surface->order()),
            "weight: not a row for each station");
    return fitted.surface->variance(s, piece, weight);
}

Eigen::VectorXd distances(const Eigen::Vector3d &shape, const Eigen::Matrix<double, Eigen::Dynamic, 2> &y)
{
    Eigen::VectorXd out(y.rows());
    for (Eigen::Index i = 0; i < y.rows(); i++) {
        out[i] = ellipse_foot(shape[0], shape[1], shape[2], y.row(i)).distance;
    }
    return out;
}

} // namespace

void bind_tube(nb::module_ &m)
{
    m.def("tube_ellipse_distance", &distances, nb::arg("shape"), nb::arg("points"));
    m.def("tube_fit_cylinder", &fit_one, nb::arg("points"), nb::arg("noise").none(), nb::arg("centre"), nb::arg("axis"),
          nb::arg("radius"), nb::arg("ellipse"), nb::arg("cone"), nb::arg("min_inliers"));
    m.def("tube_find_cylinder", &find_one, nb::arg("points"), nb::arg("noise").none(), nb::arg("threads"));
    nb::class_<Fitted>(m, "TubeSurface")
        .def_prop_ro("order", [](const Fitted &f) { return f.surface->order(); })
        .def_prop_ro("correlation", [](const Fitted &f) { return f.surface->correlation(); })
        .def_prop_ro("thinning", [](const Fitted &f) { return f.surface->thinning(); })
        .def_prop_ro("converged", [](const Fitted &f) { return f.surface->converged(); })
        .def_prop_ro("pieces", [](const Fitted &f) { return f.surface->pieces(); })
        .def("steps", &steps, nb::arg("window"), nb::arg("every"), nb::arg("radius"))
        .def("medians", &medians, nb::arg("radius"), nb::arg("k"), nb::arg("every"), nb::arg("reach"), nb::arg("most"))
        .def("placed", &placed)
        .def("project", &project, nb::arg("points"))
        .def("stations", &stations, nb::arg("s"), nb::arg("piece"))
        .def("variance", &variance, nb::arg("s"), nb::arg("piece"), nb::arg("weight"));
    m.def("tube_surface", &fit_surface, nb::arg("points"), nb::arg("noise").none(), nb::arg("centres"), nb::arg("rho"),
          nb::arg("breaks"), nb::arg("knot"), nb::arg("order"), nb::arg("rounds"), nb::arg("smooth_only"),
          nb::arg("ovality"));
    m.def("tube_trace", &trace_all, nb::arg("points"), nb::arg("noise").none(), nb::arg("path"), nb::arg("threads"));
}
