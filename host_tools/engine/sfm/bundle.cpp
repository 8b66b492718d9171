#include "sfm/bundle.hpp"

#include "sfm/bundle_problem.hpp"

#include <Eigen/Eigenvalues>

#include <limits>

namespace pipefish::sfm
{

namespace
{

// Of a correlation matrix's eigenvalues beside the largest: below is rounding.
constexpr double ROUNDING = 1e-12;

} // namespace

CameraPrior::CameraPrior(std::vector<uint32_t> parameters, const Eigen::MatrixXd &covariance)
    : parameter(std::move(parameters))
{
    // Directions are compared by correlation: the parameters have different units.
    const Eigen::VectorXd sigma = covariance.diagonal().cwiseMax(0.0).cwiseSqrt();
    const Eigen::VectorXd scale = (sigma.array() > 0.0).select(sigma.cwiseInverse(), 0.0);
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> own(scale.asDiagonal() * covariance * scale.asDiagonal());
    const Eigen::VectorXd &value = own.eigenvalues(); // ascending
    const Eigen::Index known = (value.array() <= ROUNDING * value.tail(1).sum()).count(), free = value.size() - known;
    root = sigma.asDiagonal() * own.eigenvectors().rightCols(free) * value.tail(free).cwiseSqrt().asDiagonal();
}

pf_camera changed_camera(const pf_camera &camera, const CameraPrior &prior, const Eigen::VectorXd &change)
{
    pf_camera changed = camera;
    for (size_t i = 0; i < prior.parameter.size(); i++) {
        *pf_camera_param_at(&changed, prior.parameter[i]) += change[static_cast<Eigen::Index>(i)];
    }
    return changed;
}

const Pose &pose_of(const Submap &map, const TrackTable &table, const Observation &o, Pose &room)
{
    const Pose &pose = map.pose(o.frame);
    if (!table.rolls()) {
        return pose;
    }
    const Moment moment = table.moment(o, map.first, map.end());
    room = geometry::pose_between(pose, map.pose(moment.other), moment.share);
    return room;
}

double reprojection_squared(const pf_camera &camera, const Pose &pose, const Vector3d &x, const Observation &o)
{
    const Vector3d y = pose * x;
    Vector2d uv;
    if (pf_camera_project(&camera, y.data(), uv.data(), nullptr, nullptr) != PF_OK) {
        return std::numeric_limits<double>::infinity();
    }
    return (o.whiten * (uv - o.sight.uv)).squaredNorm();
}

BundleReport adjust(Submap &map, const TrackTable &table, const pf_camera &camera, const BundleOptions &options,
                    BundleCovariance *covariance)
{
    BundleProblem problem(map, table, camera, options);
    BundleCovariance::Solver solver;
    optim::Options settings;
    settings.max_iterations = options.max_iterations;
    settings.cost_tolerance = options.cost_tolerance;
    settings.threads = options.threads;
    settings.lambda = options.lambda;
    BundleReport report;
    report.observations = problem.observations();
    report.points = problem.eliminated();
    report.summary = solver.minimize(problem, settings);
    const double rest = problem.cost(-1), pixels = (report.summary.final_cost - rest) * options.noise * options.noise;
    report.redundancy = problem.redundancy();
    report.variance_factor = 2.0 * pixels / report.redundancy;
    report.cost = pixels + rest;
    report.wheel = problem.state().wheel;
    report.down = problem.down();
    report.sag = problem.state().sag;
    report.late = problem.state().late;
    report.late_at = problem.late_at();
    report.camera = problem.camera_change();
    report.used = problem.used();
    if (covariance) {
        auto known = solver.covariance(problem, options.threads);
        *covariance = BundleCovariance(std::move(solver), std::move(known));
    }
    problem.store(map);
    return report;
}

} // namespace pipefish::sfm
