// Sheets before the simulator's camera, for Python: _engine.Texture, _engine.Picture, _engine.Studio.
#include "bind/arrays.hpp"
#include "bind/sim_camera.hpp"
#include "parallel.hpp"
#include "sim/studio.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include <memory>

namespace nb = nanobind;
using namespace pipefish::sim;

void bind_sim_studio(nb::module_ &m);

namespace pipefish::sim
{

template <> struct Names<Outline> {
    static constexpr std::array values = {"rectangle", "round"};
};

template <typename F> void fields(F &f, Monomial &m)
{
    f("i", m.i, 0, 12);
    f("j", m.j, 0, 12);
    f("metres", m.metres, -10, 10);
}

template <typename F> void fields(F &f, Wave &w)
{
    f("u_rate", w.u_rate, -200, 200);
    f("v_rate", w.v_rate, -200, 200);
    f("phase", w.phase, -kTurn, kTurn);
    f("metres", w.metres, -10, 10);
}

template <typename F> void fields(F &f, Relief &r)
{
    f("powers", r.powers);
    f("waves", r.waves);
}

template <typename F> void fields(F &f, OutlineWave &w)
{
    f("k", w.k, 1, 20);
    f("share", w.share, -0.5, 0.5);
    f("phase", w.phase, -kTurn, kTurn);
}

template <typename F> void fields(F &f, Shadow &s)
{
    f("angle", s.angle, -kTurn, kTurn);
    f("offset", s.offset, -2, 2);
    f("soft", s.soft, 1e-6, 2);
    f("share", s.share, 0, 2);
}

template <typename F> void fields(F &f, SheetSpec &s)
{
    f("width", s.width, 1e-6, 1000);
    f("height", s.height, 1e-6, 1000);
    f("outline", s.outline);
    f("outline_waves", s.outline_waves);
    f("curvature", s.curvature, -1000, 1000);
    f("relief", s.relief);
    f("stretch_a", s.stretch_a);
    f("stretch_b", s.stretch_b);
    f("pose", s.pose, -1000, 1000);
    f("texture", s.texture, 0, 1e6);
    f("back", s.back, 0, 1);
    f("gain", s.gain, 0, 10);
    f("light", s.light);
    f("shadows", s.shadows);
}

template <typename F> void fields(F &f, PointLamp &l)
{
    f("x", l.x, -1000, 1000);
    f("y", l.y, -1000, 1000);
    f("z", l.z, -1000, 1000);
    f("power", l.power, 0, 1e6);
}

template <typename F> void fields(F &f, PictureSpec &p)
{
    f("frame", p.frame, 0, 1e9);
    f("sheets", p.sheets);
    f("lamps", p.lamps);
    f("ambient", p.ambient, 0, 1e4);
    f("nothing", p.nothing, 0, 1e4);
    f("gain", p.gain, 0, 100);
    f("bias", p.bias, -255, 255);
    f("gamma", p.gamma, 0.2, 5);
}

template <typename F> void fields(F &f, PatternSpec &p)
{
    f("seed", p.seed, 0, kMaxSeed);
    f("rows", p.rows, 16, 8192);
    f("columns", p.columns, 16, 8192);
    f("coarse", p.coarse, 4, 4096);
    f("fine", p.fine, 4, 4096);
    f("fall", p.fall, 0.1, 2);
    f("contrast", p.contrast, 0, 1);
    f("blots", p.blots, 0, 4);
}

} // namespace pipefish::sim

namespace
{

struct CameraSpec {
    LensSpec lens;
    SensorSpec sensor;
};

template <typename F> void fields(F &f, CameraSpec &c)
{
    f("lens", c.lens);
    f("sensor", c.sensor);
}

template <typename Spec> Spec read(const nb::dict &source)
{
    Spec spec;
    Reader reader(source, "");
    fields(reader, spec);
    reader.finish();
    return spec;
}

// Makes what may throw std::invalid_argument "where: what", which Python sees as a ValueError.
template <typename Make> auto checked(const Make &make)
{
    try {
        return make();
    } catch (const std::invalid_argument &error) {
        throw nb::value_error(error.what());
    }
}

using Rows = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Numbers = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void needs_columns(const Rows &array, size_t columns)
{
    if (array.shape(1) != columns)
        throw nb::value_error(("array: needs " + std::to_string(columns) + " columns").c_str());
}

nb::object render(const Studio &studio, const Picture &picture, int samples, int threads)
{
    const size_t height = static_cast<size_t>(studio.lens_spec().height);
    const size_t width = static_cast<size_t>(studio.lens_spec().width);
    const auto draw = [&](auto pixel) {
        std::vector<decltype(pixel)> image(height * width);
        checked([&] {
            nb::gil_scoped_release release;
            studio.render(picture, samples, threads, image.data());
        });
        return nb::cast(to_numpy(std::move(image), {height, width}));
    };
    return studio.sensor_spec().bits > 8 ? draw(uint16_t{}) : draw(uint8_t{});
}

nb::tuple look(const Studio &studio, const Picture &picture, const Rows &px, int threads)
{
    needs_columns(px, 2);
    const size_t n = px.shape(0);
    std::vector<int32_t> sheet(n, -1);
    std::vector<uint8_t> back(n, 0);
    std::vector<double> at(2 * n, NAN), points(3 * n, NAN), white(n, NAN);
    {
        nb::gil_scoped_release release;
        constexpr size_t BLOCK = 1024;
        pipefish::parallel_for(static_cast<int>((n + BLOCK - 1) / BLOCK), threads, [&](int block) {
            const size_t first = static_cast<size_t>(block) * BLOCK;
            for (size_t i = first; i < std::min(n, first + BLOCK); i++) {
                Sighting seen;
                Eigen::Vector3d point;
                if (studio.look(picture, px.data() + 2 * i, seen, point) && seen.sheet >= 0) {
                    sheet[i] = seen.sheet;
                    back[i] = seen.hit.back;
                    at[2 * i] = seen.hit.a;
                    at[2 * i + 1] = seen.hit.b;
                    std::copy(point.data(), point.data() + 3, points.data() + 3 * i);
                    white[i] = picture.light(seen) * studio.vignetting(px.data()[2 * i], px.data()[2 * i + 1]);
                }
            }
        });
    }
    return nb::make_tuple(to_numpy(std::move(sheet), {n}), to_numpy(std::move(back), {n}),
                          to_numpy(std::move(at), {n, 2}), to_numpy(std::move(points), {n, 3}),
                          to_numpy(std::move(white), {n}));
}

nb::object place(const Picture &picture, const Numbers &sheet, const Rows &at)
{
    needs_columns(at, 2);
    const size_t n = at.shape(0);
    std::vector<double> points(3 * n, NAN);
    if (sheet.shape(0) != n)
        throw nb::value_error("sheet: as many as coordinates");
    for (size_t i = 0; i < n; i++) {
        const int k = sheet.data()[i];
        if (k >= static_cast<int>(picture.sheets().size()))
            throw nb::index_error("no such sheet");
        if (k < 0)
            continue;
        const Eigen::Vector3d p =
            picture.sheets()[static_cast<size_t>(k)].place(at.data()[2 * i], at.data()[2 * i + 1]);
        std::copy(p.data(), p.data() + 3, points.data() + 3 * i);
    }
    return nb::cast(to_numpy(std::move(points), {n, 3}));
}

nb::tuple project(const Studio &studio, const Rows &points)
{
    needs_columns(points, 3);
    const size_t n = points.shape(0);
    std::vector<double> px(2 * n, NAN);
    std::vector<uint8_t> ok(n, 0);
    for (size_t i = 0; i < n; i++) {
        double at[2];
        if (studio.project(Eigen::Map<const Eigen::Vector3d>(points.data() + 3 * i), at)) {
            ok[i] = 1;
            std::copy(at, at + 2, px.data() + 2 * i);
        }
    }
    return nb::make_tuple(to_numpy(std::move(px), {n, 2}), to_numpy(std::move(ok), {n}));
}

std::shared_ptr<Texture> make_print(const Rows &figures, double ground)
{
    needs_columns(figures, 6);
    std::vector<Figure> list;
    for (size_t i = 0; i < figures.shape(0); i++) {
        const double *const f = figures.data() + 6 * i;
        if (!(f[3] > 0 && f[4] > 0 && f[5] >= 0 && f[5] <= 1))
            throw nb::value_error("figures: half sizes above 0, albedo within 0 and 1");
        list.push_back({f[0] != 0, f[1], f[2], f[3], f[4], f[5]});
    }
    return std::make_shared<Texture>(Print(std::move(list), ground));
}

std::shared_ptr<Texture> make_raster(const nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu> &image)
{
    const size_t rows = image.shape(0), columns = image.shape(1);
    if (rows < 2 || columns < 2 || rows > 32768 || columns > 32768)
        throw nb::value_error("raster: 2 to 32768 rows and columns");
    return std::make_shared<Texture>(Raster(std::vector<float>(image.data(), image.data() + rows * columns),
                                            static_cast<int>(rows), static_cast<int>(columns)));
}

} // namespace

void bind_sim_studio(nb::module_ &m)
{
    nb::class_<Texture>(m, "Texture", "What is on a sheet.")
        .def_static("print", &make_print, nb::arg("figures"), nb::arg("ground"),
                    "Rows (round, a, b, half_a, half_b, albedo), metres from the sheet's middle, on a ground.")
        .def_static("raster", &make_raster, nb::arg("albedo"), "(H, W) float32, stretched over the sheet.");
    m.def(
        "draw_pattern",
        [](const nb::dict &source) {
            const PatternSpec spec = read<PatternSpec>(source);
            return nb::cast(
                to_numpy(draw_pattern(spec), {static_cast<size_t>(spec.rows), static_cast<size_t>(spec.columns)}));
        },
        nb::arg("pattern"), "A rich band-limited texture, (rows, columns) float32.");
    nb::class_<Picture>(m, "Picture", "Sheets, ready to be looked at; docs/simulator.md.")
        .def(
            "__init__",
            [](Picture *self, const nb::dict &source, std::vector<std::shared_ptr<Texture>> textures) {
                const PictureSpec spec = read<PictureSpec>(source);
                checked([&] { new (self) Picture(spec, {textures.begin(), textures.end()}); });
            },
            nb::arg("picture"), nb::arg("textures"))
        .def_prop_ro("spec",
                     [](const Picture &p) {
                         PictureSpec spec = p.spec();
                         Writer writer;
                         fields(writer, spec);
                         return writer.out;
                     })
        .def("place", &place, nb::arg("sheet"), nb::arg("at"),
             "Sheets' numbers (N,) int32 and texture coordinates (N, 2) -> points in the camera's frame (N, 3).");
    nb::class_<Studio>(m, "Studio", "The simulator's lens and sensor before sheets.")
        .def(
            "__init__",
            [](Studio *self, const nb::dict &source) {
                const CameraSpec spec = read<CameraSpec>(source);
                check_camera(spec.lens, spec.sensor);
                try {
                    new (self) Studio(spec.lens, spec.sensor);
                } catch (const std::invalid_argument &error) {
                    Reader::fail("lens", error.what());
                }
            },
            nb::arg("camera"))
        .def_prop_ro("spec",
                     [](const Studio &s) {
                         CameraSpec spec{s.lens_spec(), s.sensor_spec()};
                         Writer writer;
                         fields(writer, spec);
                         return writer.out;
                     })
        .def("render", &render, nb::arg("picture"), nb::arg("samples"), nb::arg("threads"),
             "(height, width) uint8, or uint16 of 10 bits.")
        .def("look", &look, nb::arg("picture"), nb::arg("px"), nb::arg("threads"),
             "(N, 2) pixels -> sheet (N,) (-1 none), back (N,), texture coordinates (N, 2), points in the camera's "
             "frame "
             "(N, 3), grey level of a white sheet (N,) before bias and gamma, with vignetting.")
        .def("project", &project, nb::arg("points"), "(N, 3) in the camera's frame -> (N, 2) pixels, ok (N,).")
        .def(
            "lens",
            [](const Studio &s, double theta) { return nb::make_tuple(s.lens().radius(theta), s.lens().pupil(theta)); },
            nb::arg("theta"), "(image radius in pixels, pupil shift in metres) of a field angle.")
        .def_prop_ro("lens_nodes", [](const Studio &s) { return s.lens().table().theta; });
}
