// Self-calibration for Python; pipefish/selfcal.py checks the arguments and judges the result.
#include "selfcal/search.hpp"

#include "arrays.hpp"
#include "pipefish/profile.h"
#include "selfcal/residual.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <stdexcept>

namespace nb = nanobind;
namespace selfcal = pipefish::selfcal;

void bind_selfcal(nb::module_ &m);

namespace
{

using Pixels = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

const char *status_name(selfcal::PairStatus status)
{
    switch (status) {
    case selfcal::PairStatus::ok:
        return "ok";
    case selfcal::PairStatus::few:
        return "few";
    case selfcal::PairStatus::standing:
        return "standing";
    case selfcal::PairStatus::turning:
        return "turning";
    default:
        return "plane";
    }
}

nb::dict pair_dict(const selfcal::PairReport &pair)
{
    nb::dict out;
    Eigen::Matrix<double, 3, 4> pose;
    pose << pair.pose.r, pair.pose.t;
    out["status"] = status_name(pair.status);
    out["pose"] = matrix_to_numpy(pose);
    out["inlier"] = to_numpy<bool>(pair.inlier.data(), {pair.inlier.size()});
    out["inliers"] = pair.inliers;
    out["median_shift_px"] = pair.median_shift;
    out["rms_px"] = pair.rms;
    return out;
}

// Covariance of f, c_u, c_v, k2 .. k5 by that of the lens's own unknowns.
Eigen::Matrix<double, 7, 7> profile_covariance(const selfcal::Result &found)
{
    Eigen::Matrix<double, 7, selfcal::kLens> slope = Eigen::Matrix<double, 7, selfcal::kLens>::Zero();
    slope(0, selfcal::kLogF) = found.camera.f_u;
    slope(1, selfcal::kCentre) = slope(2, selfcal::kCentre + 1) = 1.0;
    slope.bottomRows<4>() = found.family.slope(found.lens);
    return slope * found.covariance * slope.transpose();
}

// Pixels: what the matches of a pair span in the picture in which they span less, the largest of all pairs. Those that
// are right span no more, wherever the wrong ones lie in the other picture.
double span_of(const std::vector<selfcal::Pair> &pairs)
{
    double most = 0.0;
    for (const selfcal::Pair &pair : pairs) {
        std::vector<Eigen::Vector2d> one, two;
        for (size_t i = 0; i < pair.size(); i++) {
            one.push_back(pair.one(i));
            two.push_back(pair.two(i));
        }
        most = one.empty() ? most : std::max(most, std::min(selfcal::hull_area(one), selfcal::hull_area(two)));
    }
    return most;
}

using Numbers = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

// Errors (n,) and derivatives (n,13) of one pair's matches at a lens (8,) and a pose (12,), after a step (13,).
nb::tuple selfcal_errors(const Numbers &lens, double theta_end, uint32_t width, uint32_t height, const Numbers &pose,
                         const Pixels &first, const Pixels &second, const Numbers &step)
{
    using Unknowns = Eigen::Matrix<double, selfcal::kLens + selfcal::Adjustment::kPose, 1>;
    require(lens.shape(0) == selfcal::kLens && pose.shape(0) == 12 && step.shape(0) == Unknowns::RowsAtCompileTime &&
                first.shape(0) == second.shape(0),
            "selfcal_errors: sizes");
    std::vector<selfcal::Pair> pairs(1);
    pairs[0].uv1.assign(first.data(), first.data() + first.size());
    pairs[0].uv2.assign(second.data(), second.data() + second.size());
    const Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> of(pose.data());
    selfcal::Adjustment at;
    at.width = width;
    at.height = height;
    at.family = selfcal::LensFamily(theta_end, at.prior.bend);
    at.lens = Eigen::Map<const selfcal::LensVector>(lens.data());
    at.pairs = &pairs;
    at.used = {0};
    at.poses.resize(1);
    at.poses[0].r = of.leftCols<3>();
    at.poses[0].t = of.col(3).normalized();
    at.match.resize(1);
    for (size_t i = 0; i < pairs[0].size(); i++) {
        at.match[0].push_back(static_cast<int>(i));
    }
    const auto found = at.errors_after(0, Eigen::Map<const Unknowns>(step.data()));
    const pf_camera c = at.camera();
    nb::dict camera;
    for (const auto &[name, value] :
         {std::pair("f", c.f_u), std::pair("c_u", c.c_u), std::pair("c_v", c.c_v), std::pair("k2", c.k2),
          std::pair("k3", c.k3), std::pair("k4", c.k4), std::pair("k5", c.k5), std::pair("theta_max", c.theta_max)}) {
        camera[name] = value;
    }
    return nb::make_tuple(matrix_to_numpy(found.value), matrix_to_numpy(found.slope), camera);
}

nb::dict self_calibrate(const std::vector<Pixels> &first, const std::vector<Pixels> &second, uint32_t width,
                        uint32_t height, double c_u, double c_v, double centre_sigma, double bend, double alpha_limit,
                        double alone_limit, double sigma_least, uint64_t seed, int threads)
{
    require(first.size() == second.size(), "first and second: not as many pictures");
    std::vector<selfcal::Pair> pairs(first.size());
    for (size_t p = 0; p < pairs.size(); p++) {
        const size_t n = first[p].shape(0);
        require(second[p].shape(0) == n, "first and second: not as many matches");
        pairs[p].uv1.assign(first[p].data(), first[p].data() + 2 * n);
        pairs[p].uv2.assign(second[p].data(), second[p].data() + 2 * n);
    }
    selfcal::Options options;
    options.prior.bend = bend;
    options.prior.centre = {c_u, c_v};
    options.prior.centre_sigma = centre_sigma;
    options.alpha_limit = alpha_limit;
    options.alone_limit = alone_limit;
    options.sigma_least = sigma_least;
    options.seed = seed;
    options.threads = threads;
    selfcal::Result found;
    {
        const nb::gil_scoped_release release;
        found = selfcal::self_calibrate(pairs, width, height, options);
    }
    nb::dict out;
    nb::list reports;
    for (const selfcal::PairReport &pair : found.pairs) {
        reports.append(pair_dict(pair));
    }
    out["pairs"] = reports;
    out["found"] = found.found;
    out["starts"] = found.starts;
    out["refined"] = found.refined;
    out["agreeing"] = found.agreeing;
    out["runner_up"] = found.runner_up;
    if (!found.found) {
        out["area"] = span_of(pairs) / (static_cast<double>(width) * height);
        return out;
    }
    const pf_camera &c = found.camera;
    nb::dict camera;
    for (const auto &[name, value] :
         {std::pair("f_u", c.f_u), std::pair("f_v", c.f_v), std::pair("c_u", c.c_u), std::pair("c_v", c.c_v),
          std::pair("k2", c.k2), std::pair("k3", c.k3), std::pair("k4", c.k4), std::pair("k5", c.k5),
          std::pair("theta_max", c.theta_max)}) {
        camera[name] = value;
    }
    out["camera"] = camera;
    out["covariance"] = matrix_to_numpy(profile_covariance(found));
    out["sigma_px"] = found.sigma;
    const selfcal::Observability &o = found.observed;
    for (const auto &[name, value] : {std::pair("alpha_sigma", o.alpha_sigma), std::pair("alpha_alone", o.alpha_alone),
                                      std::pair("bearing_sigma", o.bearing_sigma), std::pair("radius_px", o.radius),
                                      std::pair("theta", o.theta), std::pair("area", o.area), std::pair("tilt", o.tilt),
                                      std::pair("axial", o.axial), std::pair("needed", o.needed)}) {
        out[name] = value;
    }
    return out;
}

} // namespace

void bind_selfcal(nb::module_ &m)
{
    m.def("self_calibrate", &self_calibrate, nb::arg("first"), nb::arg("second"), nb::arg("width"), nb::arg("height"),
          nb::arg("c_u"), nb::arg("c_v"), nb::arg("centre_sigma"), nb::arg("bend"), nb::arg("alpha_limit"),
          nb::arg("alone_limit"), nb::arg("sigma_least"), nb::arg("seed"), nb::arg("threads"),
          "A camera from matches of pairs of views; see pipefish.selfcal.");
    m.def("selfcal_errors", &selfcal_errors, nb::arg("lens"), nb::arg("theta_end"), nb::arg("width"), nb::arg("height"),
          nb::arg("pose"), nb::arg("first"), nb::arg("second"), nb::arg("step"),
          "Signed errors of matches in pixels, their derivatives, and the camera, after a step of the unknowns.");
    m.def(
        "bearing_difference",
        [](const pf_profile &a, const pf_profile &b, double u, double v, double radius) {
            return selfcal::bearing_difference(a.camera, b.camera, {u, v}, radius);
        },
        nb::arg("a"), nb::arg("b"), nb::arg("u"), nb::arg("v"), nb::arg("radius"),
        "Largest angle between the rays of two cameras within radius px of (u, v), after the best common rotation.");
}
