// The simulator for Python: _engine.Scene. A scene is a dict; every field stands once, in the fields() below, with its
// range, and serves reading, checking and writing back.
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

namespace
{

constexpr double kTurn = 2 * M_PI;
constexpr double kMaxSeed = 9007199254740992.0; // 2^53: JSON numbers are exact to there

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

template <typename F> void fields(F &f, TextureSpec &t)
{
    f("seed", t.seed, 0, kMaxSeed);
    f("contrast", t.contrast, 0, 3);
    f("joint_spacing", t.joint_spacing, 0, 100);
}

template <typename F> void fields(F &f, LensNode &n)
{
    f("theta", n.theta, 0, 3);
    f("radius_px", n.radius_px, 0, 20000);
    f("pupil_m", n.pupil_m, -0.1, 0.1);
}

template <typename F> void fields(F &f, LensSpec &l)
{
    f("width", l.width, 64, 8192);
    f("height", l.height, 64, 8192);
    f("c_u", l.c_u, -8192, 16384);
    f("c_v", l.c_v, -8192, 16384);
    f("theta_max", l.theta_max, 0.1, 3);
    f("circle_radius", l.circle_radius, 10, 10000);
    f("pupil_scale", l.pupil_scale, 0, 10);
    f("zonal_px", l.zonal_px, 0, 2);
    f("vignetting", l.vignetting, 0, 1);
    f("table", l.table);
}

template <typename F> void fields(F &f, LampSpec &l)
{
    f("lamps", l.lamps, 1, 64);
    f("ring_radius", l.ring_radius, 0, 1);
    f("side", l.side, 0, 10);
    f("forward", l.forward, 0, 10);
    f("exposure", l.exposure, 0, 1e5);
}

template <typename F> void fields(F &f, SensorSpec &s)
{
    f("seed", s.seed, 0, kMaxSeed);
    f("blur_px", s.blur_px, 0, 5);
    f("read_noise", s.read_noise, 0, 50);
    f("shot_noise", s.shot_noise, 0, 5);
}

template <typename F> void fields(F &f, MotionSpec &m)
{
    f("seed", m.seed, 0, kMaxSeed);
    f("frames", m.frames, 1, 1e6);
    f("frame_rate", m.frame_rate, 0.1, 1000);
    f("start", m.start, -100, 1000);
    f("speed", m.speed, 0, 10);
    f("ramp", m.ramp, 0, 1000);
    f("below_axis", m.below_axis, -1, 1);
    f("lookahead", m.lookahead, 0.01, 10);
    f("wobble_m", m.wobble_m, 0, 0.1);
    f("wobble_rad", m.wobble_rad, 0, 0.5);
    f("metres_per_count", m.metres_per_count, 1e-6, 1);
    f("encoder_bias", m.encoder_bias, -0.5, 0.5);
    f("encoder_slip", m.encoder_slip, 0, 0.1);
    f("attitude_sigma", m.attitude_sigma, 0, 0.5);
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
    f("sensor", s.sensor);
    f("motion", s.motion);
}

// Reads one dict into a struct; a key that nobody asked for is an error that lists those allowed.
class Reader
{
public:
    Reader(nb::handle source, std::string path) : path_(std::move(path))
    {
        if (!nb::isinstance<nb::dict>(source))
            fail(path_, "must be an object");
        source_ = nb::borrow<nb::dict>(source);
    }

    template <typename T> void operator()(const char *name, T &value, double least, double most)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        double number = 0;
        if (nb::isinstance<nb::bool_>(item) || !nb::try_cast<double>(item, number))
            fail(path_ + name, "must be a number");
        if (std::is_integral_v<T> && number != std::floor(number))
            fail(path_ + name, "must be a whole number");
        if (!(number >= least && number <= most))
            fail(path_ + name, "must be within " + text(least) + " and " + text(most) + ", not " + text(number));
        value = static_cast<T>(number);
    }

    template <typename T> void operator()(const char *name, std::vector<T> &list)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        if (!nb::isinstance<nb::list>(item))
            fail(path_ + name, "must be a list");
        list.clear();
        for (nb::handle entry : nb::borrow<nb::list>(item)) {
            Reader reader(entry, path_ + name + "[" + std::to_string(list.size()) + "].");
            fields(reader, list.emplace_back());
            reader.finish();
        }
    }

    void operator()(const char *name, std::vector<double> &list, double least, double most)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        if (!nb::try_cast<std::vector<double>>(item, list))
            fail(path_ + name, "must be a list of numbers");
        for (size_t i = 0; i < list.size(); i++)
            if (!(list[i] >= least && list[i] <= most))
                fail(path_ + name + "[" + std::to_string(i) + "]",
                     "must be within " + text(least) + " and " + text(most) + ", not " + text(list[i]));
    }

    template <typename T> void operator()(const char *name, T &part)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        Reader reader(item, path_ + name + ".");
        fields(reader, part);
        reader.finish();
    }

    void finish() const
    {
        for (auto [key, value] : source_) {
            const std::string name = nb::cast<std::string>(nb::str(key));
            if (known_.find(" " + name + ",") == std::string::npos)
                fail(path_ + name, "unknown; known are" + known_.substr(0, known_.size() - 1));
        }
    }

    [[noreturn]] static void fail(const std::string &where, const std::string &what)
    {
        throw nb::value_error((where + ": " + what).c_str());
    }

private:
    nb::dict source_;
    std::string path_, known_;

    nb::handle take(const char *name)
    {
        known_ += std::string(" ") + name + ",";
        return source_.contains(name) ? nb::handle(PyDict_GetItemString(source_.ptr(), name)) : nb::handle();
    }

    static std::string text(double v) { return nb::cast<std::string>(nb::str(nb::float_(v))); }
};

class Writer
{
public:
    nb::dict out;

    template <typename T> void operator()(const char *name, T &value, double, double) { out[name] = nb::cast(value); }

    template <typename T> void operator()(const char *name, std::vector<T> &list)
    {
        nb::list items;
        for (T &entry : list) {
            Writer writer;
            fields(writer, entry);
            items.append(writer.out);
        }
        out[name] = items;
    }

    template <typename T> void operator()(const char *name, T &part)
    {
        Writer writer;
        fields(writer, part);
        out[name] = writer.out;
    }
};

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
    for (size_t i = 0; i < s.features.cracks.size(); i++)
        if (s.features.cracks[i].path.size() < 2)
            Reader::fail("cracks[" + std::to_string(i) + "].path", "needs at least two points");
    if (s.lamp.ring_radius > 0.25 * s.diameter)
        Reader::fail("lamp.ring_radius", "must be at most a quarter of the pipe's diameter");
    const double ride = std::abs(s.motion.below_axis) + 2 * s.motion.wobble_m;
    if (ride > 0.4 * s.diameter)
        Reader::fail("motion.below_axis", "the camera would leave the pipe");
    const double end = s.motion.start + s.motion.speed * (s.motion.frames - 1) / s.motion.frame_rate;
    double length = 0;
    for (const Piece &p : s.pieces)
        length += p.angle != 0 ? p.angle * p.radius : p.length;
    if (s.motion.start < -0.4 || end > length + 0.4)
        Reader::fail("motion", "the camera would drive out of the pipe's " + std::to_string(length) + " m");
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

template <typename T> auto to_numpy(std::vector<T> &&values, std::initializer_list<size_t> shape)
{
    auto *kept = new std::vector<T>(std::move(values));
    nb::capsule owner(kept, [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return nb::ndarray<nb::numpy, T>(kept->data(), shape, owner);
}

nb::object ok_mask(std::vector<uint8_t> &&ok)
{
    const size_t n = ok.size();
    return nb::cast(to_numpy<uint8_t>(std::move(ok), {n})).attr("astype")("bool");
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
    return nb::make_tuple(to_numpy<double>(std::move(out), {n, Out}), ok_mask(std::move(ok)));
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
                std::vector<uint8_t> image(height * width);
                {
                    nb::gil_scoped_release release;
                    s.render(frame, threads, image.data());
                }
                return to_numpy<uint8_t>(std::move(image), {height, width});
            },
            nb::arg("frame"), nb::arg("threads"), "(height, width) uint8.")
        .def(
            "pose",
            [](const Scene &s, int frame) {
                const FrameState &f = state(s, frame);
                const Eigen::Matrix3d rotation = f.world_from_cam.transpose();
                Eigen::Matrix<double, 3, 4, Eigen::RowMajor> out;
                out << rotation, -rotation * f.centre;
                return out;
            },
            nb::arg("frame"), "cam_from_world, (3, 4).")
        .def(
            "arc_length", [](const Scene &s, int frame) { return state(s, frame).s; }, nb::arg("frame"),
            "Of the camera's place along the pipe, metres.")
        .def(
            "driven", [](const Scene &s, int frame) { return state(s, frame).arc; }, nb::arg("frame"),
            "What the crawler has driven since frame 0, metres.")
        .def(
            "telemetry",
            [](const Scene &s, int frame) {
                const FrameState &f = state(s, frame);
                return std::make_tuple(f.time_ns, f.encoder_count, f.measured_roll, f.measured_pitch);
            },
            nb::arg("frame"), "(time_ns, encoder_count, roll, pitch) as the sensors say.")
        .def(
            "cast",
            [](const Scene &s, int frame, const Points2 &px) {
                const Tube::View view = s.view(checked_frame(s, frame));
                return map_points<2, 3>(px, [&](const double *in, double *out) {
                    Seen seen{};
                    const bool ok = s.see(view, frame, in, seen);
                    std::copy_n(seen.point.data(), 3, out);
                    return ok;
                });
            },
            nb::arg("frame"), nb::arg("px"), "(N, 2) pixels -> surface points (N, 3) in metres, ok (N,).")
        .def(
            "sights",
            [](const Scene &s, int frame, const Points2 &px) {
                const Tube::View view = s.view(checked_frame(s, frame));
                return map_points<2, 14>(px, [&](const double *in, double *out) {
                    Seen seen{};
                    if (!s.see(view, frame, in, seen))
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
                const Tube::View view = s.view(checked_frame(s, frame));
                return map_points<3, 2>(points,
                                        [&](const double *in, double *out) { return s.visible(view, frame, in, out); });
            },
            nb::arg("frame"), nb::arg("points"), "As project, but ok is false also where something stands between.")
        .def(
            "flow",
            [](const Scene &s, int a, int b, const Points2 &px) {
                const Tube::View view_a = s.view(checked_frame(s, a)), view_b = s.view(checked_frame(s, b));
                return map_points<2, 2>(
                    px, [&](const double *in, double *out) { return s.flow(view_a, a, view_b, b, in, out); });
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
