// The simulator for Python: _engine.Scene. A scene is a dict; every field stands once, in a fields() here or in
// bind/sim_*.hpp, with its range, and serves reading, checking and writing back.
#include "bind/arrays.hpp"
#include "bind/sim_camera.hpp"
#include "bind/sim_light.hpp"
#include "bind/sim_motion.hpp"
#include "bind/sim_wall.hpp"
#include "sim/scene.hpp"

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace nb = nanobind;
using namespace pipefish::sim;

void bind_sim(nb::module_ &m);

namespace pipefish::sim
{

template <typename F> void fields(F &f, Piece &p)
{
    f("length", p.length, 0, 1000);
    f("angle", p.angle, 0, M_PI);
    f("radius", p.radius, 0, 1000);
    f("clock", p.clock, -kTurn, kTurn);
}

template <typename F> void fields(F &f, OvalStretch &o)
{
    f("start", o.start, -1000, 1000);
    f("end", o.end, -1000, 1000);
    f("ramp", o.ramp, 0.001, 1000);
    f("ovality", o.ovality, 0, 0.5);
    f("clock", o.clock, -kTurn, kTurn);
}

template <typename F> void fields(F &f, Marker &m)
{
    f("s", m.s, -1000, 1000);
    f("phi", m.phi, -kTurn, kTurn);
    f("radius", m.radius, 0, 1);
}

template <typename F> void fields(F &f, SceneSpec &s)
{
    f("diameter", s.diameter, 0.02, 10);
    f("pieces", s.pieces);
    f("ovals", s.ovals);
    f("markers", s.markers);
    fields(f, s.features);
    f("texture", s.texture);
    f("lens", s.lens);
    f("lamp", s.lamp);
    f("fog", s.fog);
    f("window", s.window);
    f("exposure", s.exposure);
    f("tone", s.tone);
    f("sensor", s.sensor);
    f("motion", s.motion);
    f("telemetry", s.telemetry);
}

} // namespace pipefish::sim

namespace
{

// What single ranges cannot say.
void check_together(const SceneSpec &s)
{
    if (s.pieces.empty())
        Reader::fail("pieces", "needs at least one");
    for (size_t i = 0; i < s.pieces.size(); i++) {
        const Piece &p = s.pieces[i];
        const std::string where = "pieces[" + std::to_string(i) + "]";
        if (p.angle == 0 && !(p.length > 0))
            Reader::fail(where, "a straight run needs a length, a bend an angle and a radius");
        if (p.angle != 0 && !(p.radius > 0.8 * s.diameter))
            Reader::fail(where + ".radius", "must be above 0.8 diameters, or the wall meets itself");
    }
    double ovality = 0;
    for (size_t i = 0; i < s.ovals.size(); i++) {
        const std::string where = "ovals[" + std::to_string(i) + "]";
        if (!(s.ovals[i].end > s.ovals[i].start))
            Reader::fail(where + ".end", "must lie behind start");
        if (!(s.ovals[i].start + 2 * s.ovals[i].ramp <= s.ovals[i].end))
            Reader::fail(where + ".ramp", "must be at most half the stretch");
        ovality += s.ovals[i].ovality;
        if (ovality > 0.5)
            Reader::fail(where + ".ovality", "all stretches together must be at most 0.5");
    }
    check_wall(s.features);
    check_light(s.lamp, s.diameter);
    double length = 0;
    for (const Piece &p : s.pieces)
        length += p.angle != 0 ? p.angle * p.radius : p.length;
    check_camera(s.lens, s.sensor);
    check_motion(s.motion, s.diameter, length);
}

SceneSpec read_scene(const nb::dict &source)
{
    SceneSpec spec;
    Reader reader(source, "");
    fields(reader, spec);
    reader.finish();
    check_together(spec);
    return spec;
}

using Points2 = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Points3 = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

nb::object ok_mask(std::vector<uint8_t> &&ok)
{
    const size_t n = ok.size();
    return nb::cast(to_numpy(std::move(ok), {n})).attr("astype")("bool");
}

int checked_frame(const Scene &scene, int frame)
{
    if (frame < 0 || frame >= scene.spec().motion.frames)
        throw nb::index_error("no such frame");
    return frame;
}

const FrameState &state(const Scene &scene, int frame)
{
    return scene.frames()[static_cast<size_t>(checked_frame(scene, frame))];
}

// Applies map(in, out) -> ok to each row of the points; rows where it fails are NaN.
template <size_t In, size_t Out, typename Points, typename Map>
nb::tuple map_points(const Points &points, const Map &map)
{
    const size_t n = points.shape(0);
    std::vector<double> out(Out * n, NAN);
    std::vector<uint8_t> ok(n, 0);
    for (size_t i = 0; i < n; i++) {
        double item[Out];
        ok[i] = map(points.data() + In * i, item);
        if (ok[i])
            std::copy(item, item + Out, out.data() + Out * i);
    }
    return nb::make_tuple(to_numpy(std::move(out), {n, Out}), ok_mask(std::move(ok)));
}

} // namespace

void bind_sim(nb::module_ &m)
{
    nb::class_<Scene>(m, "Scene", "A simulated pipe with a camera driving through it; docs/simulator.md.")
        .def(
            "__init__",
            [](Scene *self, const nb::dict &source) {
                const SceneSpec spec = read_scene(source);
                try {
                    new (self) Scene(spec);
                } catch (const SpecError &error) {
                    throw nb::value_error(error.what());
                } catch (const std::invalid_argument &error) { // what only the lens knows; the rest is checked above
                    Reader::fail("lens", error.what());
                }
            },
            nb::arg("scene"))
        .def_prop_ro("spec",
                     [](const Scene &s) {
                         SceneSpec spec = s.spec();
                         Writer writer;
                         fields(writer, spec);
                         return writer.out;
                     })
        .def(
            "render",
            [](Scene &s, int frame, int threads) {
                checked_frame(s, frame);
                const size_t height = static_cast<size_t>(s.spec().lens.height);
                const size_t width = static_cast<size_t>(s.spec().lens.width);
                const auto draw = [&](auto pixel) {
                    std::vector<decltype(pixel)> image(height * width);
                    {
                        nb::gil_scoped_release release;
                        s.render(frame, threads, image.data());
                    }
                    return nb::cast(to_numpy(std::move(image), {height, width}));
                };
                return s.spec().sensor.bits > 8 ? draw(uint16_t{}) : draw(uint8_t{});
            },
            nb::arg("frame"), nb::arg("threads"), "(height, width) uint8, or uint16 of 10 bits.")
        .def(
            "pose",
            [](const Scene &s, int frame, double row) {
                const CameraState camera = s.camera(checked_frame(s, frame), row);
                const Eigen::Matrix3d rotation = camera.world_from_cam.transpose();
                Eigen::Matrix<double, 3, 4, Eigen::RowMajor> out;
                out << rotation, -rotation * camera.centre;
                return out;
            },
            nb::arg("frame"), nb::arg("row"), "cam_from_world in the middle of that row's exposure, (3, 4).")
        .def(
            "row_time", [](const Scene &s, int frame, double row) { return s.row_time(checked_frame(s, frame), row); },
            nb::arg("frame"), nb::arg("row"), "Of the middle of that row's exposure, seconds since that of frame 0.")
        .def(
            "arc_length", [](const Scene &s, int frame) { return state(s, frame).s; }, nb::arg("frame"),
            "Of the camera's place along the pipe, metres.")
        .def(
            "driven", [](const Scene &s, int frame) { return state(s, frame).arc; }, nb::arg("frame"),
            "What the crawler has driven since frame 0, metres.")
        .def(
            "attitude",
            [](const Scene &s, int frame) { return std::make_pair(state(s, frame).roll, state(s, frame).pitch); },
            nb::arg("frame"), "True roll and pitch, radians.")
        .def(
            "pushed", [](const Scene &s, int frame) { return state(s, frame).pushed; }, nb::arg("frame"),
            "Cable pushed since frame 0, metres.")
        .def(
            "dropped",
            [](const Scene &s, int frame) {
                return s.readings()[static_cast<size_t>(checked_frame(s, frame))].dropped;
            },
            nb::arg("frame"), "Whether the frame never arrives.")
        .def(
            "telemetry",
            [](const Scene &s, int frame) {
                const Reading &r = s.readings()[static_cast<size_t>(checked_frame(s, frame))];
                return std::make_tuple(r.time_ns, r.encoder_count, r.roll, r.pitch);
            },
            nb::arg("frame"), "(time_ns, encoder_count, roll, pitch) as the sensors say.")
        .def(
            "light_level",
            [](Scene &s, int frame) {
                checked_frame(s, frame);
                return s.light_level(frame);
            },
            nb::arg("frame"), "Factor of the frame's light: flicker times the exposure's gain.")
        .def(
            "cast",
            [](const Scene &s, int frame, const Points2 &px) {
                FrameView view(s, checked_frame(s, frame));
                return map_points<2, 3>(px, [&](const double *in, double *out) {
                    Seen seen{};
                    const bool ok = s.see(view, in, seen);
                    std::copy_n(seen.point.data(), 3, out);
                    return ok;
                });
            },
            nb::arg("frame"), nb::arg("px"), "(N, 2) pixels -> surface points (N, 3) in metres, ok (N,).")
        .def(
            "sights",
            [](const Scene &s, int frame, const Points2 &px) {
                FrameView view(s, checked_frame(s, frame));
                return map_points<2, 14>(px, [&](const double *in, double *out) {
                    Seen seen{};
                    if (!s.see(view, in, seen))
                        return false;
                    const Sight &sight = seen.sight;
                    const Hit &hit = sight.first;
                    std::copy_n(seen.point.data(), 3, out);
                    std::copy_n(seen.normal.data(), 3, out + 3);
                    const double rest[] = {hit.s, hit.clock, static_cast<double>(hit.material),
                                           static_cast<double>(hit.part)};
                    std::copy_n(rest, 4, out + 6);
                    const bool water = hit.material == Material::WATER;
                    std::fill_n(out + 10, 3, NAN);
                    if (water && sight.mirrors)
                        std::copy_n(seen.mirrored.data(), 3, out + 10);
                    out[13] = water ? sight.mirrored : 0.0;
                    return true;
                });
            },
            nb::arg("frame"), nb::arg("px"),
            "(N, 2) pixels -> (N, 14): point, normal, s, clock, material, part, mirrored point, mirrored share; ok.")
        .def(
            "project",
            [](const Scene &s, int frame, const Points3 &points) {
                checked_frame(s, frame);
                return map_points<3, 2>(points,
                                        [&](const double *in, double *out) { return s.project(frame, in, out); });
            },
            nb::arg("frame"), nb::arg("points"), "World points (N, 3) -> pixels (N, 2), ok (N,).")
        .def(
            "visible",
            [](const Scene &s, int frame, const Points3 &points) {
                FrameView view(s, checked_frame(s, frame));
                return map_points<3, 2>(points,
                                        [&](const double *in, double *out) { return s.visible(view, in, out); });
            },
            nb::arg("frame"), nb::arg("points"), "As project, but ok is false also where something stands between.")
        .def(
            "flow",
            [](const Scene &s, int a, int b, const Points2 &px) {
                FrameView view_a(s, checked_frame(s, a)), view_b(s, checked_frame(s, b));
                return map_points<2, 2>(px,
                                        [&](const double *in, double *out) { return s.flow(view_a, view_b, in, out); });
            },
            nb::arg("a"), nb::arg("b"), nb::arg("px"), "(N, 2) pixels of frame a -> (N, 2) pixels of frame b, ok (N,).")
        .def(
            "locate",
            [](const Scene &s, const Points3 &points) {
                return map_points<3, 3>(points, [&s](const double *in, double *out) {
                    WallPoint at{};
                    const bool ok = s.tube().locate(Eigen::Map<const Eigen::Vector3d>(in), at);
                    out[0] = at.s;
                    out[1] = at.distance;
                    out[2] = at.clock;
                    return ok;
                });
            },
            nb::arg("points"),
            "World points (N, 3) -> arc length, distance from the axis, clock angle (N, 3), ok (N,).")
        .def(
            "wall", [](const Scene &s, double at, double phi) { return s.tube().wall(at, phi); }, nb::arg("s"),
            nb::arg("phi"), "The wall point at arc length s and clock angle phi, (3,).")
        .def(
            "wall_radius", [](const Scene &s, double at, double phi) { return s.tube().wall_radius(at, phi); },
            nb::arg("s"), nb::arg("phi"), "From the axis to the wall, metres.")
        .def_prop_ro(
            "joints",
            [](const Scene &s) {
                nb::list out;
                for (JointSpec joint : s.tube().joints()) {
                    Writer writer;
                    fields(writer, joint);
                    out.append(writer.out);
                }
                return out;
            },
            "All joints, those of the series among them, in order.")
        .def(
            "crack_path",
            [](const Scene &s, size_t crack) {
                std::vector<std::pair<double, double>> out;
                for (const PathPoint &p : s.tube().cracks().at(crack).path())
                    out.emplace_back(p.s, p.phi);
                return out;
            },
            nb::arg("crack"), "Its corners (s, phi), with the meander.")
        .def(
            "section",
            [](const Scene &s, double at) {
                const Section x = s.tube().section(at);
                const double e = std::hypot(x.e_c, x.e_s), clock = e > 0 ? 0.5 * std::atan2(x.e_s, x.e_c) : 0.0;
                return std::make_tuple(2 * (x.rho + e), 2 * (x.rho - e), clock < 0 ? clock + M_PI : clock);
            },
            nb::arg("s"), "(D_max, D_min, clock angle of D_max in [0, pi)) at arc length s.")
        .def(
            "lens",
            [](const Scene &s, double theta) { return std::make_pair(s.lens().radius(theta), s.lens().pupil(theta)); },
            nb::arg("theta"), "(image radius in pixels, pupil shift in metres) of a field angle.")
        .def_prop_ro(
            "lens_nodes", [](const Scene &s) { return s.lens().table().theta; }, "The table's angles.")
        .def_prop_ro("circle_radius", [](const Scene &s) { return s.lens().circle_radius(); })
        .def_prop_ro("length", [](const Scene &s) { return s.tube().length(); });
}
