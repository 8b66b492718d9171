#include "sfm/bundle.hpp"

#include "geometry/between.hpp"

#include <Eigen/Eigenvalues>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace pipefish::sfm
{

namespace
{

using Solver = BundleCovariance::Solver;
using Step = optim::Step<3, 6>;
template <int R, int C> using Rows = Eigen::Matrix<double, R, C, Eigen::RowMajor>;
using RowsX = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// What the optimiser moves.
struct State {
    std::vector<Matrix3d> rotation;
    std::vector<Vector3d> centre, point;
    double wheel = 0.0;
    Vector3d down = Vector3d::UnitY();
    double late = 1.0; // of the stated line time
    Vector3d sag = Vector3d::Zero();
    Eigen::VectorXd camera; // in units of the prior's root, whose covariance is the unit matrix
};

// The relative whitened residual of the distance from the first to the last frame: stiff enough to be exact beside
// thousands of observations, soft enough to leave digits to the rest.
constexpr double SCALE_SIGMA = 1e-7;

// Of a correlation matrix's eigenvalues beside the largest: below is rounding.
constexpr double ROUNDING = 1e-12;

class Problem
{
public:
    Problem(const Submap &map, const TrackTable &table, const pf_camera &camera, const BundleOptions &options)
        : table_(table), original_(camera), camera_(camera), options_(options), first_(map.first)
    {
        for (const Pose &pose : map.poses) {
            state_.rotation.push_back(pose.r);
            state_.centre.push_back(pose.centre());
        }
        if (options.only) {
            wanted_ = *options.only;
            std::sort(wanted_.begin(), wanted_.end());
        }
        offset_.push_back(0);
        coupled_offset_.push_back(0);
        Pose room;
        for (size_t p = 0; p < map.tracks.size(); p++) {
            const size_t before = place_.size();
            const std::span<const Observation> seen = table.of_track(map.tracks[p]);
            for (size_t i = seen.size(); i-- > 0;) {
                const Observation &o = seen[i];
                const int place = static_cast<int>(&o - table.observations().data());
                if (map.has(o.frame) &&
                    is_wanted(place, reprojection_squared(camera, pose_of(map, table, o, room), map.points[p], o))) {
                    place_.push_back(place);
                    frame_.push_back(o.frame - first_);
                    if (table.rolls()) {
                        const Moment moment = table.moment(o, map.first, map.end());
                        moment_.push_back({moment.other - first_, moment.share});
                    }
                }
            }
            if (place_.size() - before < static_cast<size_t>(options.min_views)) {
                place_.resize(before);
                frame_.resize(before);
                moment_.resize(std::min(moment_.size(), before));
                continue;
            }
            offset_.push_back(place_.size());
            couple(before);
            state_.point.push_back(map.points[p]);
            track_.push_back(map.tracks[p]);
        }
        set_border();
        start_length_ = (state_.centre.back() - state_.centre.front()).norm();
        saved_ = state_;
        project_all();
        if (sag_at_ >= 0) {
            set_sag();
        }
    }

    int eliminated() const { return static_cast<int>(state_.point.size()); }
    int banded() const { return static_cast<int>(state_.centre.size()); }
    int border() const { return border_; }
    int reach() const { return options_.odometry ? 1 : 0; }
    std::span<const int> couplings(int e) const
    {
        const size_t from = coupled_offset_[static_cast<size_t>(e)];
        return {coupled_.data() + from, coupled_offset_[static_cast<size_t>(e) + 1] - from};
    }

    template <class Sink> void linearize(int e, Sink &sink) const
    {
        if (e < 0) {
            linearize_rest(sink);
            return;
        }
        const size_t point = static_cast<size_t>(e);
        RowsX j_border = RowsX::Zero(2, border_);
        const bool shared = camera_columns_ > 0 || sag_at_ >= 0 || late_at_ >= 0 || measures_pupil();
        for (size_t k = offset_[point]; k < offset_[point + 1]; k++) {
            const Observation &o = table_[place_[k]];
            const geometry::TurnBetween turn = turn_at(k);
            const Vector3d x = turn.r * (state_.point[point] - centre_at(k)) / yardstick();
            Vector2d uv;
            Rows<2, 3> slope;
            Rows<2, PF_CAMERA_PARAMS> by_camera;
            if (pf_camera_project(&camera_, x.data(), uv.data(), slope.data(),
                                  camera_columns_ ? by_camera.data() : nullptr) != PF_OK) {
                continue;
            }
            const Eigen::Matrix2d whiten = o.whiten / options_.noise;
            const Vector2d r = whiten * (uv + sagged(k) - o.sight.uv);
            const Rows<2, 3> whitened = whiten * slope / yardstick();
            const Rows<2, 3> j_point = whitened * turn.r;
            Rows<2, 3> j_turn;
            for (int row = 0; row < 2; row++) { // d(R (X - c)) = w x x - R dc
                j_turn.row(row) = yardstick() * x.cross(Vector3d(whitened.row(row))).transpose();
            }
            Rows<2, 6> j_pose[2] = {Rows<2, 6>::Zero(), Rows<2, 6>::Zero()};
            const int frames[2] = {frame_[k], rolls() ? moment_[k].other : -1};
            const int blocks[2] = {block_of(frames[0]), block_of(frames[1])};
            const double share = share_at(k);
            if (!is_held(frames[0])) {
                j_pose[0] << j_turn * turn.by_first, (share - 1.0) * j_point;
            }
            if (rolls() && !is_held(frames[1])) {
                j_pose[1] << j_turn * turn.by_second, -share * j_point;
            }
            if (measures_pupil()) {
                j_border.col(0) = -whitened * x;
            }
            if (sag_at_ >= 0) {
                j_border.middleCols<3>(sag_at_) = whiten * sag_columns(sag_[k]);
            }
            if (late_at_ >= 0) { // further on the way: turned more, and moved
                const size_t f = static_cast<size_t>(frames[0]), other = static_cast<size_t>(frames[1]);
                j_border.col(late_at_) = moment_[k].share * (j_turn * turn_towards(f, frames[1]) -
                                                             j_point * (state_.centre[other] - state_.centre[f]));
            }
            if (camera_columns_ > 0) {
                const CameraPrior &prior = *options_.camera_prior;
                j_border.rightCols(camera_columns_) =
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
            return cost_rest();
        }
        const size_t point = static_cast<size_t>(e);
        const double noise_squared = options_.noise * options_.noise;
        double sum = 0.0;
        for (size_t k = offset_[point]; k < offset_[point + 1]; k++) {
            if (!seen_[k]) {
                return std::numeric_limits<double>::infinity();
            }
            const Observation &o = table_[place_[k]];
            const Vector2d error = Eigen::Map<const Vector2d>(pixel_.data() + 2 * k) + sagged(k) - o.sight.uv;
            sum += 0.5 * options_.loss((o.whiten * error).squaredNorm() / noise_squared).rho;
        }
        return sum;
    }

    void apply(const Step &step)
    {
        for (size_t f = 0; f < state_.centre.size(); f++) {
            const Eigen::Matrix<double, 6, 1> &pose = step.f[static_cast<size_t>(block_of(static_cast<int>(f)))];
            state_.rotation[f] = geometry::rotation_exp(pose.head<3>()) * saved_.rotation[f];
            state_.centre[f] = saved_.centre[f] + pose.tail<3>();
        }
        for (size_t e = 0; e < state_.point.size(); e++) {
            state_.point[e] = saved_.point[e] + step.e[e];
        }
        if (options_.odometry) {
            state_.wheel = saved_.wheel + step.g[0];
        }
        if (options_.gravity) {
            state_.down =
                (saved_.down + geometry::tangent_basis(saved_.down) * step.g.segment<2>(down_at_)).normalized();
        }
        if (sag_at_ >= 0) {
            state_.sag = saved_.sag + step.g.segment<3>(sag_at_);
        }
        if (late_at_ >= 0) {
            state_.late = saved_.late + step.g[late_at_];
        }
        if (camera_columns_ > 0) {
            state_.camera = saved_.camera + step.g.tail(camera_columns_);
            camera_ = changed_camera(original_, *options_.camera_prior, camera_change());
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

    const State &state() const { return state_; }
    const std::vector<int> &used() const { return place_; }
    int observations() const { return static_cast<int>(place_.size()); }
    int late_at() const { return late_at_; }
    Vector3d down() const { return options_.gravity ? state_.down : Vector3d(Vector3d::Zero()); }

    // Of the prior's parameters; empty without a prior.
    Eigen::VectorXd camera_change() const
    {
        return options_.camera_prior ? Eigen::VectorXd(options_.camera_prior->root * state_.camera) : Eigen::VectorXd();
    }

    // Of the pixels alone: what shares the border with them (wheel, gravity, priors) tells that border, and the scale.
    int redundancy() const
    {
        const int frames = banded() - options_.held_front - options_.held_back;
        const bool scale_free = options_.hold_scale || options_.odometry;
        return std::max(2 * observations() - 6 * frames - 3 * eliminated() + (scale_free ? 1 : 0), 1);
    }

private:
    // The pupil's shift is a length, and would say how long the wheel's metre is: in truth it is known too badly for
    // that, and what is wrong with the tracks would be read as a scale. So it is taken in the wheel's metres, too.
    bool measures_pupil() const { return options_.odometry && original_.pupil_e1 != 0.0; }
    double yardstick() const { return measures_pupil() ? 1.0 + state_.wheel : 1.0; }

    // One over the sigmas of the sag's parts.
    Vector3d sag_root() const { return Vector3d(1.0, 2.0, 2.0) / options_.sag_sigma; }

    // How far the sag moves observation k.
    Vector2d sagged(size_t k) const
    {
        return sag_at_ >= 0 ? Vector2d(sag_columns(sag_[k]) * state_.sag) : Vector2d(Vector2d::Zero());
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
                    const Vector2d out = Eigen::Map<const Vector2d>(pixel_.data() + 2 * k) - centre;
                    sag_[k] = sag_of(first, now, original_.f_u) * out.stableNormalized();
                }
            }
        }
    }

    bool rolls() const { return !moment_.empty(); }
    double share_at(size_t k) const { return rolls() ? state_.late * moment_[k].share : 0.0; }

    // The camera's rotation at observation k, and how it turns with the two frames it lies between; its centre.
    geometry::TurnBetween turn_at(size_t k) const
    {
        const size_t f = static_cast<size_t>(frame_[k]);
        if (!rolls()) {
            return {state_.rotation[f], Matrix3d::Identity(), Matrix3d::Zero()};
        }
        return geometry::turn_between(state_.rotation[f], turn_towards(f, moment_[k].other), share_at(k));
    }
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

    // The blocks of the newest point's observations, from place `from` on.
    void couple(size_t from)
    {
        const size_t begin = coupled_.size();
        for (size_t k = from; k < place_.size(); k++) {
            coupled_.push_back(block_of(frame_[k]));
            if (rolls()) {
                coupled_.push_back(block_of(moment_[k].other));
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

    // Blocks run from the last frame to the first, which is held: the covariance then grows along the recursion that
    // makes it, block by block. The other way round it would be what is left of differences, of the far end's.
    int block_of(int f) const { return banded() - 1 - f; }

    bool is_wanted(int place, double squared) const
    {
        if (options_.only) {
            return std::binary_search(wanted_.begin(), wanted_.end(), place);
        }
        return std::isfinite(squared) && (options_.gate <= 0.0 || squared < options_.gate * options_.gate);
    }

    bool is_held(int f) const { return f < options_.held_front || f >= banded() - options_.held_back; }

    void set_border()
    {
        if (options_.odometry) {
            border_ = 1;
        }
        if (options_.gravity && !start_gravity()) {
            options_.gravity = nullptr;
        }
        if (options_.gravity) {
            down_at_ = border_;
            border_ += 2;
        }
        if (options_.sag_sigma > 0.0) {
            sag_at_ = border_;
            border_ += 3;
        }
        if (options_.late_sigma > 0.0 && rolls()) {
            late_at_ = border_++;
        }
        if (options_.camera_prior) {
            camera_columns_ = static_cast<int>(options_.camera_prior->root.cols());
            border_ += camera_columns_;
            state_.camera = Eigen::VectorXd::Zero(camera_columns_);
        }
    }

    // False where the inclinometer says nothing of these frames: nothing would tell where down is.
    bool start_gravity()
    {
        Vector3d sum = Vector3d::Zero();
        bool known = false;
        for (size_t f = 0; f < state_.rotation.size(); f++) {
            const Vector3d &down = options_.gravity->down[f + static_cast<size_t>(first_)];
            known = known || !down.isZero();
            sum += state_.rotation[f].transpose() * down;
        }
        state_.down = sum.isZero() ? Vector3d(Vector3d::UnitY()) : Vector3d(sum.normalized());
        return known;
    }

    bool has_step(int f) const { return std::isfinite(options_.odometry->step[static_cast<size_t>(f + first_)]); }

    optim::RobustLoss slip() const
    {
        return optim::RobustLoss{optim::RobustLoss::Kind::mixture, options_.odometry->slip_spread,
                                 options_.odometry->slip_share};
    }

    double step_residual(int f, Vector3d *direction) const
    {
        const size_t i = static_cast<size_t>(f), global = static_cast<size_t>(f + first_);
        const Vector3d moved = state_.centre[i + 1] - state_.centre[i];
        const double length = moved.norm();
        if (direction) {
            *direction = length > 0.0 ? Vector3d(moved / length) : Vector3d(Vector3d::Zero());
        }
        // In readings, whose noise it is: in metres the fit would shrink everything to make the noise smaller.
        return (length / (1.0 + state_.wheel) - std::abs(options_.odometry->step[global])) /
               options_.odometry->sigma[global];
    }

    Vector2d down_residual(int f) const
    {
        const size_t i = static_cast<size_t>(f);
        const Vector3d &measured = options_.gravity->down[i + static_cast<size_t>(first_)];
        return geometry::tangent_basis(measured).transpose() * (state_.rotation[i] * state_.down) /
               options_.gravity->sigma;
    }

    double scale_residual() const
    {
        return ((state_.centre.back() - state_.centre.front()).norm() / start_length_ - 1.0) / SCALE_SIGMA;
    }

    bool holds_scale() const { return options_.hold_scale && !options_.odometry && options_.held_back == 0; }

    double cost_rest() const
    {
        double sum = 0.0;
        if (holds_scale()) {
            sum += scale_residual() * scale_residual();
        }
        if (options_.odometry) {
            const optim::RobustLoss loss = slip();
            for (int f = 0; f + 1 < banded(); f++) {
                if (has_step(f)) {
                    const double r = step_residual(f, nullptr);
                    sum += loss(r * r).rho;
                }
            }
            sum += std::pow(state_.wheel / options_.odometry->scale_sigma, 2);
        }
        if (options_.gravity) {
            for (int f = 0; f < banded(); f++) {
                if (!options_.gravity->down[static_cast<size_t>(f + first_)].isZero()) {
                    sum += down_residual(f).squaredNorm();
                }
            }
        }
        if (sag_at_ >= 0) {
            sum += sag_root().cwiseProduct(state_.sag).squaredNorm();
        }
        if (late_at_ >= 0) {
            sum += std::pow((state_.late - 1.0) / options_.late_sigma, 2);
        }
        if (camera_columns_ > 0) {
            sum += state_.camera.squaredNorm();
        }
        return 0.5 * sum;
    }

    template <class Sink> void linearize_rest(Sink &sink) const
    {
        const optim::RobustLoss plain;
        for (int f = 0; f < banded(); f++) {
            if (is_held(f)) { // its derivatives are left out everywhere else
                const Eigen::Matrix<double, 6, 1> zero = Eigen::Matrix<double, 6, 1>::Zero();
                const Rows<6, 6> one = Rows<6, 6>::Identity();
                const std::array<const double *, 1> j{one.data()};
                const int block = block_of(f);
                sink.add(6, zero.data(), plain, nullptr, std::span(&block, 1), j, nullptr);
            }
        }
        if (holds_scale()) {
            const int last = block_of(banded() - 1);
            const double r = scale_residual();
            Rows<1, 6> j_last = Rows<1, 6>::Zero();
            j_last.rightCols<3>() =
                (state_.centre.back() - state_.centre.front()).normalized().transpose() / (start_length_ * SCALE_SIGMA);
            const std::array<const double *, 1> j{j_last.data()};
            sink.add(1, &r, plain, nullptr, std::span(&last, 1), j, nullptr);
        }
        if (options_.odometry) {
            linearize_odometry(sink);
        }
        if (options_.gravity) {
            linearize_gravity(sink);
        }
        if (sag_at_ >= 0) {
            RowsX j = RowsX::Zero(3, border_);
            j.middleCols<3>(sag_at_) = sag_root().asDiagonal();
            const Vector3d r = sag_root().cwiseProduct(state_.sag);
            sink.add(3, r.data(), plain, nullptr, {}, {}, j.data());
        }
        if (late_at_ >= 0) {
            RowsX j = RowsX::Zero(1, border_);
            j(0, late_at_) = 1.0 / options_.late_sigma;
            const double r = (state_.late - 1.0) / options_.late_sigma;
            sink.add(1, &r, plain, nullptr, {}, {}, j.data());
        }
        if (camera_columns_ > 0) {
            RowsX j = RowsX::Zero(camera_columns_, border_);
            j.rightCols(camera_columns_).setIdentity();
            sink.add(camera_columns_, state_.camera.data(), plain, nullptr, {}, {}, j.data());
        }
    }

    template <class Sink> void linearize_odometry(Sink &sink) const
    {
        const optim::RobustLoss loss = slip();
        RowsX j_border = RowsX::Zero(1, border_);
        for (int f = 0; f + 1 < banded(); f++) {
            if (!has_step(f)) {
                continue;
            }
            const size_t global = static_cast<size_t>(f + first_);
            const double gain = 1.0 + state_.wheel, inverse = 1.0 / (gain * options_.odometry->sigma[global]);
            Vector3d direction;
            const double r = step_residual(f, &direction);
            Rows<1, 6> j[2] = {Rows<1, 6>::Zero(), Rows<1, 6>::Zero()};
            const int frames[2] = {f, f + 1};
            for (int side = 0; side < 2; side++) {
                if (!is_held(frames[side])) {
                    j[side].rightCols<3>() = (side == 0 ? -inverse : inverse) * direction.transpose();
                }
            }
            const double length =
                (state_.centre[static_cast<size_t>(f) + 1] - state_.centre[static_cast<size_t>(f)]).norm();
            j_border(0, 0) = -inverse * length / gain;
            const std::array<const double *, 2> j_f{j[0].data(), j[1].data()};
            const int blocks[2] = {block_of(f), block_of(f + 1)};
            sink.add(1, &r, loss, nullptr, blocks, j_f, j_border.data());
        }
        j_border.setZero();
        j_border(0, 0) = 1.0 / options_.odometry->scale_sigma;
        const double r = state_.wheel * j_border(0, 0);
        sink.add(1, &r, optim::RobustLoss{}, nullptr, {}, {}, j_border.data());
    }

    template <class Sink> void linearize_gravity(Sink &sink) const
    {
        const Matrix32 basis = geometry::tangent_basis(state_.down);
        RowsX j_border = RowsX::Zero(2, border_);
        for (int f = 0; f < banded(); f++) {
            const Vector3d &measured = options_.gravity->down[static_cast<size_t>(f + first_)];
            if (measured.isZero()) {
                continue;
            }
            const size_t i = static_cast<size_t>(f);
            const Vector2d r = down_residual(f);
            const Matrix23 across = geometry::tangent_basis(measured).transpose() / options_.gravity->sigma;
            Rows<2, 6> j = Rows<2, 6>::Zero();
            if (!is_held(f)) {
                j.leftCols<3>() = -across * geometry::cross_matrix(state_.rotation[i] * state_.down);
            }
            j_border.middleCols(down_at_, 2) = across * state_.rotation[i] * basis;
            const std::array<const double *, 1> j_f{j.data()};
            const int block = block_of(f);
            sink.add(2, r.data(), optim::RobustLoss{}, nullptr, std::span(&block, 1), j_f, j_border.data());
        }
    }

    const TrackTable &table_;
    pf_camera original_, camera_;
    BundleOptions options_;
    int first_;
    State state_, saved_;
    std::vector<size_t> offset_; // of each point in place_, frame_ and moment_
    std::vector<int> place_, frame_, track_;
    std::vector<Moment> moment_; // where the shutter rolls; frames as in frame_
    std::vector<Vector3d> turn_; // likewise: from each frame to the next
    std::vector<size_t> coupled_offset_;
    std::vector<int> coupled_;              // blocks of each point
    std::vector<double> in_camera_, pixel_; // of all observations, at the state
    std::vector<uint8_t> seen_;
    std::vector<Vector2d> sag_; // where it is estimated: pixels by which each is off for each px^2 of it
    std::vector<int> wanted_;   // ascending
    int border_ = 0, down_at_ = 0, sag_at_ = -1, late_at_ = -1, camera_columns_ = 0;
    double start_length_ = 1.0;
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
    Problem problem(map, table, camera, options);
    Solver solver;
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
