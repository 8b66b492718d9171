// Conics for Python: _engine.homography_from_conics and friends. pipefish/conics.py is what people use.
#include "conics/conics.hpp"

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

namespace nb = nanobind;
using namespace pipefish::conics;

void bind_conics(nb::module_ &m);

namespace
{

template <int Columns> using Rows = Eigen::Matrix<double, Eigen::Dynamic, Columns, Eigen::RowMajor>;

template <int Columns> std::vector<Eigen::Matrix<double, Columns, 1>> listed(const Rows<Columns> &rows)
{
    std::vector<Eigen::Matrix<double, Columns, 1>> out;
    for (Eigen::Index k = 0; k < rows.rows(); k++)
        out.push_back(rows.row(k).transpose());
    return out;
}

std::pair<Eigen::Matrix<double, 3, 4>, double> pose(const Rows<2> &middles, double radius,
                                                    const std::vector<Rows<3>> &rays)
{
    Discs discs;
    discs.middles = listed<2>(middles);
    discs.radius = radius;
    for (const Rows<3> &r : rays)
        discs.rays.push_back(listed<3>(r));
    const Pose p = pose_of_discs(discs);
    return {p.cam_from_target, p.rms};
}

std::vector<std::pair<Eigen::Vector3d, Eigen::Vector3d>> two_poses(const Eigen::Matrix3d &cone,
                                                                   const Eigen::Vector3d &inside, double radius)
{
    std::vector<std::pair<Eigen::Vector3d, Eigen::Vector3d>> out;
    for (const DiscPose &p : disc_poses(cone, inside, radius))
        out.emplace_back(p.middle, p.normal);
    return out;
}

} // namespace

void bind_conics(nb::module_ &m)
{
    m.def("homography_from_conics", &homography, nb::arg("from"), nb::arg("to"), "Lists of (3,3) -> list of (3,3).");
    m.def(
        "fit_ellipse", [](const Rows<2> &points) { return fit_ellipse(listed<2>(points)); }, nb::arg("points"),
        "(N,2) -> (3,3).");
    m.def(
        "fit_cone", [](const Rows<3> &rays) { return fit_cone(listed<3>(rays)); }, nb::arg("rays"), "(N,3) -> (3,3).");
    m.def("disc_poses", &two_poses, nb::arg("cone"), nb::arg("inside"), nb::arg("radius"),
          "Two (middle, normal) in the camera's frame.");
    m.def("pose_of_discs", &pose, nb::arg("middles"), nb::arg("radius"), nb::arg("rays"),
          "(N,2), metres, list of (K,3) -> cam_from_target (3,4), rms (radians).");
}
