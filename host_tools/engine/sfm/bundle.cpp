#include "sfm/bundle.hpp"

#include "geometry/between.hpp"
#include "sfm/bundle_priors.hpp"

#include <Eigen/Eigenvalues>

#include <algorithm>
#include <limits>

namespace pipefish::sfm
{

namespace
{

// Of a correlation matrix's eigenvalues beside the largest: below is rounding.
constexpr double ROUNDING = 1e-12;

using BundleStep = optim::Step<3, 6>;

// The problem as the optimiser sees it: which pixels count, their residuals and derivatives.
class BundleProblem
{
public:
    BundleProblem(const Submap &map, const TrackTable &table, const pf_camera &camera, const BundleOptions &options)
        : table_(table), original_(camera), camera_(camera), options_(options), first_(map.first),
          state_(start_of(map)), priors_(options, map.first, table.rolls(), state_)
    {
        state_.pupil = camera.pupil_e1;
        gather(map);
        project_all();
        select();
        saved_ = state_;
        if (priors_.layout.sag_at >= 0) {
            set_sag();
        }
    }

    int eliminated() const { return static_cast<int>(state_.point.size()); }
    int banded() const { return static_cast<int>(state_.centre.size()); }
    int border() const { return priors_.layout.border; }
    int reach() const { return options_.odometry ? 1 : 0; }
    std::span<const int> couplings(int e) const
    {
        const size_t from = coupled_offset_[static_cast<size_t>(e)];
        return {coupled_.data() + from, coupled_offset_[static_cast<size_t>(e) + 1] - from};
    }

    template <class Sink> void linearize(int e, Sink &sink) const
    {
        if (e < 0) {
            priors_.linearize(state_, sink);
            return;
        }
        const size_t point = static_cast<size_t>(e);
        RowsX j_border = RowsX::Zero(2, priors_.layout.border);
        const bool shared = priors_.layout.camera_columns > 0 || priors_.layout.sag_at >= 0 ||
                            priors_.layout.late_at >= 0 || priors_.layout.pupil_at >= 0 || measures_pupil();
        const bool frees_camera = priors_.layout.camera_columns > 0 || priors_.layout.pupil_at >= 0;
        for (size_t k = offset_[point]; k < offset_[point + 1]; k++) {
            const Eigen::Map<const Vector3d> x(in_camera_.data() + 3 * k);
            Vector2d uv;
            Rows<2, 3> slope;
            Rows<2, PF_CAMERA_PARAMS> by_camera;
            if (pf_camera_project(&camera_, x.data(), uv.data(), slope.data(),
                                  frees_camera ? by_camera.data() : nullptr) != PF_OK) {
                continue;
            }
            const Eigen::Matrix2d &whiten = measured_[k].whiten;
            const Vector2d r = whitened_error(k);
            const Rows<2, 3> by_x = whiten * slope, whitened = by_x * (1.0 / yardstick());
            Rows<2, 3> j_turn;
            for (int row = 0; row < 2; row++) { // d(R (X - c)) = w x x - R dc
                j_turn.row(row) = x.cross(Vector3d(by_x.row(row))).transpose();
            }
            Rows<2, 3> j_point;
            Rows<2, 6> j_pose[2];
            by_poses(k, whitened, j_turn, j_point, j_pose);
            const int frames[2] = {frame_[k], rolls() ? moment_[k].other : -1};
            const int blocks[2] = {priors_.layout.block_of(frames[0]), priors_.layout.block_of(frames[1])};
            if (measures_pupil()) {
                j_border.col(0) = -whitened * x;
            }
            if (priors_.layout.sag_at >= 0) {
                j_border.middleCols<3>(priors_.layout.sag_at) = whiten * sag_columns(sag_[k]);
            }
            if (priors_.layout.late_at >= 0) { // further on the way: turned more, and moved
                const size_t f = static_cast<size_t>(frames[0]), other = static_cast<size_t>(frames[1]);
                j_border.col(priors_.layout.late_at) =
                    moment_[k].share *
                    (j_turn * turn_towards(f, frames[1]) - j_point * (state_.centre[other] - state_.centre[f]));
            }
            if (priors_.layout.pupil_at >= 0) {
                j_border.col(priors_.layout.pupil_at) = whiten * by_camera.col(PF_PARAM_PUPIL_E1);
            }
            if (priors_.layout.camera_columns > 0) {
                const CameraPrior &prior = *options_.camera_prior;
                j_border.rightCols(priors_.layout.camera_columns) =
                    whiten * (by_camera(Eigen::indexing::all, prior.parameter) * prior.root);
            }
            const double *j_f[2] = {j_pose[0].data(), j_pose[1].data()};
            const size_t poses = rolls() ? 2 : 1;
            sink.add(2, r.data(), options_.loss, j_point.data(), std::span(blocks, poses), std::span(j_f, poses),
                     shared ? j_border.data() : nullptr);
        }
    }

    double cost(int e) const
    {
        if (e < 0) {
            return priors_.cost(state_);
        }
        const size_t point = static_cast<size_t>(e);
        double sum = 0.0;
        for (size_t k = offset_[point]; k < offset_[point + 1]; k++) {
            if (!seen_[k]) {
                return std::numeric_limits<double>::infinity();
            }
            sum += 0.5 * options_.loss(whitened_error(k).squaredNorm()).rho;
        }
        return sum;
    }

    void apply(const BundleStep &step)
    {
        for (size_t f = 0; f < state_.centre.size(); f++) {
            const Eigen::Matrix<double, 6, 1> &pose =
                step.f[static_cast<size_t>(priors_.layout.block_of(static_cast<int>(f)))];
            state_.rotation[f] = geometry::rotation_exp(pose.head<3>()) * saved_.rotation[f];
            state_.centre[f] = saved_.centre[f] + pose.tail<3>();
        }
        for (size_t e = 0; e < state_.point.size(); e++) {
            state_.point[e] = saved_.point[e] + step.e[e];
        }
        if (options_.odometry) {
            state_.wheel = saved_.wheel + step.g[0];
        }
        if (priors_.layout.down_at >= 0) {
            state_.down =
                (saved_.down + geometry::tangent_basis(saved_.down) * step.g.segment<2>(priors_.layout.down_at))
                    .normalized();
        }
        if (priors_.layout.sag_at >= 0) {
            state_.sag = saved_.sag + step.g.segment<3>(priors_.layout.sag_at);
        }
        if (priors_.layout.late_at >= 0) {
            state_.late = saved_.late + step.g[priors_.layout.late_at];
        }
        if (priors_.layout.camera_columns > 0) {
            state_.camera = saved_.camera + step.g.tail(priors_.layout.camera_columns);
            camera_ = changed_camera(original_, *options_.camera_prior, camera_change());
        }
        if (priors_.layout.pupil_at >= 0) {
            state_.pupil = saved_.pupil + step.g[priors_.layout.pupil_at];
            camera_.pupil_e1 = state_.pupil + pupil_change();
        }
        project_all();
    }

    void save() { saved_ = state_; }

    // The result, into the map.
    void store(Submap &map) const
    {
        for (size_t f = 0; f < map.poses.size(); f++) {
            const Matrix3d r = geometry::nearest_rotation(state_.rotation[f]);
            map.poses[f] = {r, -r * state_.centre[f]};
        }
        map.tracks = track_;
        map.points = state_.point;
    }

    const BundleState &state() const { return state_; }
    const std::vector<int> &used() const { return place_; }
    int observations() const { return static_cast<int>(place_.size()); }
    int late_at() const { return priors_.layout.late_at; }
    Vector3d down() const { return priors_.layout.down_at >= 0 ? state_.down : Vector3d(Vector3d::Zero()); }

    // Of the prior's parameters; empty without a prior.
    Eigen::VectorXd camera_change() const
    {
        return options_.camera_prior ? Eigen::VectorXd(options_.camera_prior->root * state_.camera) : Eigen::VectorXd();
    }

    // Of the pupil's shift, by the camera's prior.
    double pupil_change() const
    {
        double sum = 0.0;
        if (options_.camera_prior) {
            const std::vector<uint32_t> &names = options_.camera_prior->parameter;
            const Eigen::VectorXd change = camera_change();
            for (size_t i = 0; i < names.size(); i++) {
                sum += names[i] == PF_PARAM_PUPIL_E1 ? change[static_cast<Eigen::Index>(i)] : 0.0;
            }
        }
        return sum;
    }

    // Of the pixels alone: what shares the border with them (wheel, gravity, priors) tells that border, and the scale.
    int redundancy() const
    {
        const int frames = banded() - options_.held_front - options_.held_back;
        const bool scale_free = options_.hold_scale || options_.odometry;
        return std::max(2 * observations() - 6 * frames - 3 * eliminated() + (scale_free ? 1 : 0), 1);
    }

private:
    // What a residual needs of its observation, without the rest of the table's row.
    struct Measured {
        Vector2d uv;
        Eigen::Matrix2d whiten; // with the options' noise
    };

    static BundleState start_of(const Submap &map)
    {
        BundleState state;
        for (const Pose &pose : map.poses) {
            state.rotation.push_back(pose.r);
            state.centre.push_back(pose.centre());
        }
        state.point = map.points;
        return state;
    }

    // The candidates: all that the map's frames saw of its points, or of them those that the options list.
    void gather(const Submap &map)
    {
        std::vector<int> listed;
        if (options_.only) {
            listed = *options_.only;
            std::sort(listed.begin(), listed.end());
        }
        track_ = map.tracks;
        offset_.push_back(0);
        for (const int track : track_) {
            const std::span<const Observation> seen = table_.of_track(track);
            for (size_t i = seen.size(); i-- > 0;) {
                const Observation &o = seen[i];
                const int place = static_cast<int>(&o - table_.observations().data());
                if (!map.has(o.frame) || (options_.only && !std::binary_search(listed.begin(), listed.end(), place))) {
                    continue;
                }
                place_.push_back(place);
                frame_.push_back(o.frame - first_);
                if (table_.rolls()) {
                    const Moment moment = table_.moment(o, map.first, map.end());
                    moment_.push_back({moment.other - first_, moment.share});
                }
            }
            offset_.push_back(place_.size());
        }
    }

    // Of the candidates, as they are projected, those to use; and their points, where enough are.
    void select()
    {
        coupled_offset_.push_back(0);
        size_t kept = 0, points = 0, from = 0;
        for (size_t p = 0; p < track_.size(); p++) {
            const size_t before = kept, to = offset_[p + 1];
            for (size_t k = from; k < to; k++) {
                if (options_.only || passes(k)) {
                    move(k, kept++);
                }
            }
            from = to;
            if (kept - before < static_cast<size_t>(options_.min_views)) {
                kept = before;
                continue;
            }
            couple(before, kept);
            state_.point[points] = state_.point[p];
            track_[points++] = track_[p];
            offset_[points] = kept;
        }
        state_.point.resize(points);
        track_.resize(points);
        offset_.resize(points + 1);
        place_.resize(kept);
        frame_.resize(kept);
        moment_.resize(std::min(moment_.size(), kept));
        in_camera_.resize(3 * kept);
        pixel_.resize(2 * kept);
        seen_.resize(kept);
        measured_.reserve(kept);
        for (const int place : place_) {
            const Observation &o = table_[place];
            measured_.push_back({o.sight.uv, o.whiten / options_.noise});
        }
    }

    // Whether candidate k can be seen, and is inside the gate.
    bool passes(size_t k) const
    {
        const Observation &o = table_[place_[k]];
        const double squared = (o.whiten * (pixel_at(k) - o.sight.uv)).squaredNorm();
        return seen_[k] && (options_.gate <= 0.0 || squared < options_.gate * options_.gate);
    }

    // Puts candidate `from` into place `to`.
    void move(size_t from, size_t to)
    {
        place_[to] = place_[from];
        frame_[to] = frame_[from];
        if (rolls()) {
            moment_[to] = moment_[from];
        }
        std::copy_n(in_camera_.begin() + static_cast<std::ptrdiff_t>(3 * from), 3,
                    in_camera_.begin() + static_cast<std::ptrdiff_t>(3 * to));
        std::copy_n(pixel_.begin() + static_cast<std::ptrdiff_t>(2 * from), 2,
                    pixel_.begin() + static_cast<std::ptrdiff_t>(2 * to));
        seen_[to] = seen_[from];
    }

    Eigen::Map<const Vector2d> pixel_at(size_t k) const { return Eigen::Map<const Vector2d>(pixel_.data() + 2 * k); }

    Vector2d whitened_error(size_t k) const
    {
        return measured_[k].whiten * (pixel_at(k) + sagged(k) - measured_[k].uv);
    }

    // Derivatives of observation k, from those by the point in the camera's axes and by the camera's turn: by the
    // point, and by the poses it lies between (of the second: where the shutter rolls).
    void by_poses(size_t k, const Rows<2, 3> &whitened, const Rows<2, 3> &j_turn, Rows<2, 3> &j_point,
                  Rows<2, 6> *j_pose) const
    {
        if (!rolls()) {
            j_point = whitened * state_.rotation[static_cast<size_t>(frame_[k])];
            j_pose[0] << j_turn, -j_point;
        } else {
            const size_t f = static_cast<size_t>(frame_[k]);
            const double share = share_at(k);
            const geometry::TurnBetween turn =
                geometry::turn_between(state_.rotation[f], turn_towards(f, moment_[k].other), share);
            j_point = whitened * turn.r;
            j_pose[0] << j_turn * turn.by_first, (share - 1.0) * j_point;
            j_pose[1] << j_turn * turn.by_second, -share * j_point;
            if (priors_.layout.is_held(moment_[k].other)) {
                j_pose[1].setZero();
            }
        }
        if (priors_.layout.is_held(frame_[k])) {
            j_pose[0].setZero();
        }
    }

    // The pupil's shift is a length, and would say how long the wheel's metre is: in truth it is known too badly for
    // that, and what is wrong with the tracks would be read as a scale. So it is taken in the wheel's metres, too.
    bool measures_pupil() const
    {
        return options_.odometry && (original_.pupil_e1 != 0.0 || priors_.layout.pupil_at >= 0);
    }
    double yardstick() const { return measures_pupil() ? 1.0 + state_.wheel : 1.0; }

    // How far the sag moves observation k.
    Vector2d sagged(size_t k) const
    {
        return priors_.layout.sag_at >= 0 ? Vector2d(sag_columns(sag_[k]) * state_.sag) : Vector2d(Vector2d::Zero());
    }

    // From where the points are seen by the map, not from the pixels: their noise would be in both the sag's columns
    // and the residuals, and 0.3 px were read as -8 px^2 of sag, 0.6 px as -30, and with it as a drift of the profile.
    void set_sag()
    {
        const Vector2d centre(original_.c_u, original_.c_v);
        const int end = first_ + banded();
        sag_.assign(place_.size(), Vector2d::Zero());
        for (size_t p = 0; p < state_.point.size(); p++) {
            const Observation &start = table_.of_track(track_[p]).front();
            double first = polar_angle(start.sight.ray);
            if (start.frame >= first_ && start.frame < end) {
                const size_t f = static_cast<size_t>(start.frame - first_);
                first = polar_angle(state_.rotation[f] * (state_.point[p] - state_.centre[f]));
            }
            for (size_t k = offset_[p]; k < offset_[p + 1]; k++) {
                if (seen_[k]) {
                    const double now = polar_angle(Eigen::Map<const Vector3d>(in_camera_.data() + 3 * k));
                    const Vector2d out = pixel_at(k) - centre;
                    sag_[k] = sag_of(first, now, original_.f_u) * out.stableNormalized();
                }
            }
        }
    }

    bool rolls() const { return !moment_.empty(); }
    double share_at(size_t k) const { return rolls() ? state_.late * moment_[k].share : 0.0; }

    // The camera's centre at observation k.
    Vector3d centre_at(size_t k) const
    {
        const Vector3d &here = state_.centre[static_cast<size_t>(frame_[k])];
        if (!rolls()) {
            return here;
        }
        return here + share_at(k) * (state_.centre[static_cast<size_t>(moment_[k].other)] - here);
    }
    Vector3d turn_towards(size_t f, int other) const
    {
        return static_cast<size_t>(other) > f ? turn_[f] : Vector3d(-turn_[static_cast<size_t>(other)]);
    }

    // The blocks of the next point, whose observations are these.
    void couple(size_t from, size_t to)
    {
        const size_t begin = coupled_.size();
        for (size_t k = from; k < to; k++) {
            coupled_.push_back(priors_.layout.block_of(frame_[k]));
            if (rolls()) {
                coupled_.push_back(priors_.layout.block_of(moment_[k].other));
            }
        }
        const auto first = coupled_.begin() + static_cast<std::ptrdiff_t>(begin);
        std::sort(first, coupled_.end());
        coupled_.erase(std::unique(first, coupled_.end()), coupled_.end());
        coupled_offset_.push_back(coupled_.size());
    }

    // All pixels in one batch, which takes a tenth of the time of one by one.
    void project_all()
    {
        const size_t n = place_.size();
        turn_.clear();
        for (size_t f = 0; rolls() && f + 1 < state_.rotation.size(); f++) {
            turn_.push_back(geometry::rotation_log(state_.rotation[f + 1] * state_.rotation[f].transpose()));
        }
        in_camera_.resize(3 * n);
        pixel_.resize(2 * n);
        seen_.resize(n);
        for (size_t p = 0; p < state_.point.size(); p++) {
            for (size_t k = offset_[p]; k < offset_[p + 1]; k++) {
                const size_t f = static_cast<size_t>(frame_[k]);
                Matrix3d part = state_.rotation[f];
                if (rolls()) {
                    part = geometry::rotation_exp(share_at(k) * turn_towards(f, moment_[k].other)) * part;
                }
                Eigen::Map<Vector3d>(in_camera_.data() + 3 * k) = part * (state_.point[p] - centre_at(k)) / yardstick();
            }
        }
        pf_camera_project_n(&camera_, n, in_camera_.data(), pixel_.data(), seen_.data());
    }

    const TrackTable &table_;
    pf_camera original_, camera_;
    BundleOptions options_;
    int first_;
    BundleState state_;
    BundlePriors priors_;
    BundleState saved_;
    std::vector<size_t> offset_; // of each point in place_, frame_ and moment_
    std::vector<int> place_, frame_, track_;
    std::vector<Measured> measured_;
    std::vector<Moment> moment_; // where the shutter rolls; frames as in frame_
    std::vector<Vector3d> turn_; // likewise: from each frame to the next
    std::vector<size_t> coupled_offset_;
    std::vector<int> coupled_;              // blocks of each point
    std::vector<double> in_camera_, pixel_; // of all observations, at the state
    std::vector<uint8_t> seen_;
    std::vector<Vector2d> sag_; // where it is estimated: pixels by which each is off for each px^2 of it
};

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
    report.pupil = problem.state().pupil;
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
