// The unrolled picture for Python; pipefish/unroll.py is what people use.
#include "unroll/unroll.hpp"
#include "bind/arrays.hpp"
#include "pipefish/profile.h"

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>

namespace nb = nanobind;
using namespace pipefish::unroll;

void bind_unroll(nb::module_ &m);

namespace
{

using Spots = nb::ndarray<const double, nb::shape<-1, 3, 3>, nb::c_contig, nb::device::cpu>;
using Poses = nb::ndarray<const double, nb::shape<-1, 3, 4>, nb::c_contig, nb::device::cpu>;
using Grey = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// spots (n,3,3): place, along, down.
std::vector<Spot> spots_of(const Spots &rows)
{
    std::vector<Spot> out(rows.shape(0));
    const double *p = rows.data();
    for (Spot &s : out) {
        s = {{p[0], p[1], p[2]}, {p[3], p[4], p[5]}, {p[6], p[7], p[8]}};
        p += 9;
    }
    return out;
}

std::vector<Picture> pictures_of(const pf_camera &camera, const std::vector<Grey> &images, const Poses &poses,
                                 const std::vector<int> &views)
{
    require(images.size() == poses.shape(0) && images.size() == views.size(),
            "images, poses and views: not as many of each");
    std::vector<Picture> out(images.size());
    for (size_t i = 0; i < images.size(); i++) {
        require(images[i].shape(0) == camera.height && images[i].shape(1) == camera.width,
                "images: not of the camera's size");
        const Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>> m(poses.data() + 12 * i);
        out[i] = {images[i].data(), {m.leftCols<3>(), m.col(3)}, views[i]};
    }
    return out;
}

// Collects what overlapping keyframes show of the same places, and finds the light that explains it.
struct Balance {
    std::vector<Glance> seen;
    int patches = 0;

    // Best resolution at each spot, pixels per metre; 0 where nothing sees it.
    Eigen::VectorXd add(const pf_profile &profile, const std::vector<Grey> &images, const Poses &poses,
                        const std::vector<int> &views, const Spots &rows, double side, double reach)
    {
        const std::vector<Picture> pictures = pictures_of(profile.camera, images, poses, views);
        const std::vector<Spot> spots = spots_of(rows);
        std::vector<double> fine;
        {
            const nb::gil_scoped_release release;
            const std::vector<Glance> more = glances(profile.camera, pictures, spots, side, reach, patches, fine);
            seen.insert(seen.end(), more.begin(), more.end());
        }
        patches += static_cast<int>(spots.size());
        return Eigen::Map<const Eigen::VectorXd>(fine.data(), static_cast<Eigen::Index>(fine.size()));
    }

    Light solve(const pf_profile &profile, const Eigen::VectorXd &along) const
    {
        for (const Glance &g : seen) {
            require(g.view >= 0 && g.view < along.size(), "views: out of range");
        }
        const nb::gil_scoped_release release;
        return balance(seen, along, profile.camera.theta_max);
    }
};

// spots: nodes column by column. Returns grey, seen (rows, columns) uint8, best int32, fine float32 (node rows, node
// columns).
nb::tuple draw_sheet(const pf_profile &profile, const std::vector<Grey> &images, const Poses &poses,
                     const std::vector<int> &views, const Spots &rows, int columns, int row_count, int step,
                     double cell, const Light &light, double finest, double radius, double reach, double seam,
                     int threads)
{
    const Sheet sheet{columns, row_count, step, cell, spots_of(rows)};
    require(step >= 1 && columns >= 1 && row_count >= 1 && columns % step == 0 && row_count % step == 0 &&
                sheet.nodes.size() ==
                    static_cast<size_t>(sheet.node_rows()) * static_cast<size_t>(sheet.node_columns()),
            "spots: not the nodes of such a sheet");
    const std::vector<Picture> pictures = pictures_of(profile.camera, images, poses, views);
    for (const Picture &p : pictures) {
        require(p.view >= 0 && p.view < light.gain.size(), "views: the light does not know them");
    }
    Drawing out;
    {
        const nb::gil_scoped_release release;
        out = draw(profile.camera, pictures, sheet, light,
                   {.finest = finest, .radius = radius, .reach = reach, .seam = seam, .level = light.level}, threads);
    }
    const size_t nr = static_cast<size_t>(sheet.node_rows()), nc = static_cast<size_t>(sheet.node_columns());
    const size_t r = static_cast<size_t>(row_count), c = static_cast<size_t>(columns);
    return nb::make_tuple(to_numpy(std::move(out.grey), {r, c}), to_numpy(std::move(out.seen), {r, c}),
                          to_numpy(std::move(out.best), {nr, nc}), to_numpy(std::move(out.fine), {nr, nc}));
}

} // namespace

void bind_unroll(nb::module_ &m)
{
    nb::class_<Light>(m, "UnrollLight", "How lamp, lens and exposures colour the wall; logarithms.")
        .def_ro("gain", &Light::gain, "(K,) of each view")
        .def_ro("level", &Light::level)
        .def_ro("scatter", &Light::scatter, "of what two views of one place differ by after balancing")
        .def("field", [](const Light &l, double theta, double phi) { return l.field.at(theta, phi); });
    nb::class_<Balance>(m, "UnrollBalance")
        .def(nb::init<>())
        .def("add", &Balance::add, nb::arg("camera"), nb::arg("images"), nb::arg("poses"), nb::arg("views"),
             nb::arg("spots"), nb::arg("side"), nb::arg("reach"))
        .def("solve", &Balance::solve, nb::arg("camera"), nb::arg("along"));
    m.def("unroll_draw", &draw_sheet, nb::arg("camera"), nb::arg("images"), nb::arg("poses"), nb::arg("views"),
          nb::arg("spots"), nb::arg("columns"), nb::arg("rows"), nb::arg("step"), nb::arg("cell"), nb::arg("light"),
          nb::arg("finest"), nb::arg("radius"), nb::arg("reach"), nb::arg("seam"), nb::arg("threads"));
}
