// The camera model and its profile for Python: _engine.Profile is pf_profile itself, so other rooms' bindings take a
// camera as `const pf_profile &`. pipefish/camera.py is the class that people use; it checks types and names keys.
#include "pipefish/profile.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cstring>
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
using Numbers = nb::ndarray<nb::numpy, double>;
using Mask = nb::ndarray<nb::numpy, bool>;

template <typename T> nb::ndarray<nb::numpy, T> to_numpy(std::unique_ptr<T[]> data, std::initializer_list<size_t> shape)
{
    T *raw = data.get();
    nb::capsule owner(data.release(), [](void *p) noexcept { delete[] static_cast<T *>(p); });
    return nb::ndarray<nb::numpy, T>(raw, shape, owner);
}

// The batches write 0 or 1 into bytes: as many bools.
static_assert(sizeof(bool) == 1);

template <size_t In, size_t Out, typename Batch>
std::pair<Numbers, Mask> run_batch(const pf_profile &profile, const Rows<In> &in, Batch batch)
{
    size_t n = in.shape(0);
    std::unique_ptr<double[]> out(new double[n * Out]);
    std::unique_ptr<bool[]> ok(new bool[n]);
    {
        nb::gil_scoped_release release;
        batch(&profile.camera, n, in.data(), out.get(), reinterpret_cast<uint8_t *>(ok.get()));
    }
    return {to_numpy<double>(std::move(out), {n, Out}), to_numpy<bool>(std::move(ok), {n})};
}

// pf_profile's texts end at a zero, so a zero inside would cut them silently.
void set_text(char (&field)[PF_PROFILE_NAME_MAX], const std::string &text, const char *name)
{
    if (text.size() >= PF_PROFILE_NAME_MAX || text.find('\0') != std::string::npos)
        throw nb::value_error(
            (std::string(name) + ": not UTF-8 text of at most 63 bytes without control characters").c_str());
    std::memset(field, 0, sizeof field);
    std::memcpy(field, text.data(), text.size());
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

nb::bytes encode(const pf_profile &profile)
{
    std::array<uint8_t, PF_PROFILE_BINARY_MAX> buffer;
    size_t n = 0;
    const char *why = nullptr;
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
    type.def_rw("source", &pf_profile::source)
        .def_rw("created_unix_s", &pf_profile::created_unix_s)
        .def_rw("rms_px", &pf_profile::rms_px)
        .def_rw("theta_covered", &pf_profile::theta_covered)
        .def_prop_rw(
            "name", [](const pf_profile &p) { return std::string(p.name); },
            [](pf_profile &p, const std::string &text) { set_text(p.name, text, "name"); })
        .def_prop_rw(
            "serial", [](const pf_profile &p) { return std::string(p.serial); },
            [](pf_profile &p, const std::string &text) { set_text(p.serial, text, "serial"); })
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
            nb::arg("uv").noconvert(), "(N,2) float64 -> (N,3) float64, (N,) bool; the profile must be valid.");
}
