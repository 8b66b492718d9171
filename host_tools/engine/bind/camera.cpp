// The camera model and its profile for Python: _engine.Profile is pf_profile itself, so other rooms' bindings take a
// camera as `const pf_profile &`. pipefish/camera.py is the class that people use; it checks types and names keys.
#include "bind/arrays.hpp"
#include "pipefish/profile_integers.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstring>
#include <limits>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace nb = nanobind;

void bind_camera(nb::module_ &m);

namespace
{

template <size_t Columns> using Rows = nb::ndarray<const double, nb::shape<-1, Columns>, nb::c_contig, nb::device::cpu>;

// The batches write 0 or 1 into bytes: as many bools.
static_assert(sizeof(bool) == 1);

template <size_t In, size_t Out, typename Batch>
std::pair<Array<double>, Array<bool>> run_batch(const pf_profile &profile, const Rows<In> &in, Batch batch)
{
    size_t n = in.shape(0);
    std::unique_ptr<double[]> out(new double[n * Out]);
    std::unique_ptr<bool[]> ok(new bool[n]);
    {
        nb::gil_scoped_release release;
        batch(&profile.camera, n, in.data(), out.get(), reinterpret_cast<uint8_t *>(ok.get()));
    }
    return {to_numpy(std::move(out), {n, Out}), to_numpy(std::move(ok), {n})};
}

Array<double> origins(const pf_profile &profile, const Rows<2> &uv)
{
    size_t n = uv.shape(0);
    std::unique_ptr<double[]> rays(new double[n * 3]), out(new double[n * 3]);
    std::unique_ptr<uint8_t[]> ok(new uint8_t[n]);
    {
        nb::gil_scoped_release release;
        pf_camera_unproject_n(&profile.camera, n, uv.data(), rays.get(), out.get(), ok.get());
    }
    return to_numpy(std::move(out), {n, 3});
}

Array<bool> in_image(const pf_profile &profile, const Rows<2> &uv)
{
    size_t n = uv.shape(0);
    std::unique_ptr<bool[]> inside(new bool[n]);
    for (size_t i = 0; i < n; i++)
        inside[i] = pf_camera_in_image(&profile.camera, uv.data() + 2 * i);
    return to_numpy(std::move(inside), {n});
}

nb::tuple project_jacobian(const pf_profile &profile, const Rows<3> &xyz)
{
    constexpr size_t params = PF_CAMERA_PARAMS;
    size_t n = xyz.shape(0);
    std::unique_ptr<double[]> uv(new double[n * 2]), d_xyz(new double[n * 6]), d_param(new double[n * 2 * params]);
    std::unique_ptr<bool[]> ok(new bool[n]);
    {
        nb::gil_scoped_release release;
        for (size_t i = 0; i < n; i++) {
            double *out[] = {uv.get() + 2 * i, d_xyz.get() + 6 * i, d_param.get() + 2 * params * i};
            ok[i] = pf_camera_project(&profile.camera, xyz.data() + 3 * i, out[0], out[1], out[2]) == PF_OK;
            if (!ok[i]) {
                const double nan = std::numeric_limits<double>::quiet_NaN();
                std::fill_n(out[0], 2, nan);
                std::fill_n(out[1], 6, nan);
                std::fill_n(out[2], 2 * params, nan);
            }
        }
    }
    return nb::make_tuple(to_numpy(std::move(uv), {n, 2}), to_numpy(std::move(ok), {n}),
                          to_numpy(std::move(d_xyz), {n, 2, 3}), to_numpy(std::move(d_param), {n, 2, params}));
}

// pf_profile's texts end at a zero, so a zero inside would cut them silently.
template <size_t Size> void set_text(char (&field)[Size], const std::string &text, const char *name)
{
    if (text.size() >= Size || text.find('\0') != std::string::npos)
        throw nb::value_error((std::string(name) + ": not UTF-8 text of at most " + std::to_string(Size - 1) +
                               " bytes without control characters")
                                  .c_str());
    std::memset(field, 0, sizeof field);
    std::memcpy(field, text.data(), text.size());
}

template <auto Field> void bind_text(nb::class_<pf_profile> &type, const char *name)
{
    type.def_prop_rw(
        name, [](const pf_profile &p) { return std::string(p.*Field); },
        [name](pf_profile &p, const std::string &text) { set_text(p.*Field, text, name); });
}

void set_covariance(pf_profile &profile, const std::vector<uint8_t> &params, const std::vector<double> &lower)
{
    size_t n = params.size();
    if (n > PF_PROFILE_FREE_MAX || lower.size() != n * (n + 1) / 2)
        throw nb::value_error("covariance: more than 40 parameters, or not the lower triangle of its parameters");
    profile.free_count = static_cast<uint32_t>(n);
    std::copy(params.begin(), params.end(), profile.free_param);
    std::copy(lower.begin(), lower.end(), profile.covariance);
}

std::vector<std::max_align_t> fixed_workspace(const pf_profile &profile)
{
    return std::vector<std::max_align_t>(pf_camera_fixed_workspace_size(&profile.camera) / sizeof(std::max_align_t) +
                                         1);
}

// With integer self-test vectors wherever the camera can be built in fixed point.
nb::bytes encode(pf_profile &profile)
{
    std::array<uint8_t, PF_PROFILE_BINARY_MAX> buffer;
    size_t n = 0;
    const char *why = nullptr;
    if (pf_camera_check(&profile.camera, &why) != PF_OK)
        throw nb::value_error(why);
    std::vector<std::max_align_t> workspace = fixed_workspace(profile);
    (void)pf_profile_integers_make(&profile, workspace.data(), workspace.size() * sizeof(std::max_align_t));
    if (pf_profile_encode(&profile, buffer.data(), buffer.size(), &n, &why) != PF_OK)
        throw nb::value_error(why);
    return nb::bytes(buffer.data(), n);
}

pf_profile decode(const nb::bytes &bytes)
{
    pf_profile profile;
    const char *why = nullptr;
    if (pf_profile_decode(static_cast<const uint8_t *>(bytes.data()), bytes.size(), &profile, &why) != PF_OK)
        throw nb::value_error(why);
    std::vector<std::max_align_t> workspace = fixed_workspace(profile);
    if (pf_profile_integers_check(&profile, workspace.data(), workspace.size() * sizeof(std::max_align_t), &why) !=
        PF_OK)
        throw nb::value_error(why);
    return profile;
}

template <auto Field> void bind_camera_field(nb::class_<pf_profile> &type, const char *name)
{
    using T = std::remove_reference_t<decltype(std::declval<pf_camera &>().*Field)>;
    if constexpr (std::is_array_v<T>) {
        using Array = std::array<double, std::extent_v<T>>;
        type.def_prop_rw(
            name, [](const pf_profile &p) { return std::to_array(p.camera.*Field); },
            [](pf_profile &p, const Array &value) { std::copy(value.begin(), value.end(), p.camera.*Field); });
    } else {
        type.def_prop_rw(
            name, [](const pf_profile &p) { return p.camera.*Field; },
            [](pf_profile &p, T value) { p.camera.*Field = value; });
    }
}

} // namespace

void bind_camera(nb::module_ &m)
{
    nb::class_<pf_profile> type(m, "Profile", "A calibration profile as the C core holds it (pf_profile).");
    type.def("__init__", [](pf_profile *p) { new (p) pf_profile{}; });
#define FIELD(field) bind_camera_field<&pf_camera::field>(type, #field)
    FIELD(width);
    FIELD(height);
    FIELD(radial);
    FIELD(f_u);
    FIELD(f_v);
    FIELD(skew);
    FIELD(c_u);
    FIELD(c_v);
    FIELD(tilt);
    FIELD(k2);
    FIELD(k3);
    FIELD(k4);
    FIELD(k5);
    FIELD(asym_radial_theta);
    FIELD(asym_radial_phi);
    FIELD(asym_tangential_theta);
    FIELD(asym_tangential_phi);
    FIELD(cpoly);
    FIELD(mirror);
    FIELD(pupil_e1);
    FIELD(theta_max);
    FIELD(circle_u);
    FIELD(circle_v);
    FIELD(circle_radius);
#undef FIELD
    bind_text<&pf_profile::name>(type, "name");
    bind_text<&pf_profile::serial>(type, "serial");
    bind_text<&pf_profile::lens>(type, "lens");
    bind_text<&pf_profile::tool>(type, "tool");
    bind_text<&pf_profile::tool_version>(type, "tool_version");
    bind_text<&pf_profile::model_choice>(type, "model_choice");
    type.def_rw("source", &pf_profile::source)
        .def_rw("created_unix_s", &pf_profile::created_unix_s)
        .def_rw("rms_px", &pf_profile::rms_px)
        .def_rw("theta_covered", &pf_profile::theta_covered)
        .def_rw("held_out_rms_px", &pf_profile::held_out_rms_px)
        .def_rw("views", &pf_profile::views)
        .def_rw("points", &pf_profile::points)
        .def_rw("held_out_views", &pf_profile::held_out_views)
        .def_prop_ro(
            "free_param",
            [](const pf_profile &p) { return std::vector<uint8_t>(p.free_param, p.free_param + p.free_count); })
        .def_prop_ro(
            "covariance",
            [](const pf_profile &p) {
                size_t n = p.free_count;
                return std::vector<double>(p.covariance, p.covariance + n * (n + 1) / 2);
            },
            "The lower triangle by rows.")
        .def("set_covariance", &set_covariance, nb::arg("free_param"), nb::arg("lower"))
        .def("encode", &encode, "The binary form; ValueError 'field: reason' for a profile that is not valid.")
        .def_static("decode", &decode, nb::arg("data"), "Reads the binary form; ValueError 'field: reason'.")
        .def(
            "project",
            [](const pf_profile &p, const Rows<3> &xyz) { return run_batch<3, 2>(p, xyz, pf_camera_project_n); },
            nb::arg("xyz").noconvert(), "(N,3) float64 -> (N,2) float64, (N,) bool; the profile must be valid.")
        .def(
            "unproject",
            [](const pf_profile &p, const Rows<2> &uv) {
                return run_batch<2, 3>(p, uv,
                                       [](const pf_camera *camera, size_t n, const double *in, double *out,
                                          uint8_t *ok) { pf_camera_unproject_n(camera, n, in, out, nullptr, ok); });
            },
            nb::arg("uv").noconvert(), "(N,2) float64 -> (N,3) float64, (N,) bool; the profile must be valid.")
        .def("origins", &origins, nb::arg("uv").noconvert(),
             "(N,2) float64 -> (N,3) float64 metres, NaN where there is no ray; the profile must be valid.")
        .def("in_image", &in_image, nb::arg("uv").noconvert(), "(N,2) float64 -> (N,) bool: on the sensor and lit.")
        .def("project_jacobian", &project_jacobian, nb::arg("xyz").noconvert(),
             "(N,3) float64 -> (N,2) float64, (N,) bool, (N,2,3) by the point, (N,2,41) by the parameters; NaN where "
             "not "
             "valid. The profile need not be one-to-one.");
}
