// Python's door to the simulator. pipefish/simulate.py validates scene files and calls this with complete dictionaries.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <thread>

#include "sim/scene.hpp"

namespace nb = nanobind;
using namespace pipefish;

namespace
{

using Points2 = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Points3 = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

template <typename T> T get(nb::handle dict, const char *key)
{
    const nb::object value = nb::borrow<nb::dict>(dict)[key];
    try {
        return nb::cast<T>(value);
    } catch (const nb::cast_error &) {
        throw std::invalid_argument(std::string(key) + " has the wrong type");
    }
}

// A new array of the given shape, owning its memory.
template <typename T> nb::ndarray<nb::numpy, T> make_array(std::initializer_list<size_t> shape)
{
    size_t size = 1;
    for (const size_t n : shape) {
        size *= n;
    }
    T *const data = new T[size]();
    const nb::capsule owner(data, [](void *p) noexcept { delete[] static_cast<T *>(p); });
    return nb::ndarray<nb::numpy, T>(data, shape.size(), shape.begin(), owner);
}

template <typename T, typename Each> nb::ndarray<nb::numpy, T> frame_array(const sim::Scene &scene, const Each &each)
{
    auto out = make_array<T>({scene.frames().size()});
    for (size_t i = 0; i < scene.frames().size(); i++) {
        out.data()[i] = each(scene.frames()[i]);
    }
    return out;
}

std::vector<double> numbers(nb::handle dict, const char *key)
{
    std::vector<double> out;
    for (const nb::handle x : nb::borrow<nb::dict>(dict)[key]) {
        out.push_back(nb::cast<double>(x));
    }
    return out;
}

sim::LensTable lens_of(nb::handle camera)
{
    const nb::object lens = nb::borrow<nb::dict>(camera)["lens"];
    if (get<std::string>(lens, "kind") == "traced") {
        return sim::trace_fisheye(get<double>(lens, "theta_max"), get<double>(lens, "circle_radius_px"),
                                  get<double>(lens, "pupil_scale"));
    }
    return {numbers(lens, "theta"), numbers(lens, "radius_px"), numbers(lens, "pupil")};
}

sim::SurfaceConfig surface_of(nb::handle pipe, uint64_t seed)
{
    const nb::object surface = nb::borrow<nb::dict>(pipe)["surface"], joints = nb::borrow<nb::dict>(pipe)["joints"];
    sim::SurfaceConfig out{get<std::string>(surface, "kind") == "concrete",
                           get<double>(surface, "albedo"),
                           get<double>(surface, "contrast"),
                           {get<double>(joints, "spacing"), get<double>(joints, "first"), get<double>(joints, "width"),
                            get<double>(joints, "darkness")},
                           {},
                           seed};
    for (const nb::handle m : nb::borrow<nb::dict>(pipe)["markers"]) {
        out.markers.push_back(
            {get<double>(m, "s"), get<double>(m, "clock"), get<double>(m, "radius"), get<double>(m, "albedo")});
    }
    return out;
}

sim::SceneConfig config_of(const nb::dict &d)
{
    const nb::object pipe = d["pipe"], camera = d["camera"], light = d["light"], motion = d["motion"];
    const nb::object encoder = d["encoder"], inclinometer = d["inclinometer"];
    sim::SceneConfig c{};
    c.seed = nb::cast<uint64_t>(d["seed"]);
    c.radius = 0.5 * get<double>(pipe, "diameter");
    for (const nb::handle r : nb::borrow<nb::dict>(pipe)["runs"]) {
        c.runs.push_back({get<double>(r, "length"), get<double>(r, "bend_radius"), get<double>(r, "bend_clock")});
    }
    for (const nb::handle o : nb::borrow<nb::dict>(pipe)["ovals"]) {
        c.ovals.push_back({get<double>(o, "from"), get<double>(o, "to"), get<double>(o, "ramp"),
                           get<double>(o, "ratio"), get<double>(o, "clock")});
    }
    c.surface = surface_of(pipe, c.seed);
    c.light = {get<std::string>(light, "kind") == "ring", get<int>(light, "lamps"), get<double>(light, "radius"),
               get<double>(light, "rim_grey")};
    c.camera = {get<int>(camera, "width"),         get<int>(camera, "height"),        get<double>(camera, "c_u"),
                get<double>(camera, "c_v"),        get<double>(camera, "vignetting"), get<double>(camera, "blur"),
                get<double>(camera, "read_noise"), get<double>(camera, "shot_noise"), get<double>(camera, "gamma")};
    c.lens = lens_of(camera);
    c.motion = {get<double>(motion, "start"),     get<double>(motion, "end"),     get<double>(motion, "speed"),
                get<double>(motion, "ramp"),      get<double>(motion, "fps"),     get<double>(motion, "drop"),
                get<double>(motion, "lookahead"), get<double>(motion, "lateral"), get<double>(motion, "roll"),
                get<double>(motion, "pitch"),     get<double>(motion, "yaw")};
    c.sensors = {get<double>(encoder, "metres_per_count"), get<double>(encoder, "scale_bias"),
                 get<double>(encoder, "slip"), get<double>(inclinometer, "sigma")};
    return c;
}

int check_frame(const sim::Scene &scene, int64_t frame)
{
    if (frame < 0 || frame >= static_cast<int64_t>(scene.frames().size())) {
        throw nb::index_error(
            ("frame " + std::to_string(frame) + " of " + std::to_string(scene.frames().size())).c_str());
    }
    return static_cast<int>(frame);
}

nb::object render(sim::Scene &scene, int64_t frame, int threads)
{
    const int index = check_frame(scene, frame);
    auto out = make_array<uint8_t>(
        {static_cast<size_t>(scene.config().camera.height), static_cast<size_t>(scene.config().camera.width)});
    {
        const nb::gil_scoped_release release;
        scene.render(index, threads > 0 ? threads : static_cast<int>(std::thread::hardware_concurrency()), out.data());
    }
    return nb::cast(out);
}

// Applies `map(in, out) -> ok` to n points of `in_dim` coordinates; results are NaN where it fails.
template <typename Map> nb::tuple map_points(size_t n, size_t in_dim, size_t out_dim, const double *in, const Map &map)
{
    auto out = make_array<double>({n, out_dim});
    auto ok = make_array<bool>({n});
    for (size_t i = 0; i < n; i++) {
        double *const item = out.data() + i * out_dim;
        ok.data()[i] = map(in + i * in_dim, item);
        for (size_t k = 0; k < out_dim && !ok.data()[i]; k++) {
            item[k] = std::numeric_limits<double>::quiet_NaN();
        }
    }
    return nb::make_tuple(out, ok);
}

nb::object poses(const sim::Scene &scene)
{
    auto out = make_array<double>({scene.frames().size(), 3, 4});
    for (size_t i = 0; i < scene.frames().size(); i++) {
        const sim::FrameState &f = scene.frames()[i];
        const Eigen::Matrix3d r = f.world_from_cam.transpose();
        const Eigen::Vector3d t = -(r * f.centre);
        for (int row = 0; row < 3; row++) {
            for (int col = 0; col < 4; col++) {
                out.data()[i * 12 + static_cast<size_t>(row * 4 + col)] = col < 3 ? r(row, col) : t(row);
            }
        }
    }
    return nb::cast(out);
}

nb::dict telemetry(const sim::Scene &scene)
{
    using F = sim::FrameState;
    nb::dict out;
    out["time_ns"] = frame_array<int64_t>(scene, [](const F &f) { return f.time_ns; });
    out["s"] = frame_array<double>(scene, [](const F &f) { return f.s; });
    out["arc"] = frame_array<double>(scene, [](const F &f) { return f.arc; });
    out["roll"] = frame_array<double>(scene, [](const F &f) { return f.roll; });
    out["pitch"] = frame_array<double>(scene, [](const F &f) { return f.pitch; });
    out["encoder_count"] = frame_array<int64_t>(scene, [](const F &f) { return f.encoder_count; });
    out["measured_roll"] = frame_array<double>(scene, [](const F &f) { return f.measured_roll; });
    out["measured_pitch"] = frame_array<double>(scene, [](const F &f) { return f.measured_pitch; });
    return out;
}

nb::object sections(const sim::Scene &scene, const Vector &s)
{
    auto out = make_array<double>({s.shape(0), 3});
    for (size_t i = 0; i < s.shape(0); i++) {
        const sim::Section sec = scene.tube().section(s.data()[i]);
        const double e = std::hypot(sec.e_c, sec.e_s), clock = e > 0.0 ? 0.5 * std::atan2(sec.e_s, sec.e_c) : 0.0;
        double *const item = out.data() + 3 * i;
        item[0] = 2.0 * (sec.rho + e);
        item[1] = 2.0 * (sec.rho - e);
        item[2] = clock < 0.0 ? clock + std::numbers::pi : clock;
    }
    return nb::cast(out);
}

nb::tuple lens_table(const sim::Scene &scene)
{
    const sim::LensTable &table = scene.lens().table();
    const auto copy = [](const std::vector<double> &v) {
        auto out = make_array<double>({v.size()});
        std::copy(v.begin(), v.end(), out.data());
        return out;
    };
    return nb::make_tuple(copy(table.theta), copy(table.radius), copy(table.pupil));
}

} // namespace

void bind_sim(nb::module_ &m)
{
    nb::class_<sim::Scene>(m, "SimScene", "A simulated recording; see pipefish.simulate.Scene")
        .def("__init__", [](sim::Scene *self, const nb::dict &config) { new (self) sim::Scene(config_of(config)); })
        .def("render", &render, nb::arg("frame"), nb::arg("threads") = 0)
        .def("poses", &poses)
        .def("telemetry", &telemetry)
        .def("sections", &sections, nb::arg("s"))
        .def("lens_table", &lens_table)
        .def("cast",
             [](const sim::Scene &scene, int64_t frame, const Points2 &px) {
                 const int index = check_frame(scene, frame);
                 return map_points(px.shape(0), 2, 3, px.data(),
                                   [&](const double *in, double *out) { return scene.cast(index, in, out); });
             })
        .def("project",
             [](const sim::Scene &scene, int64_t frame, const Points3 &points) {
                 const int index = check_frame(scene, frame);
                 return map_points(points.shape(0), 3, 2, points.data(),
                                   [&](const double *in, double *out) { return scene.project(index, in, out); });
             })
        .def("wall",
             [](const sim::Scene &scene, const Points2 &s_clock) {
                 return map_points(s_clock.shape(0), 2, 3, s_clock.data(), [&](const double *in, double *out) {
                     Eigen::Map<Eigen::Vector3d>(out, 3) = scene.tube().wall(in[0], in[1]);
                     return true;
                 });
             })
        .def("locate", [](const sim::Scene &scene, const Points3 &points) {
            return map_points(points.shape(0), 3, 3, points.data(), [&](const double *in, double *out) {
                sim::WallPoint at{};
                const bool ok = scene.tube().locate(Eigen::Map<const Eigen::Vector3d>(in), at);
                out[0] = at.s;
                out[1] = at.clock;
                out[2] = at.distance;
                return ok;
            });
        });
}
