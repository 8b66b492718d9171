// Bundle adjustment of a stretch of frames: reprojection in pixels of the raw image, with odometry, gravity and the
// camera's uncertainty where they are known.
#pragma once

#include "optim/least_squares.hpp"
#include "sfm/tracks.hpp"

#include <vector>

namespace pipefish::sfm
{

// Frames first .. first + poses.size() - 1, and the points of tracks seen there.
struct Submap {
    int first = 0;
    std::vector<Pose> poses; // cam_from_world
    std::vector<int> tracks; // ascending
    std::vector<Vector3d> points;

    int end() const { return first + static_cast<int>(poses.size()); }
    const Pose &pose(int frame) const { return poses[static_cast<size_t>(frame - first)]; }
    bool has(int frame) const { return frame >= first && frame < end(); }
};

// Where the camera was when it saw `o`: the pose of its frame, or that of its row, which is then put into `room`.
const Pose &pose_of(const Submap &map, const TrackTable &table, const Observation &o, Pose &room);

// Distance driven between frames, from wheels: truth = reading (1 + w), w unknown with sigma `scale_sigma`.
struct Odometry {
    std::vector<double> step;   // from frame i to i + 1, metres; NaN where unknown
    std::vector<double> sigma;  // of it, metres, without w
    double scale_sigma = 0.003; // of w
    double slip_share = 0.05;   // of steps in which the wheel slips
    double slip_spread = 30.0;  // their spread, in sigmas
};

// Direction of gravity in the camera's frame, from an inclinometer.
struct Gravity {
    std::vector<Vector3d> down; // unit, one a frame; zero where unknown
    double sigma = 0.01;        // radians
};

// Which of the camera's parameters are uncertain, and how much. A calibration's covariance may be singular: it holds
// what its model leaves free (the amplitude of a harmonic beside its function of theta).
struct CameraPrior {
    CameraPrior() = default;
    CameraPrior(std::vector<uint32_t> parameters, const Eigen::MatrixXd &covariance);

    std::vector<uint32_t> parameter; // pf_camera_param
    Eigen::MatrixXd root;            // root root^T is their covariance; as many columns as it has rank
};

struct BundleOptions {
    optim::RobustLoss loss;
    int held_front = 1, held_back = 0; // frames whose poses stay
    bool hold_scale = true;            // keep the distance from the first to the last frame (where odometry does not)
    int max_iterations = 50;
    double cost_tolerance = 1e-8;
    double lambda =
        1e-4;           // first damping: small where the start is good, for a chain's soft bends hardly change the cost
    double noise = 1.0; // of the pixels, over the one their table states; odometry and priors stay as stated
    double gate = 0.0;  // observations further off than this many sigmas are left out; 0: all that can be projected
    int min_views = 2;  // points with fewer are left out
    int threads = 1;
    const Odometry *odometry = nullptr;
    const Gravity *gravity = nullptr;
    const CameraPrior *camera_prior = nullptr;
    double sag_sigma = 0.0;  // px^2, of the tracks' common sag all around alike (tracks.hpp), about 0, and half of
                             // it of its other parts; 0: there is none
    double late_sigma = 0.0; // of the line time as a share of the stated one, about 1; 0: it is as stated
    // Where odometry does not tell lengths all along: the pupil's shift e1 in the map's unit (the wheel's metres), as
    // known beforehand; 0: as the camera's.
    double pupil = 0.0, pupil_sigma = 0.0;
    const std::vector<int> *only =
        nullptr; // places of the observations to use, as BundleReport::used; null: by the gate
};

struct BundleReport {
    optim::Summary summary;
    int observations = 0, points = 0;
    int redundancy = 1;           // degrees of freedom of the pixels' residuals
    double variance_factor = 1.0; // of the pixels, cost over degrees of freedom: 1 = noise as the table states it
    double cost = 0.0;            // half the sum of squares, pixels in the table's noise
    double wheel = 0.0;           // w
    Vector3d down = Vector3d::Zero();
    Vector3d sag = Vector3d::Zero(); // px^2, as sag_columns() takes it
    double late = 1.0;               // line time over the stated one
    int late_at = -1;                // its place in the border; -1: it was not estimated
    double pupil = 0.0;              // shift e1 of the camera's pupil, without what the camera's change adds
    Eigen::VectorXd camera;          // changes of the camera's parameters
    std::vector<int> used;           // places in the table of the observations, by point
};

class BundleCovariance
{
public:
    using Solver = optim::LeastSquares<3, 6>;

    BundleCovariance() = default;
    BundleCovariance(Solver &&solver, Solver::Covariance &&known) : solver_(std::move(solver)), known_(std::move(known))
    {
    }

    bool empty() const { return known_.f.empty(); }
    size_t frames() const { return known_.f.size(); }
    const Eigen::Matrix<double, 6, 6> &pose(size_t frame) const
    {
        return known_.f[frames() - 1 - frame][0];
    }                                                                // rotation (left), centre
    const std::vector<Matrix3d> &points() const { return known_.e; } // as the map's points
    const Eigen::MatrixXd &border() const
    {
        return known_.g;
    } // wheel, gravity (2), sag (3), late, pupil, camera (in units of its prior's root): those of the options

    // Of linear functions of points, with all correlation through the poses: a[k] (3 x m) times point `points[k]`.
    Eigen::MatrixXd functions(std::span<const int> points, std::span<const Solver::MatrixEG> a) const
    {
        return solver_.functions(points, a);
    }

private:
    Solver solver_;
    Solver::Covariance known_;
};

// Adjusts `map` in place; points that lose their observations are removed from it. `covariance`, where not null, is of
// the result, with the loss's weights, in the gauge of the options.
BundleReport adjust(Submap &map, const TrackTable &table, const pf_camera &camera, const BundleOptions &options,
                    BundleCovariance *covariance = nullptr);

// The camera with `change` added to the parameters of the prior.
pf_camera changed_camera(const pf_camera &camera, const CameraPrior &prior, const Eigen::VectorXd &change);

// Whitened squared distance of an observation; infinity where the point cannot be seen.
double reprojection_squared(const pf_camera &camera, const Pose &pose, const Vector3d &x, const Observation &o);

} // namespace pipefish::sfm
