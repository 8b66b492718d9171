// From tracks to poses and points: both ways of building, and the adjustment that ends them.
#pragma once

#include "sfm/submap.hpp"

namespace pipefish::sfm
{

enum class Method { hierarchical, incremental };

struct ReconstructOptions {
    Method method = Method::hierarchical;
    Limits limits;
    int threads = 1;
    double still = 0.5; // px: frames whose tracks moved less than this (median) since the last one used are not used
    const Odometry *odometry = nullptr; // by frame of the table
    const Gravity *gravity = nullptr;   // by frame of the table
    const CameraPrior *camera_prior = nullptr;
    const CameraPrior *drift_prior = nullptr; // as wide as a camera may have changed since it was calibrated
    double drift_noise = 1.0;                 // factor on the observations' noise in that adjustment
    bool common_errors = false;               // noise that no residual shows is in what is stated: it is the least
    double sag_sigma = 0.0;                   // as in BundleOptions
    // Metres of the pupil's shift e1 that the camera leaves open; 0: where no odometry tells lengths lenses are
    // central, and where it was not read all along they are as stated.
    double pupil_sigma = 0.0;
    double radius = 0.0;              // metres, of the pipe, about; 0: unknown
    const Shutter *shutter = nullptr; // that rolls; times by frame of the table
};

// A stretch that could not be measured, between two frames.
struct Gap {
    int from = 0, to = 0;
    Trouble trouble = Trouble::none;
    int common = 0;
};

// The adjustment once more, with the camera free within `drift_prior`.
struct Drift {
    Submap map;
    Eigen::VectorXd camera; // changes of its parameters, and their covariance
    Eigen::MatrixXd covariance;
};

struct Segment {
    Submap map; // frames are numbers in `frames`
    BundleReport report;
    double noise = 1.0;             // of the pixels over the stated one, in the covariances and the estimate
    int iterations = 0;             // of least squares, until the pixels' noise is known and with it
    BundleCovariance random, total; // with the camera as it is; with its uncertainty (empty where that is not known)
    Drift drift;                    // empty without drift_prior
    double sigma = 1.0;             // robust, of the whitened residuals before the last selection
    bool metric = false;            // scale from odometry
    bool frees_pupil = false;       // its shift was estimated
    double late = 1.0, late_sigma = 0.0; // line time over the stated one, by the survey itself; sigma 0: not looked at
    double scale_sigma = 0.0;            // relative, of the scale from odometry before the adjustment
};

struct Reconstruction {
    std::vector<int> frames;       // of the table, that were used, ascending
    std::vector<Segment> segments; // in order; frames of different segments have nothing but odometry in common
    std::vector<Gap> gaps;         // numbers in `frames`
};

Reconstruction reconstruct(TrackTable table, const pf_camera &camera, const ReconstructOptions &options);

// Frames to use: those whose tracks moved since the last.
std::vector<int> moving_frames(const TrackTable &table, double still);

} // namespace pipefish::sfm
