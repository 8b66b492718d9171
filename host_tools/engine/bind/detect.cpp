// The target detector for Python: _engine.Board, _engine.find_target. pipefish/detect.py is what people use.
#include "bind/arrays.hpp"
#include "detect/candidates.hpp"
#include "detect/disc.hpp"
#include "detect/find.hpp"
#include "pipefish/profile.h"

#include <opencv2/aruco.hpp>

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <memory>

namespace nb = nanobind;
using namespace pipefish::detect;

void bind_detect(nb::module_ &m);

namespace
{

using Rows2 = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Sites = nb::ndarray<const int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu>;
using Picture = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;

Kind kind_of(const std::string &name)
{
    const char *names[] = {"checkerboard", "circles", "asymmetric-circles", "charuco", "sleeve"};
    for (int k = 0; k < 5; k++)
        if (name == names[k])
            return static_cast<Kind>(k);
    throw nb::value_error("kind: unknown");
}

nb::dict to_python(const Detection &d)
{
    const char *names[] = {"ok", "partial", "ambiguous", "none"};
    nb::dict out;
    const size_t n = d.ids.size();
    std::vector<int64_t> ids(d.ids.begin(), d.ids.end());
    std::vector<double> pixels(2 * n), covariance(4 * n);
    for (size_t k = 0; k < n; k++) {
        for (int a = 0; a < 2; a++) {
            pixels[2 * k + size_t(a)] = d.pixels[k][a];
            for (int b = 0; b < 2; b++)
                covariance[4 * k + size_t(2 * a + b)] = d.covariance[k](a, b);
        }
    }
    out["ids"] = to_numpy(std::move(ids), {n});
    out["pixels"] = to_numpy(std::move(pixels), {n, 2});
    out["covariance"] = to_numpy(std::move(covariance), {n, 2, 2});
    if (!d.outlines.empty()) {
        constexpr size_t most = kOutlinePoints;
        std::vector<double> outlines(n * most * 2, std::numeric_limits<double>::quiet_NaN());
        for (size_t k = 0; k < n; k++)
            for (size_t p = 0; p < std::min(d.outlines[k].size(), most); p++)
                for (int a = 0; a < 2; a++)
                    outlines[(k * most + p) * 2 + size_t(a)] = d.outlines[k][p][a];
        out["outlines"] = to_numpy(std::move(outlines), {n, most, 2});
    } else {
        out["outlines"] = nb::none();
    }
    out["status"] = names[static_cast<int>(d.status)];
    out["reason"] = d.reason;
    out["turns"] = d.turns;
    out["mirrored"] = d.mirrored;
    out["seen"] = nb::make_tuple(d.seen[0], d.seen[1]);
    return out;
}

void make_board(Board *self, const std::string &kind, const Rows2 &flat, const Sites &sites, const Bytes &code,
                const Eigen::Matrix2d &steps, const std::array<int, 2> &size, double radius, double diameter,
                int marker_bits, int marker_errors, double marker_side, const Rows2 &marker_middles,
                const Bytes &marker_codes)
{
    const bool coded = kind == "sleeve" || kind == "checkerboard" || kind == "charuco";
    require(flat.shape(0) >= 1 && sites.shape(0) == flat.shape(0), "sites: not one for each point");
    require(code.size() == (coded ? flat.shape(0) : 0), "code: not one for each point");
    require(std::min(size[0], size[1]) >= 1 && std::max(size[0], size[1]) <= 10000, "size: out of range");
    require(all_within(sites, -100000, 100000), "sites: out of range");
    require(marker_bits >= 0 && marker_bits <= 64 &&
                marker_codes.size() == marker_middles.shape(0) * static_cast<size_t>(marker_bits * marker_bits),
            "marker_codes: not of as many markers and bits");
    Board b;
    b.kind = kind_of(kind);
    for (size_t k = 0; k < flat.shape(0); k++) {
        b.flat.emplace_back(flat(k, 0), flat(k, 1));
        b.at.push_back({sites(k, 0), sites(k, 1)});
    }
    b.code.assign(code.data(), code.data() + code.size());
    b.step_i = steps.row(0);
    b.step_j = steps.row(1);
    b.size = size;
    b.radius = radius;
    b.diameter = diameter;
    b.columns = diameter > 0 ? size[0] : 0;
    b.marker_bits = marker_bits;
    b.marker_errors = marker_errors;
    b.marker_side = marker_side;
    const size_t bits = size_t(marker_bits * marker_bits);
    for (size_t k = 0; k < marker_middles.shape(0); k++) {
        const uint8_t *from = marker_codes.data() + k * bits;
        b.markers.push_back({{marker_middles(k, 0), marker_middles(k, 1)}, {from, from + bits}});
    }
    new (self) Board(std::move(b));
}

cv::Mat view(const Picture &image)
{
    require(image.size() > 0 && std::max(image.shape(0), image.shape(1)) <= 32767, "not a picture");
    return cv::Mat(static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1)), CV_8U,
                   const_cast<uint8_t *>(image.data()));
}

Detection find(const Picture &image, const Board &board)
{
    const nb::gil_scoped_release release;
    return find_target(view(image), board);
}

Detection find_guided(const Picture &image, const Board &board, const pf_profile &profile, const Pose &pose)
{
    const nb::gil_scoped_release release;
    const Eigen::Matrix<double, 3, 4> rt = Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>>(pose.data());
    return find_target_guided(view(image), board, profile.camera, rt);
}

std::vector<Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>> outlines_in(const Picture &image)
{
    std::vector<Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>> out;
    const cv::Mat picture = view(image);
    for (const Blob &blob : find_blobs(picture)) {
        const DiscSetup setup = {blob.half_axes, 1.5};
        const Disc disc = measure_disc(picture, blob.at, setup);
        const auto points = disc.found ? disc_outline(picture, disc, setup, 64) : std::vector<Eigen::Vector2d>();
        if (points.size() < 48)
            continue;
        Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor> rows(points.size(), 2);
        for (size_t k = 0; k < points.size(); k++)
            rows.row(static_cast<Eigen::Index>(k)) = points[k].transpose();
        out.push_back(rows);
    }
    return out;
}

Array<uint8_t> opencv_marker(int dictionary, int number)
{
    const auto all = cv::aruco::getPredefinedDictionary(dictionary);
    if (number < 0 || number >= all->bytesList.rows)
        throw nb::value_error("number: the dictionary has no such marker");
    const cv::Mat bits = cv::aruco::Dictionary::getBitsFromByteList(all->bytesList.row(number), all->markerSize);
    const auto side = static_cast<size_t>(all->markerSize);
    return to_numpy<uint8_t>(bits.ptr(), {side, side});
}

} // namespace

void bind_detect(nb::module_ &m)
{
    nb::class_<Board>(m, "Board", "A target as the detector needs it; pipefish.detect fills it.")
        .def("__init__", &make_board, nb::arg("kind"), nb::arg("flat"), nb::arg("sites"), nb::arg("code"),
             nb::arg("steps"), nb::arg("size"), nb::arg("radius"), nb::arg("diameter"), nb::arg("marker_bits"),
             nb::arg("marker_errors"), nb::arg("marker_side"), nb::arg("marker_middles"), nb::arg("marker_codes"));
    m.def("opencv_marker", &opencv_marker, nb::arg("dictionary"), nb::arg("number"),
          "Inner bits of a marker of one of OpenCV's dictionaries, by its number there: (side,side) uint8, 1 = white.");
    m.def("find_outlines", &outlines_in, nb::arg("image"), "(H,W) uint8 -> list of (K,2) outlines of dark discs.");
    m.def(
        "find_target", [](const Picture &image, const Board &board) { return to_python(find(image, board)); },
        nb::arg("image"), nb::arg("board"), "(H,W) uint8 -> dict of a Detection.");
    m.def(
        "find_target_guided",
        [](const Picture &image, const Board &board, const pf_profile &profile, const Pose &pose) {
            return to_python(find_guided(image, board, profile, pose));
        },
        nb::arg("image"), nb::arg("board"), nb::arg("profile"), nb::arg("pose"),
        "The same with a camera and cam_from_target (3,4).");
}
