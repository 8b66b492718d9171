// The tube as one smooth surface: an axis and a section that change along the pipe as cubic B-splines, in pieces that
// end at joints. All is fitted at once to the points: exact distance in the normal plane, robust weights, roughness by
// stretches, and smoothness as the data want it (variance components by restricted maximum likelihood).
#pragma once

#include "tube/cloud.hpp"

#include <Eigen/Core>

#include <array>
#include <functional>
#include <memory>
#include <span>
#include <vector>

namespace pipefish::tube
{

constexpr int MAX_ORDER = 6;
constexpr double EXACT = 1e-9; // of the diameter: no point is known better

// Where the fit starts: nodes along the pipe, at least two.
struct Reference {
    Eigen::Matrix3Xd centre;
    std::vector<double> rho;
    std::vector<double> breaks; // abscissae (arc length of the nodes' polyline), ascending, inside
};

struct SurfaceOptions {
    double knot = 0.25;       // spacing of the knots, in diameters
    int order = 2;            // of the section's harmonics, 2 to 6; 0: by BIC
    int rounds = 12;          // of reweighting and smoothing
    double ovality = 0.03;    // rms of pipes, (max - min) / mean: assumed where half the wall is seen at most
    bool smooth_only = false; // keep the smoothness as it starts: stiff, for looking for joints
};

// Axis, frame and section at one place, with what is known of them.
struct Station {
    double s = 0.0; // chainage, metres along the axis
    int piece = 0;
    Eigen::Vector3d centre, tangent, first, second; // right-handed: first x second = tangent
    double curvature = 0.0, curvature_sigma = 0.0;  // 1 / m
    Eigen::Matrix2d tangent_covariance;             // along first, second; radians
    Eigen::VectorXd shape;
    Eigen::MatrixXd covariance;                   // of the centre along first and second, then the shape
    int inliers = 0;                              // within half a window
    double gap = 0.0, rms = 0.0, roughness = 0.0; // radians, metres, metres
    bool ellipse = true;                          // false: points on one side, an ellipse is half assumption
};

struct OnSurface {      // a point's place
    double s, angle, r; // chainage; angle from `first` to `second`, radians; distance from the axis
    double distance;    // from the wall, positive outside
    double sigma;       // of the distance: noise and roughness
    double weight;      // 0 to 1
    int piece;          // -1: off the tube's length
};

struct Stretch;
class SurfaceProblem;
using SurfaceVariance = std::function<double(size_t, size_t)>; // of two of the problem's scalars

class Surface
{
public:
    // Throws std::invalid_argument where the reference has no length.
    Surface(const Cloud &cloud, const Reference &reference, const SurfaceOptions &options);
    ~Surface();

    double length() const { return piece_.back().end_s; }
    int order() const { return order_; }
    double correlation() const { return correlation_; } // factor by which neighbours' likeness widens variances
    // Points on the tube for each that took part in the fit.
    double thinning() const;
    bool converged() const { return converged_; }
    std::vector<std::pair<double, double>> pieces() const; // chainages

    Station station(double s, int piece = -1) const; // piece -1: the one that holds s
    // Variance of sum over i of weight.row(i) . shape at (s[i], piece[i]), with all that the places have in common.
    double variance(std::span<const double> s, std::span<const int> piece, const Eigen::MatrixXd &weight) const;
    OnSurface place(int point) const { return placed_[static_cast<size_t>(point)]; }
    // Chainage, angle, distances of any point; piece -1 where it is beyond the ends.
    OnSurface project(const Eigen::Vector3d &x) const;

private:
    friend class SurfaceProblem;
    struct Piece {
        int first = 0, intervals = 0; // controls first .. first + intervals + 2
        double step = 0.0;            // metres of reference a knot
        double start_s = 0.0, end_s = 0.0;
        std::vector<double> arc; // chainage at each 1/16 of an interval
    };
    struct Frame {
        Eigen::Vector3d centre, tangent, first, second;
        double speed = 0.0; // metres a knot
        Eigen::Vector3d second_derivative;
    };

    void lay_out(const Reference &reference, double knot);
    void assign(const Reference &reference);
    void reweigh(bool all);
    void measure_roughness();
    void find_gaps();
    void measure_correlation();
    int choose_order() const;
    bool solve(int rounds, bool adapt);
    void widen(int order);
    void smooth(const SurfaceProblem &problem, const SurfaceVariance &variance, bool adapt);
    void keep_information();
    void tabulate();
    void describe();
    void count_around(Station &station) const;
    std::vector<Stretch> stretches() const;

    Frame frame(const Piece &piece, double u) const;
    void shape_at(const Piece &piece, double u, double *shape) const;
    double foot(const Piece &piece, const Eigen::Vector3d &x, double u) const;
    double chainage(const Piece &piece, double u) const;
    double parameter(const Piece &piece, double s) const;

    const Cloud &cloud_;
    double diameter_ = 0.0, ovality_ = 0.0;
    int reach_ = 1; // knots each way that count as around one: half a diameter
    int order_ = 2, floats_ = 3;
    std::vector<Piece> piece_;
    std::vector<Eigen::Vector3d> control_, first_, second_;
    std::vector<double> shape_; // floats_ a control
    std::vector<int> pinned_;   // a control: of how many in a row that see too little of the wall for an ellipse; or 0
    std::vector<std::vector<Eigen::MatrixXd>> covariance_; // [control][back]
    struct Information;
    std::unique_ptr<Information> information_; // of the points that were fitted, at the end
    std::array<double, 4> stiffness_{};        // 1 / variance of second differences: axis, rho, ellipse, harmonics
    std::vector<std::array<double, 4>>
        give_;                  // a control: factor of the stiffness, small where the pipe changes at once
    std::vector<int> of_piece_; // a point: piece or -1
    std::vector<double> u_, distance_, noise_, weight_, robust_;
    std::vector<char> used_;  // a point: takes part in the fit
    std::vector<double> tau_; // a control
    std::vector<OnSurface> placed_;
    std::vector<std::pair<double, int>> by_s_; // inliers by chainage
    double correlation_ = 1.0;
    double freedom_ = 0.0; // degrees of freedom that the fit takes
    bool converged_ = false;
};

} // namespace pipefish::tube
