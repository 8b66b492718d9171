// Conics as symmetric 3 x 3 matrices, x^T C x = 0, and what they determine: homographies (CALIBRATION.md section 6,
// after Paper I) and poses of discs. Functions throw std::invalid_argument with a reason in plain words.
#pragma once

#include <Eigen/Dense>

#include <vector>

namespace pipefish::conics
{

using Conics = std::vector<Eigen::Matrix3d>;

// The ellipse nearest to points (n >= 5): Halir and Flusser's numerically stable form of the direct fit, in
// coordinates normalised to the points. Its sign: negative inside.
Eigen::Matrix3d fit_ellipse(const std::vector<Eigen::Vector2d> &points);

// Whether a conic is a real ellipse. middle (may be null): its centre.
bool is_ellipse(const Eigen::Matrix3d &conic, Eigen::Vector2d *middle = nullptr);

// Points on a real ellipse, evenly around in its own parameter.
std::vector<Eigen::Vector2d> ellipse_points(const Eigen::Matrix3d &conic, int count);

// Homographies H with C' ~ H^-T C H^-1 for all pairs, each with det H = 1. from, to: as many conics, at least two, in
// the same order. Three and more: one, from all pairs linearly in normalised coordinates, then refined: the sum of
// squared distances (Sampson's, in the units of `to`) of 16 points on each ellipse of `from` to their conic, where all
// are real ellipses. Two: every real one, up to four; those that keep centres inside and orientation come first.
// Refused: degenerate conics, conics in a pencil that leaves a family (such as concentric circles), two pairs whose
// projective invariants differ by more than 5 %.
std::vector<Eigen::Matrix3d> homography(const Conics &from, const Conics &to);

// The cone x^T Q x = 0 through unit rays (n >= 5) around a direction within 80 degrees of each of them.
Eigen::Matrix3d fit_cone(const std::vector<Eigen::Vector3d> &rays);

struct DiscPose {                   // a disc's place in the camera's frame
    Eigen::Vector3d middle, normal; // metres; unit, towards the camera
};
// The two discs of a radius (metres) that a cone may be the outline of; `inside`: a ray within the cone.
std::vector<DiscPose> disc_poses(const Eigen::Matrix3d &cone, const Eigen::Vector3d &inside, double radius);

struct Discs {                                      // coplanar discs of one radius and their outlines
    std::vector<Eigen::Vector2d> middles;           // on the target, metres
    double radius = 0.0;                            // metres
    std::vector<std::vector<Eigen::Vector3d>> rays; // of each disc's outline, unit
};
struct Pose {
    Eigen::Matrix<double, 3, 4> cam_from_target;
    double rms = 0.0; // of the outline's rays, radians
};
// The target's pose: the homography of the cones first, which knows no centroid bias, then least squares over all
// rays' angles to their discs' rims. At least three discs not in one line.
Pose pose_of_discs(const Discs &discs);

} // namespace pipefish::conics
