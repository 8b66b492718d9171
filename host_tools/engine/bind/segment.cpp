// Motion segmentation for Python: _engine.segment, _engine.segment_expand. pipefish/segmentation.py is what people use.
#include "segment/segment.hpp"
#include "segment/silhouette.hpp"

#include "bind/arrays.hpp"
#include "bind/matches.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

namespace nb = nanobind;
using namespace pipefish::segment;

void bind_segment(nb::module_ &m);

namespace
{

using Table = nb::ndarray<const int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Weights = nb::ndarray<const int32_t, nb::shape<-1, -1, 4>, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

std::vector<std::vector<int32_t>> rows_of(const Table &table)
{
    std::vector<std::vector<int32_t>> out;
    for (size_t k = 0; k < table.shape(0); k++)
        out.emplace_back(table.data() + k * table.shape(1), table.data() + (k + 1) * table.shape(1));
    return out;
}

nb::tuple expand_one(const Table &cost, int width, const Weights &weight, const Table &partner, int lonely, int alpha,
                     const Bytes &start)
{
    const size_t pixels = cost.shape(1);
    require(partner.shape(0) == cost.shape(0) && partner.shape(1) == pixels && start.shape(0) == pixels,
            "cost, partner and labels: not of as many labels and pixels");
    require(weight.shape(0) * weight.shape(1) == pixels && width >= 1 &&
                weight.shape(1) % static_cast<size_t>(width) == 0,
            "weight: not of pictures of that width");
    require(cost.shape(0) <= 256 && alpha < static_cast<int>(cost.shape(0)) &&
                all_within(start, 0, static_cast<double>(cost.shape(0)) - 1),
            "alpha or labels: no such label");
    require(all_within(partner, -1, static_cast<double>(pixels) - 1), "partner: no such pixel");
    std::vector<Grid> grids(weight.shape(0), {width, {}});
    Problem problem{{}, rows_of(cost), rows_of(partner), lonely};
    for (size_t k = 0; k < grids.size(); k++) {
        for (size_t p = 0; p < weight.shape(1); p++)
            grids[k].cost.push_back({weight(k, p, 0), weight(k, p, 1), weight(k, p, 2), weight(k, p, 3)});
        problem.grids.push_back(&grids[k]);
    }
    Labels labels(start.data(), start.data() + start.shape(0));
    if (alpha >= 0)
        expand_once(problem, alpha, labels);
    else {
        std::vector<Flows> flows;
        expand(problem, 100, labels, flows);
    }
    return nb::make_tuple(to_numpy<uint8_t>(labels.data(), {labels.size()}), problem.energy(labels));
}

Array<double> halved(const std::array<int, 4> &box, double spacing, const Rows2 &d, const Rows2 &at)
{
    require(std::min(box[2], box[3]) >= 1 && std::max(box[2], box[3]) <= 32767 && spacing >= 0.5 && spacing <= 32767,
            "box or spacing: out of range");
    require(all_within(at, -1e6, 1e6), "at: not places");
    Warp warp{Lattice({box[0], box[1], box[2], box[3]}, spacing), {}};
    const size_t points = warp.lattice.points();
    if (d.shape(0) < points)
        throw std::invalid_argument("d: the grid has " + std::to_string(points) + " points");
    warp.d = Eigen::Map<const Eigen::VectorXd>(d.data(), static_cast<Eigen::Index>(2 * points));
    const Warp half = finer(warp);
    std::vector<double> out;
    for (const Warp &w : {warp, half})
        for (size_t k = 0; k < at.shape(0); k++) {
            const Vector2d to = w.to(at(k, 0), at(k, 1));
            out.insert(out.end(), {to.x(), to.y()});
        }
    return to_numpy<double>(out.data(), {2, at.shape(0), 2});
}

using Planes = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Triples = nb::ndarray<const int64_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

std::vector<Image> planes_of(const Planes &planes)
{
    const int rows = static_cast<int>(planes.shape(1)), columns = static_cast<int>(planes.shape(2));
    std::vector<Image> out;
    for (size_t c = 0; c < planes.shape(0); c++)
        out.emplace_back(rows, columns, const_cast<float *>(&planes(c, 0, 0))); // not written to
    return out;
}

pipefish::group::Groups groups_of(const Indices &label, const Triples &triangles, const Indices &of, size_t matches)
{
    const double last = static_cast<double>(matches) - 1;
    require(label.shape(0) == matches && of.shape(0) == triangles.shape(0),
            "label or triangle_group: not one for each");
    require(all_within(triangles, 0, last), "triangles: no such match");
    require(all_within(label, -1, last) && all_within(of, 0, last), "label or triangle_group: no such group");
    pipefish::group::Groups out;
    out.label.assign(label.data(), label.data() + label.shape(0));
    for (size_t t = 0; t < triangles.shape(0); t++) {
        out.triangles.push_back(
            {{static_cast<int>(triangles(t, 0)), static_cast<int>(triangles(t, 1)), static_cast<int>(triangles(t, 2))},
             static_cast<int>(of(t))});
        out.count = std::max(out.count, static_cast<int>(of(t)) + 1);
    }
    return out;
}

// A picture's planes as (H,W,C).
Array<float> interleaved(const Image *planes, size_t channels)
{
    cv::Mat all;
    cv::merge(planes, channels, all);
    return to_numpy<float>(all.ptr<float>(), {static_cast<size_t>(all.rows), static_cast<size_t>(all.cols), channels});
}

nb::dict to_python(const Found &f)
{
    nb::dict d;
    d["groups"] = f.groups;
    d["claimed"] = f.claimed;
    const size_t channels = f.gain[0].size();
    for (size_t s = 0; s < 2; s++) {
        const auto put = [&](const char *name, const auto &value) {
            d[nb::str((name + std::to_string(s + 1)).c_str())] = value;
        };
        const auto rows = static_cast<size_t>(f.flow[s].rows), columns = static_cast<size_t>(f.flow[s].cols);
        put("flow", to_numpy<float>(f.flow[s].ptr<float>(), {rows, columns, 2}));
        put("gain", interleaved(f.gain[s].data(), channels));
        put("offset", interleaved(f.offset[s].data(), channels));
        put("warped", interleaved(f.warped[s], channels));
        put("area", nb::int_(f.area[s]));
        put("sigma", nb::float_(f.sigma[s]));
        put("zncc", nb::float_(f.zncc[s]));
        put("folds", nb::int_(f.folds[s]));
        put("low_evidence", nb::float_(f.low_evidence[s]));
        put("ambiguous", nb::float_(f.ambiguous[s]));
    }
    return d;
}

nb::dict segment_pictures(const Planes &one, const Planes &two, const Rows2 &xy1, const Rows2 &xy2, const Maps &affine,
                          const Values &zncc, const Indices &label, const Triples &triangles, const Indices &of,
                          const Options &options, const nb::callable &progress)
{
    const std::vector<pipefish::match::Match> matches = matches_of(xy1, xy2, affine, zncc);
    const pipefish::group::Groups groups = groups_of(label, triangles, of, matches.size());
    Result found;
    {
        const nb::gil_scoped_release release;
        found = segment({planes_of(one), planes_of(two)}, matches, groups, options, [&](double share) {
            const nb::gil_scoped_acquire acquire;
            progress(share);
        });
    }
    nb::dict out;
    for (size_t s = 0; s < 2; s++)
        out[s == 0 ? "labels1" : "labels2"] =
            to_numpy<uint8_t>(found.labels[s].data,
                              {static_cast<size_t>(found.labels[s].rows), static_cast<size_t>(found.labels[s].cols)});
    nb::list layers, trace;
    for (const Found &f : found.layers)
        layers.append(to_python(f));
    for (const Step &step : found.trace)
        trace.append(nb::make_tuple(step.name, step.energy, step.layers));
    out["layers"] = layers;
    out["trace"] = trace;
    return out;
}

using Marks = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

Array<uint8_t> silhouette_of(const Planes &planes, const Marks &expected, const Marks &seen, const Marks &others)
{
    require(planes.size() > 0 && (planes.shape(0) == 1 || planes.shape(0) == 3), "no picture");
    const size_t rows = planes.shape(1), columns = planes.shape(2);
    const auto mask = [&](const Marks &given) {
        require(given.shape(0) == rows && given.shape(1) == columns, "a mask is not of the picture's size");
        return pipefish::group::Mask(static_cast<int>(rows), static_cast<int>(columns),
                                     const_cast<uint8_t *>(given.data())); // not written to
    };
    const pipefish::group::Mask one = mask(expected), two = mask(seen), three = mask(others);
    pipefish::group::Mask found;
    {
        const nb::gil_scoped_release release;
        found = silhouette(planes_of(planes), one, two, three, {});
    }
    return to_numpy<uint8_t>(found.data, {rows, columns});
}

} // namespace

void bind_segment(nb::module_ &m)
{
    nb::class_<Options>(m, "SegmentOptions", "How pictures are segmented; pipefish.segmentation fills it.")
        .def(nb::init<>())
        .def_rw("layers", &Options::layers)
        .def_rw("rounds", &Options::rounds)
        .def_rw("edge", &Options::edge)
        .def_rw("lonely", &Options::lonely)
        .def_rw("layer", &Options::layer)
        .def_rw("bend", &Options::bend)
        .def_rw("light", &Options::light)
        .def_rw("reach", &Options::reach)
        .def_rw("least", &Options::least)
        .def_rw("threads", &Options::threads);
    m.def("segment", &segment_pictures, nb::arg("planes1"), nb::arg("planes2"), nb::arg("xy1"), nb::arg("xy2"),
          nb::arg("affine"), nb::arg("zncc"), nb::arg("label"), nb::arg("triangles"), nb::arg("triangle_group"),
          nb::arg("options"), nb::arg("progress"),
          "Planes (C,H,W) of both pictures, matches, their groups -> dict of labels1, labels2, layers, trace.");
    m.def(
        "segment_expand", &expand_one, nb::arg("cost"), nb::arg("width"), nb::arg("weight"), nb::arg("partner"),
        nb::arg("lonely"), nb::arg("alpha"), nb::arg("labels"),
        "Costs (labels,N), width of the images, weights (images,N/images,4) of each pixel's differing from that right "
        "of it, below, below to the right and to the left, partners (labels,N), cost of being alone, label to expand "
        "(-1: all, until none gains), labels (N,) -> labels (N,), their energy. For tests.");
    m.def(
        "segment_halved", &halved, nb::arg("box"), nb::arg("spacing"), nb::arg("d"), nb::arg("at"),
        "Box (x, y, width, height), pixels between the points of its grid, displacements (M,2) of these (of which as "
        "many as there are points), places (N,2) -> (2,N,2): the places moved, by that field and by the one on a grid "
        "of half the spacing. For tests.");
    m.def("silhouette", &silhouette_of, nb::arg("planes"), nb::arg("expected"), nb::arg("seen"), nb::arg("others"),
          "Planes (C,H,W) of a scene, masks (H,W) of 0 and 255: where an object is expected, was matched, and where "
          "others were -> mask (H,W) of what is seen of it.");
}
