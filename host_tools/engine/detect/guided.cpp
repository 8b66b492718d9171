// Finding the target's points where a camera model says they must be.
#include "find.hpp"
#include "measure.hpp"

#include <algorithm>
#include <cmath>

namespace pipefish::detect
{
namespace
{

struct Expected {
    bool seen = false;    // in front of the camera, its face towards it, in the field and on the picture
    Eigen::Vector2d at;   // pixels
    Eigen::Matrix2d cell; // pixels by a step on the lattice
};

Expected expect(const Board &board, const pf_camera &camera, const Eigen::Matrix<double, 3, 4> &pose, size_t id)
{
    Expected e;
    const auto project = [&](const Eigen::Vector2d &flat, Eigen::Vector2d &uv) {
        const Eigen::Vector3d x = pose.leftCols<3>() * board.place(flat) + pose.col(3);
        return pf_camera_project(&camera, x.data(), uv.data(), nullptr, nullptr) == PF_OK;
    };
    if (!project(board.flat[id], e.at) || !pf_camera_in_image(&camera, e.at.data()))
        return e;
    const Eigen::Vector2d steps[2] = {board.step_i, board.step_j};
    for (int k = 0; k < 2; k++) {
        constexpr double h = 0.1;
        Eigen::Vector2d before, after;
        const bool one = project(board.flat[id] - h * steps[k], before);
        const bool two = project(board.flat[id] + h * steps[k], after);
        if (!one && !two)
            return e;
        e.cell.col(k) = ((two ? after : e.at) - (one ? before : e.at)) / (h * (one + two));
    }
    e.seen = e.cell.determinant() > 0;
    return e;
}

Detection look_for(const cv::Mat &image, const Board &board, const pf_camera &camera,
                   const Eigen::Matrix<double, 3, 4> &pose)
{
    Detection out;
    const size_t n = board.flat.size();
    std::vector<Expected> expected(n);
    std::vector<std::optional<Point>> found(n);
    size_t visible = 0;
    for (size_t k = 0; k < n; k++) {
        expected[k] = expect(board, camera, pose, k);
        visible += expected[k].seen;
    }
    const auto code = [&](size_t k) { return board.code.empty() ? -1 : int(board.code[k]); };
    const auto step = [&](size_t a, size_t b) { return board.between(board.flat[a], board.flat[b]).norm(); };
    // How far its neighbours lie from where the model has them, weighted by distance on the board; false: none near.
    const double unit = std::max(board.step_i.norm(), board.step_j.norm());
    const auto neighbours = [&](size_t k, Eigen::Vector2d &off) {
        double total = 0.0;
        off.setZero();
        for (size_t m = 0; m < n; m++) {
            if (m == k || !found[m])
                continue;
            const double far = step(k, m) / unit;
            if (far > 4.0)
                continue;
            const double w = std::exp(-far * far / 2);
            // In steps on the board, so that it carries over where the scale changes.
            off += w * (expected[m].cell.inverse() * (found[m]->at - expected[m].at));
            total += w;
        }
        if (total > 0)
            off /= total;
        return total > 0;
    };
    for (int pass = 0; pass < 3; pass++) {
        bool changed = false;
        for (size_t k = 0; k < n; k++) {
            if (found[k] || !expected[k].seen)
                continue;
            Eigen::Vector2d start = expected[k].at, off;
            if (pass > 0) {
                if (!neighbours(k, off))
                    continue;
                start += expected[k].cell * off;
            }
            found[k] = search_point(image, board, start, expected[k].cell, code(k));
            changed = changed || found[k];
        }
        // What strays from its neighbours is something else.
        for (size_t k = 0; k < n; k++) {
            Eigen::Vector2d off;
            if (!found[k] || !neighbours(k, off))
                continue;
            const Eigen::Vector2d own = expected[k].cell.inverse() * (found[k]->at - expected[k].at);
            if ((own - off).norm() > 0.2)
                found[k].reset();
        }
        if (pass > 0 && !changed)
            break;
    }
    std::vector<Measured> points;
    for (size_t k = 0; k < n; k++)
        if (found[k])
            points.push_back({static_cast<int>(k), *found[k], expected[k].cell});
    report(image, board, points, out);
    const std::string count =
        std::to_string(points.size()) + " of " + std::to_string(n) + " points, " + std::to_string(visible) + " in view";
    if (points.size() < std::min<size_t>(4, n)) {
        out = Detection{};
        out.reason = "the target is not where the model says: " + count;
        return out;
    }
    out.status = points.size() == n ? Status::complete : Status::partial;
    if (points.size() < n)
        out.reason = count;
    return out;
}

} // namespace

Detection find_target_guided(const cv::Mat &image, const Board &board, const pf_camera &camera,
                             const Eigen::Matrix<double, 3, 4> &pose)
{
    Detection out = look_for(image, board, camera, pose);
    if (out.status == Status::none && board.kind == Kind::checkerboard) {
        // A board printed with its colours exchanged has its corners at the same places.
        Board other = board;
        for (uint8_t &code : other.code)
            code = !code;
        Detection second = look_for(image, other, camera, pose);
        if (second.status != Status::none)
            return second;
    }
    return out;
}

} // namespace pipefish::detect
