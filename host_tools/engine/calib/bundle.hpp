// Bundle adjustment of a calibration: cameras of a rig, boards of a rig with their shapes, and the frames in which the
// ones see the others. X_cam = camera_c ( frame_f ( board_b ( shape_b(x) ) ) ).
//
// Unknowns: six of each frame (eliminated), and in the border, in this order: for each camera its free parameters and,
// where free, its pose in the rig and the shift of its corners; for each board its free shape coefficients and, where
// free, its pose in the rig. The two unit vectors of Paper II's asymmetric terms take three unknowns each, in their
// tangent space.
#pragma once

#include "calib/pose.hpp"
#include "calib/shape.hpp"
#include "optim/least_squares.hpp"
#include "pipefish/camera.h"

#include <Eigen/Core>

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace pipefish::calib
{

struct Observation {
    Eigen::Vector3d drawn; // on the board, metres
    Eigen::Vector2d pixel;
    double sigma = 1.0; // pixels, along each axis
    bool used = true;
    double parity = 0.0; // of a checkerboard's corner, +-1; 0: not a corner
    Eigen::Vector3d across = Eigen::Vector3d::UnitX(), down = Eigen::Vector3d::UnitY(); // plane that touches a circle
    Eigen::Vector3d bend = Eigen::Vector3d::Zero(); // of the sheet along `across`: to the bend's centre, 1 / metres

    // A point of the sheet the circle is printed on, so far along `across` and `down`, metres.
    Eigen::Vector3d on_sheet(double x, double y) const;
};

struct View {
    int camera = 0, board = 0, frame = 0;
    std::vector<Observation> points;
};

struct Camera {
    pf_camera model{};
    Pose from_rig;
    std::vector<uint32_t> free; // pf_camera_param, ascending
    bool pose_free = false;
    double theta_end = 0.0; // the radius is kept rising up to here
    // Pixels by which a detector misplaces corners: corner[0] + corner[1] theta^2 along the saddle's answer to a radial
    // slope of brightness (light falls off towards the rim), see corner_shift().
    std::array<double, 2> corner{};
    bool corner_free = false;
};

struct Board {
    Shape shape;
    Pose to_rig;
    std::vector<int> free; // coefficients of the shape, ascending
    bool pose_free = false;
};

// What is known where there is little data: standard deviations of the weak priors, relative to zero.
struct Priors {
    double asymmetry = 0.1; // of asymmetric terms, in radians of the image at one radian off the axis
    double shape = 0.05;    // of shape coefficients, in half sizes of the board
    double pupil = 0.02;    // metres
    double corner = 1.0;    // pixels
};

class Bundle
{
public:
    static constexpr int kFrame = 6;

    std::vector<Camera> cameras;
    std::vector<Board> boards;
    std::vector<Pose> frames;
    std::vector<View> views;
    double circle_radius = 0.0; // metres; 0: points
    double huber = 0.0;         // where the loss bends, in standard deviations of a point; 0: least squares
    Priors priors;

    // The projection of a view's point; false where the model has none. Derivatives may be null: by the six of the
    // frame (2 x 6 row-major) and by the border (2 x border() row-major, zeros filled in).
    bool project(const View &view, const Observation &point, Eigen::Vector2d &pixel, double *d_frame,
                 double *d_border) const;

    // The point in the frame of the camera of its view.
    Eigen::Vector3d in_camera(const View &view, const Observation &point) const;

    // Views without a usable point in the image's domain are left where they are.
    optim::Summary adjust(const optim::Options &options);

    // Covariance of the border's unknowns, unscaled: of residuals whose standard deviation is exactly sigma. Throws
    // std::domain_error where the data do not determine everything.
    Eigen::MatrixXd uncertainty() const;

    // Largest observed angle off the axis of a camera, radians.
    double theta_observed(int camera) const;

    // ---- the problem as the optimiser sees it
    int eliminated() const { return static_cast<int>(frames.size()); }
    int banded() const { return 0; }
    int border() const { return layout_.size; }
    int reach() const { return 0; }
    std::span<const int> couplings(int) const { return {}; }
    template <class Sink> void linearize(int frame, Sink &sink) const
    {
        Rows rows;
        const bool own = frame >= 0;
        if (own) {
            fill(frame, rows);
        } else {
            fill_common(rows);
        }
        const int count = static_cast<int>(rows.residual.size());
        if (count > 0) {
            sink.add(count, rows.residual.data(), optim::RobustLoss{}, own ? rows.frame.data() : nullptr, {}, {},
                     layout_.size > 0 ? rows.border.data() : nullptr);
        }
    }
    double cost(int frame) const;
    void apply(const optim::Step<kFrame, 1> &step);
    void save() { saved_ = state(); }

    // Numbers the border's unknowns; call after changing what is free. Frames without points keep their pose.
    void arrange();
    // First unknown of a camera's parameters, its pose, a board's shape, its pose; -1 where there is none.
    struct Layout {
        std::vector<int> camera, camera_pose, corner, shape, board_pose;
        int size = 0;
    };
    const Layout &layout() const { return layout_; }
    // Derivative of the 41 parameters of a camera by its own unknowns, (41, n).
    Eigen::MatrixXd parameter_slope(int camera) const;

private:
    struct Rows {
        std::vector<double> residual, frame, border;
    };
    struct State {
        std::vector<Camera> cameras;
        std::vector<Board> boards;
        std::vector<Pose> frames;
    };

    State state() const { return {cameras, boards, frames}; }
    void fill(int frame, Rows &rows) const;
    void fill_common(Rows &rows) const;
    double loss(double square, double *weight) const;
    bool project_point(const View &view, const Eigen::Vector3d &drawn, double parity, Eigen::Vector2d &pixel,
                       double *d_frame, double *d_border) const;
    int unknowns(const Camera &camera) const;

    State saved_;
    Layout layout_;
    std::vector<std::vector<int>> views_of_frame_;
    std::vector<std::array<Eigen::Matrix<double, 4, 3>, 2>> tangents_; // of each camera's two unit vectors
};

// Largest angle, at most `end`, up to which r(theta) rises.
double rising_end(const pf_camera &camera, double end);

} // namespace pipefish::calib
