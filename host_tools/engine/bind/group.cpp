// Grouping and recognition for Python: _engine.group_matches, _engine.group_outlines, _engine.Prepared,
// _engine.recognise. pipefish/grouping.py and recognition.py are what people use.
#include "bind/arrays.hpp"
#include "bind/matches.hpp"
#include "group/recognise.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <memory>

namespace nb = nanobind;
using namespace pipefish::group;
namespace match = pipefish::match;

void bind_group(nb::module_ &m);

namespace
{

using Picture = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Marked = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Labels = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Triples = nb::ndarray<const int64_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

nb::tuple to_python(const Groups &g)
{
    const size_t n = g.label.size(), t = g.triangles.size();
    std::vector<int64_t> label(g.label.begin(), g.label.end()), corners(3 * t), group(t);
    for (size_t k = 0; k < t; k++) {
        std::copy_n(g.triangles[k].vertex.begin(), 3, &corners[3 * k]);
        group[k] = g.triangles[k].group;
    }
    return nb::make_tuple(to_numpy(std::move(label), {n}), to_numpy(std::move(corners), {t, 3}),
                          to_numpy(std::move(group), {t}));
}

template <typename Point> nb::list to_python(const std::vector<std::vector<Point>> &lines)
{
    nb::list out;
    for (const auto &line : lines) {
        std::vector<double> rows(2 * line.size());
        for (size_t k = 0; k < line.size(); k++) {
            rows[2 * k] = static_cast<double>(line[k].x);
            rows[2 * k + 1] = static_cast<double>(line[k].y);
        }
        out.append(to_numpy(std::move(rows), {line.size(), 2}));
    }
    return out;
}

nb::dict to_python(const Recognition &r)
{
    nb::list segments;
    for (const Segment &s : r.segments) {
        nb::dict d;
        d["score"] = s.score;
        d["area"] = s.area;
        d["coverage"] = s.coverage;
        d["correlation"] = s.correlation;
        d["evidence"] = s.evidence;
        d["matches"] = s.matches;
        d["centre"] = nb::make_tuple(s.centre.x, s.centre.y);
        d["model_contours"] = to_python(s.model);
        d["scene_contours"] = to_python(s.scene);
        segments.append(d);
    }
    nb::dict out;
    out["seeds"] = r.seeds;
    out["matches"] = r.matches;
    out["score"] = r.score;
    out["segments"] = segments;
    out["place"] = nb::make_tuple(r.place.centre.x, r.place.centre.y, r.place.radius);
    out["extent"] = to_python(r.extent);
    return out;
}

void prepare_at(Prepared *at, const Picture &image, const std::optional<Marked> &mask, int max_pixels, int regions)
{
    require(image.size() > 0 && std::max(image.shape(0), image.shape(1)) <= 32767, "not a picture");
    require(max_pixels >= 1024 && regions >= 1, "max_pixels or regions: out of range");
    const int rows = static_cast<int>(image.shape(0)), columns = static_cast<int>(image.shape(1));
    const match::Image picture(rows, columns, const_cast<float *>(image.data())); // not written to
    Mask marked;
    if (mask) {
        require(mask->shape(0) == image.shape(0) && mask->shape(1) == image.shape(1),
                "the mask is not of the picture's size");
        marked = Mask(rows, columns, const_cast<uint8_t *>(mask->data()));
    }
    const nb::gil_scoped_release release;
    new (at) Prepared(picture, marked, max_pixels, regions);
}

} // namespace

void bind_group(nb::module_ &m)
{
    nb::class_<Options>(m, "GroupOptions", "How matches are grouped; pipefish.grouping fills it.")
        .def(nb::init<>())
        .def_rw("cell", &Options::cell)
        .def_rw("absolute", &Options::absolute)
        .def_rw("relative", &Options::relative)
        .def_rw("least", &Options::least);
    m.def(
        "group_matches",
        [](const Rows2 &xy1, const Rows2 &xy2, const Maps &affine, const Values &zncc, const Options &options) {
            require(options.cell >= 1, "cell: not at least 1");
            const std::vector<match::Match> matches = matches_of(xy1, xy2, affine, zncc);
            Groups found;
            {
                const nb::gil_scoped_release release;
                found = group_matches(matches, options);
            }
            return to_python(found);
        },
        "Matches -> labels (K,), triangles (T,3) of matches, their groups (T,).");
    m.def(
        "group_support",
        [](const Rows2 &xy, const Triples &triangles, const Labels &group, int wanted, int height, int width,
           double reach) {
            require(group.shape(0) == triangles.shape(0), "group: not one for each triangle");
            require(all_within(triangles, 0, static_cast<double>(xy.shape(0)) - 1), "triangles: no such position");
            require(all_within(xy, -kPixelMost, kPixelMost), "xy: not pixels");
            require(std::min(height, width) >= 1 && std::max(height, width) <= 32767,
                    "height and width: not a picture's");
            std::vector<match::Match> corners(xy.shape(0));
            for (size_t k = 0; k < corners.size(); k++)
                corners[k].centre = {static_cast<float>(xy(k, 0)), static_cast<float>(xy(k, 1))};
            Groups groups;
            for (size_t k = 0; k < triangles.shape(0); k++)
                groups.triangles.push_back({{static_cast<int>(triangles(k, 0)), static_cast<int>(triangles(k, 1)),
                                             static_cast<int>(triangles(k, 2))},
                                            static_cast<int>(group(k))});
            const Mask mask = support(corners, groups, wanted, Side::kSecond, {width, height}, reach);
            const size_t h = static_cast<size_t>(height), w = static_cast<size_t>(width);
            auto pixels = std::make_unique<uint8_t[]>(h * w);
            std::copy_n(mask.data, h * w, pixels.get());
            return nb::make_tuple(to_numpy(std::move(pixels), {h, w}), to_python(outlines(mask)));
        },
        "Positions (K,2) in an image, triangles, their groups, which group, height, width, reach -> mask (H,W) of 0 "
        "and "
        "255, outlines.");
    m.def(
        "mask_outlines",
        [](const Marked &mask) {
            require(mask.size() > 0, "an empty mask");
            return to_python(outlines(Mask(static_cast<int>(mask.shape(0)), static_cast<int>(mask.shape(1)),
                                           const_cast<uint8_t *>(mask.data()))));
        },
        "(H,W) uint8, not zero inside -> outer boundaries, (N,2) each, largest first.");
    nb::class_<RecogniseOptions>(m, "RecogniseOptions", "pipefish.recognition fills it.")
        .def(nb::init<>())
        .def_prop_rw(
            "zncc_min", [](const RecogniseOptions &o) { return o.growth.zncc_min; },
            [](RecogniseOptions &o, double z) { o.growth.zncc_min = z; })
        .def_rw("grouping", &RecogniseOptions::grouping)
        .def_rw("seeds", &RecogniseOptions::seeds)
        .def_rw("least", &RecogniseOptions::least)
        .def_rw("evidence", &RecogniseOptions::evidence)
        .def_rw("reach", &RecogniseOptions::reach);
    nb::class_<Prepared>(m, "Prepared", "A model's picture or a scene, made ready for recognise().")
        .def("__init__", &prepare_at, nb::arg("image"), nb::arg("mask").none(), nb::arg("max_pixels"),
             nb::arg("regions"))
        .def_prop_ro("regions", [](const Prepared &p) { return p.regions().regions.size(); })
        .def_prop_ro("area", &Prepared::area);
    m.def(
        "recognise",
        [](const Prepared &model, const Prepared &scene, const RecogniseOptions &options) {
            require(options.seeds >= 1 && options.grouping.cell >= 1, "seeds or cell: not at least 1");
            Recognition found;
            {
                const nb::gil_scoped_release release;
                found = recognise(model, scene, options);
            }
            return to_python(found);
        },
        "Prepared model, Prepared scene -> dict.");
}
