// Quasi-dense matching for Python: _engine.find_seeds, _engine.grow_matches. pipefish/matching.py is what people use.
#include "bind/arrays.hpp"
#include "bind/matches.hpp"
#include "match/patch.hpp"
#include "match/rivals.hpp"
#include "match/search.hpp"
#include "match/seeds.hpp"
#include "pipefish/profile.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <limits>
#include <memory>

namespace nb = nanobind;
using namespace pipefish::match;

void bind_match(nb::module_ &m);

namespace
{

using Picture = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;
using Square = nb::ndarray<const double, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;

constexpr int kSideMost = 32767; // pixels

// Borrows the array: cv::Mat is not const-correct, ScaleStack does not write level 0.
Image view(const Picture &image)
{
    require(image.size() > 0 && image.shape(0) <= kSideMost && image.shape(1) <= kSideMost, "not a picture");
    return Image(static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1)), const_cast<float *>(image.data()));
}

// (S, 8): at, centre, map row by row.
Array<double> to_python(const std::vector<Seed> &seeds)
{
    std::vector<double> rows(8 * seeds.size());
    for (size_t k = 0; k < seeds.size(); k++) {
        const Seed &s = seeds[k];
        const double row[8] = {s.at.x(),  s.at.y(),  s.centre.x(), s.centre.y(),
                               s.a(0, 0), s.a(0, 1), s.a(1, 0),    s.a(1, 1)};
        std::copy_n(row, 8, &rows[8 * k]);
    }
    return to_numpy(std::move(rows), {seeds.size(), 8});
}

nb::dict to_python(const Growth &g)
{
    const size_t n = g.matches.size();
    std::vector<double> xy1(2 * n), xy2(2 * n), affine(4 * n), zncc(n);
    std::vector<int64_t> parent(n), seed(n);
    for (size_t k = 0; k < n; k++) {
        const Match &m = g.matches[k];
        xy1[2 * k] = m.x;
        xy1[2 * k + 1] = m.y;
        xy2[2 * k] = static_cast<double>(m.centre.x());
        xy2[2 * k + 1] = static_cast<double>(m.centre.y());
        for (int i = 0; i < 4; i++)
            affine[4 * k + static_cast<size_t>(i)] = static_cast<double>(m.a(i / 2, i % 2));
        zncc[k] = static_cast<double>(m.zncc);
        parent[k] = m.parent;
        seed[k] = m.seed;
    }
    nb::dict out;
    out["xy1"] = to_numpy(std::move(xy1), {n, 2});
    out["xy2"] = to_numpy(std::move(xy2), {n, 2});
    out["affine"] = to_numpy(std::move(affine), {n, 2, 2});
    out["zncc"] = to_numpy(std::move(zncc), {n});
    out["parent"] = to_numpy(std::move(parent), {n});
    out["seed"] = to_numpy(std::move(seed), {n});
    out["seeds_used"] = g.seeds_used;
    out["tried"] = g.tried;
    out["low_zncc"] = g.low_zncc;
    out["taken"] = g.taken;
    out["off_line"] = g.off_line;
    out["at_border"] = g.at_border;
    return out;
}

std::optional<Epipolar> geometry_of(const pf_profile *camera_1, const pf_profile *camera_2,
                                    const std::optional<Pose> &pose)
{
    using Rows = Eigen::Matrix<double, 3, 4, Eigen::RowMajor>;
    if (!camera_1 || !camera_2 || !pose)
        return std::nullopt;
    return Epipolar(camera_1->camera, camera_2->camera, Eigen::Map<const Rows>(pose->data()));
}

// By the cameras where they are given, by the fundamental matrix else.
Array<double> match_rivals(const Picture &first, const Picture &second, const std::vector<Match> &matches,
                           const Reach &reach, const std::optional<Epipolar> &epipolar,
                           const std::optional<Square> &fundamental)
{
    require(reach.radius >= 1 && reach.radius <= kPatchMost, "radius: out of range");
    LineAt line_at;
    if (epipolar) {
        line_at = [&](const Eigen::Vector2d &x, const Eigen::Vector2d &x_2) { return epipolar->at(x, x_2); };
    } else {
        const Eigen::Matrix3d f =
            Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(fundamental.value().data());
        line_at = [f](const Eigen::Vector2d &x, const Eigen::Vector2d &x_2) { return line_of(f, x, x_2); };
    }
    std::vector<double> found;
    {
        const nb::gil_scoped_release release;
        const ScaleStack one(view(first)), two(view(second));
        found = rivals(one, two, matches, line_at, reach);
    }
    const size_t n = found.size();
    return to_numpy(std::move(found), {n});
}

Growth grow_matches(const Picture &first, const Picture &second, const Rows2 &at, const Rows2 &centre, const Maps &maps,
                    const Options &options, const pf_profile *camera_1, const pf_profile *camera_2,
                    const std::optional<Pose> &pose)
{
    require(centre.shape(0) == at.shape(0) && maps.shape(0) == at.shape(0),
            "xy1, xy2 and affine: must be as long as each other");
    require(options.radius >= 2 && options.radius <= kRadiusMost, "radius: out of range");
    require(options.classes >= 1 && options.classes <= 1 << 24, "classes: out of range");
    std::vector<Seed> seeds(at.shape(0));
    for (size_t k = 0; k < seeds.size(); k++) {
        seeds[k] = {{at(k, 0), at(k, 1)}, {centre(k, 0), centre(k, 1)}, {}};
        seeds[k].a << maps(k, 0, 0), maps(k, 0, 1), maps(k, 1, 0), maps(k, 1, 1);
    }
    const std::optional<Epipolar> epipolar = geometry_of(camera_1, camera_2, pose);
    const nb::gil_scoped_release release;
    const ScaleStack one(view(first)), two(view(second));
    return grow(one, two, seeds, options, epipolar ? &*epipolar : nullptr);
}

// Values between pixels, by the cubic spline through them; places within two pixels of the rim are NaN.
Array<float> sample_image(const Picture &image, const Rows2 &places)
{
    const size_t n = places.shape(0);
    std::vector<float> values(n);
    {
        const nb::gil_scoped_release release;
        const ScaleStack stack(view(image));
        const Image &coefficients = stack.spline_for_step(1);
        const auto right = static_cast<double>(stack.width() - 3), bottom = static_cast<double>(stack.height() - 3);
        for (size_t k = 0; k < n; k++) {
            const double x = places(k, 0), y = places(k, 1);
            values[k] = x >= 2 && y >= 2 && x <= right && y <= bottom
                            ? spline(coefficients, static_cast<float>(x), static_cast<float>(y))
                            : std::numeric_limits<float>::quiet_NaN();
        }
    }
    return to_numpy(std::move(values), {n});
}

} // namespace

void bind_match(nb::module_ &m)
{
    nb::enum_<Mode>(m, "MatchMode")
        .value("translation", Mode::kTranslation)
        .value("constant", Mode::kConstant)
        .value("adaptive", Mode::kAdaptive);
    nb::enum_<Adaptation>(m, "MatchAdaptation")
        .value("fit", Adaptation::kFit)
        .value("gradient", Adaptation::kGradient)
        .value("intensity", Adaptation::kIntensity);
    nb::enum_<Turn>(m, "MatchTurn")
        .value("correlation", Turn::kCorrelation)
        .value("peak", Turn::kPeak)
        .value("epipolar", Turn::kEpipolar);
    nb::class_<Options>(m, "MatchOptions", "How matches grow; pipefish.matching fills it.")
        .def(nb::init<>())
        .def_rw("mode", &Options::mode)
        .def_rw("adaptation", &Options::adaptation)
        .def_rw("turn", &Options::turn)
        .def_rw("radius", &Options::radius)
        .def_rw("zncc_min", &Options::zncc_min)
        .def_rw("seed_zncc_min", &Options::seed_zncc_min)
        .def_rw("texture", &Options::texture)
        .def_rw("epipolar_px", &Options::epipolar_px)
        .def_rw("refine_seeds", &Options::refine_seeds)
        .def_rw("classes", &Options::classes)
        .def_rw("threads", &Options::threads);
    m.def(
        "find_seeds",
        [](const Picture &first, const Picture &second, int most, bool adapt, bool hessian, bool extremal,
           int threads) {
            require(most >= 1, "most: not at least 1");
            std::vector<Seed> seeds;
            {
                const nb::gil_scoped_release release;
                const ScaleStack one(view(first)), two(view(second));
                seeds = find_seeds(one, two, {{most, adapt, hessian, extremal, threads}});
            }
            return to_python(seeds);
        },
        nb::arg("image1"), nb::arg("image2"), nb::arg("most"), nb::arg("adapt"), nb::arg("hessian"),
        nb::arg("extremal"), nb::arg("threads"),
        "Two (H,W) float32 of 0..1 -> (S,8): x1, y1, x2, y2, the map row by row.");
    m.def("sample_image", &sample_image, nb::arg("image"), nb::arg("xy"),
          "(H,W) float32, (N,2) pixels -> (N,) float32 by cubic splines, NaN within two pixels of the rim.");
    m.def(
        "match_rivals",
        [](const Picture &first, const Picture &second, const Rows2 &xy1, const Rows2 &xy2, const Maps &affine,
           const Values &zncc, int radius, int threads, const pf_profile *camera_1, const pf_profile *camera_2,
           const std::optional<Pose> &pose, const std::optional<Square> &fundamental) {
            Reach reach;
            reach.radius = radius;
            reach.threads = threads;
            return match_rivals(first, second, matches_of(xy1, xy2, affine, zncc), reach,
                                geometry_of(camera_1, camera_2, pose), fundamental);
        },
        nb::arg("image1"), nb::arg("image2"), nb::arg("xy1"), nb::arg("xy2"), nb::arg("affine"), nb::arg("zncc"),
        nb::arg("radius"), nb::arg("threads"), nb::arg("camera1").none(), nb::arg("camera2").none(),
        nb::arg("relative_pose").none(), nb::arg("fundamental").none(),
        "Two (H,W) float32 of 0..1, matches -> (K,): the best correlation elsewhere on the epipolar curve, over "
        "theirs.");
    m.def(
        "grow_matches",
        [](const Picture &first, const Picture &second, const Rows2 &at, const Rows2 &centre, const Maps &maps,
           const Options &options, const pf_profile *camera_1, const pf_profile *camera_2,
           const std::optional<Pose> &pose) {
            return to_python(grow_matches(first, second, at, centre, maps, options, camera_1, camera_2, pose));
        },
        nb::arg("image1"), nb::arg("image2"), nb::arg("xy1"), nb::arg("xy2"), nb::arg("affine"), nb::arg("options"),
        nb::arg("camera1").none(), nb::arg("camera2").none(), nb::arg("relative_pose").none(),
        "Two (H,W) float32 of 0..1, seeds (S,2), (S,2), (S,2,2) -> dict of matches.");
}
