#include "calib/bundle.hpp"

#include "calib/centroid.hpp"

#include <Eigen/QR>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace pipefish::calib
{

namespace
{

using Row2x6 = Eigen::Matrix<double, 2, 6, Eigen::RowMajor>;
using Params = Eigen::Matrix<double, 2, PF_CAMERA_PARAMS, Eigen::RowMajor>;

constexpr double kSlopeFloor = 0.005;   // r' may not fall below, per radian of the axis
constexpr double kSlopeWeight = 1000.0; // a shortfall of 0.001 costs one standard deviation
constexpr int kSlopeChecks = 48;

// The parameters p23's unit vectors start at; others are not vectors of unit norm.
int unit_vector(uint32_t param)
{
    if (param >= PF_PARAM_ASYM_RADIAL_PHI && param < PF_PARAM_ASYM_TANGENTIAL_THETA) {
        return 0;
    }
    if (param >= PF_PARAM_ASYM_TANGENTIAL_PHI && param < PF_PARAM_TILT) {
        return 1;
    }
    return -1;
}

uint32_t unit_start(int which)
{
    return which == 0 ? PF_PARAM_ASYM_RADIAL_PHI : PF_PARAM_ASYM_TANGENTIAL_PHI;
}

bool is_asymmetry(uint32_t param)
{
    return (param >= PF_PARAM_ASYM_RADIAL_THETA && param < PF_PARAM_TILT) || param >= PF_PARAM_CPOLY;
}

double &parameter(pf_camera &camera, uint32_t param)
{
    return *pf_camera_param_at(&camera, param);
}

double parameter(const pf_camera &camera, uint32_t param)
{
    pf_camera copy = camera;
    return *pf_camera_param_at(&copy, param);
}

Eigen::Matrix<double, 4, 3> tangent_of(const pf_camera &camera, int which)
{
    Eigen::Vector4d v;
    for (uint32_t i = 0; i < 4; i++) {
        v[i] = parameter(camera, unit_start(which) + i);
    }
    const Eigen::HouseholderQR<Eigen::Vector4d> qr(v);
    const Eigen::Matrix4d q = qr.householderQ();
    return q.rightCols<3>();
}

// Where a saddle of unit slope along the board's axes moves under a unit slope of brightness along the image's radius:
// the board's gradient with its axes exchanged. `by_board` (2x2): pixels by the board's plane.
Eigen::Vector2d corner_shift(const Camera &camera, const Eigen::Vector2d &pixel, const Eigen::Matrix2d &by_board)
{
    const Eigen::Vector2d radius(pixel.x() - camera.model.c_u, pixel.y() - camera.model.c_v);
    const Eigen::Vector2d slope = by_board.transpose() * radius / std::max(radius.norm(), 1e-9);
    return by_board * Eigen::Vector2d(slope.y(), slope.x()) / std::max(std::abs(by_board.determinant()), 1e-300);
}

double squared_angle(const Eigen::Vector3d &x)
{
    const double theta = std::atan2(std::hypot(x.x(), x.y()), x.z());
    return theta * theta;
}

// sum over the odd powers of r' and its derivatives by k2..k5.
double slope_at(const pf_camera &camera, double theta, double d[4])
{
    const double s = theta * theta;
    const double power[4] = {s, s * s, s * s * s, s * s * s * s};
    const double k[4] = {camera.k2, camera.k3, camera.k4, camera.k5};
    double slope = 1.0;
    for (int i = 0; i < 4; i++) {
        d[i] = (2.0 * i + 3.0) * power[i];
        slope += k[i] * d[i];
    }
    return slope;
}

} // namespace

double rising_end(const pf_camera &camera, double end)
{
    double before = 0.0;
    constexpr int steps = 720;
    for (int i = 1; i <= steps; i++) {
        const double theta = end * i / steps;
        double slope = 0.0;
        (void)pf_camera_radius(&camera, theta, &slope);
        if (!(slope > kSlopeFloor * 0.2)) {
            return before;
        }
        before = theta;
    }
    return end;
}

int Bundle::unknowns(const Camera &camera) const
{
    int count = 0;
    for (const uint32_t p : camera.free) {
        count += unit_vector(p) < 0 || p == unit_start(unit_vector(p)) ? (unit_vector(p) < 0 ? 1 : 3) : 0;
    }
    return count;
}

void Bundle::arrange()
{
    layout_ = {};
    const auto take = [this](int count) {
        const int first = count > 0 ? layout_.size : -1;
        layout_.size += count;
        return first;
    };
    tangents_.clear();
    for (const Camera &camera : cameras) {
        layout_.camera.push_back(take(unknowns(camera)));
        layout_.camera_pose.push_back(take(camera.pose_free ? 6 : 0));
        layout_.corner.push_back(take(camera.corner_free ? 2 : 0));
        tangents_.push_back({tangent_of(camera.model, 0), tangent_of(camera.model, 1)});
    }
    for (const Board &board : boards) {
        layout_.shape.push_back(take(static_cast<int>(board.free.size())));
        layout_.board_pose.push_back(take(board.pose_free ? 6 : 0));
    }
    views_of_frame_.assign(frames.size(), {});
    for (size_t v = 0; v < views.size(); v++) {
        views_of_frame_[static_cast<size_t>(views[v].frame)].push_back(static_cast<int>(v));
    }
}

Eigen::MatrixXd Bundle::parameter_slope(int index) const
{
    const Camera &camera = cameras[static_cast<size_t>(index)];
    Eigen::MatrixXd slope = Eigen::MatrixXd::Zero(PF_CAMERA_PARAMS, unknowns(camera));
    int column = 0;
    for (const uint32_t p : camera.free) {
        const int which = unit_vector(p);
        if (which < 0) {
            slope(p, column++) = 1.0;
        } else if (p == unit_start(which)) {
            slope.block<4, 3>(p, column) = tangents_[static_cast<size_t>(index)][static_cast<size_t>(which)];
            column += 3;
        }
    }
    return slope;
}

Eigen::Vector3d Bundle::in_camera(const View &view, const Observation &point) const
{
    const Board &board = boards[static_cast<size_t>(view.board)];
    return cameras[static_cast<size_t>(view.camera)].from_rig *
           (frames[static_cast<size_t>(view.frame)] * (board.to_rig * board.shape.at(point.drawn, nullptr)));
}

bool Bundle::project_point(const View &view, const Eigen::Vector3d &drawn, double parity, Eigen::Vector2d &pixel,
                           double *d_frame, double *d_border) const
{
    const size_t c = static_cast<size_t>(view.camera), b = static_cast<size_t>(view.board);
    const Camera &camera = cameras[c];
    const Board &board = boards[b];
    Eigen::Matrix<double, 3, kShape> d_shape;
    const bool derive = d_frame != nullptr;
    const bool derive_shape = derive && layout_.shape[b] >= 0;
    const Eigen::Vector3d at_board = board.shape.at(drawn, derive_shape ? &d_shape : nullptr);
    const Pose &frame = frames[static_cast<size_t>(view.frame)];
    const Eigen::Vector3d at_rig_board = board.to_rig * at_board;
    const Eigen::Vector3d turned = frame.rotation * at_rig_board;
    const Eigen::Vector3d at_rig = turned + frame.translation;
    const Eigen::Vector3d at_camera = camera.from_rig * at_rig;
    const bool corners = parity != 0.0 && (camera.corner_free || camera.corner[0] != 0.0 || camera.corner[1] != 0.0);
    Eigen::Matrix<double, 2, 3, Eigen::RowMajor> d_point;
    Eigen::Vector2d shift = Eigen::Vector2d::Zero();
    double square = 0.0; // theta^2
    if (!derive) {
        if (pf_camera_project(&camera.model, at_camera.data(), pixel.data(), corners ? d_point.data() : nullptr,
                              nullptr) != PF_OK) {
            return false;
        }
        if (corners) {
            shift = parity *
                    corner_shift(camera, pixel,
                                 d_point *
                                     (camera.from_rig.rotation * frame.rotation * board.to_rig.rotation).leftCols<2>());
            square = squared_angle(at_camera);
            pixel += (camera.corner[0] + camera.corner[1] * square) * shift;
        }
        return true;
    }
    Params d_params;
    const bool wanted = layout_.camera[c] >= 0;
    if (pf_camera_project(&camera.model, at_camera.data(), pixel.data(), d_point.data(),
                          wanted ? d_params.data() : nullptr) != PF_OK) {
        return false;
    }
    const Eigen::Matrix<double, 2, 3> by_rig = d_point * camera.from_rig.rotation;
    if (corners) { // a tenth of a pixel that hardly changes with anything but its own two numbers
        shift = parity * corner_shift(camera, pixel, by_rig * (frame.rotation * board.to_rig.rotation).leftCols<2>());
        square = squared_angle(at_camera);
        pixel += (camera.corner[0] + camera.corner[1] * square) * shift;
    }
    Eigen::Map<Row2x6> jf(d_frame);
    jf.leftCols<3>() = -by_rig * cross(turned);
    jf.rightCols<3>() = by_rig;
    if (layout_.size == 0) {
        return true;
    }
    using Wide = Eigen::Matrix<double, 2, Eigen::Dynamic, Eigen::RowMajor>;
    Eigen::Map<Wide> jg(d_border, 2, layout_.size);
    jg.setZero();
    if (wanted) {
        int column = layout_.camera[c];
        for (const uint32_t p : camera.free) {
            const int which = unit_vector(p);
            if (which < 0) {
                jg.col(column++) = d_params.col(p);
            } else if (p == unit_start(which)) {
                jg.middleCols<3>(column) = d_params.middleCols<4>(p) * tangents_[c][static_cast<size_t>(which)];
                column += 3;
            }
        }
    }
    if (layout_.camera_pose[c] >= 0) {
        jg.middleCols<3>(layout_.camera_pose[c]) = -d_point * cross(camera.from_rig.rotation * at_rig);
        jg.middleCols<3>(layout_.camera_pose[c] + 3) = d_point;
    }
    if (layout_.corner[c] >= 0) {
        jg.col(layout_.corner[c]) = shift;
        jg.col(layout_.corner[c] + 1) = square * shift;
    }
    const Eigen::Matrix<double, 2, 3> by_rig_board = by_rig * frame.rotation;
    if (derive_shape) {
        const Eigen::Matrix<double, 2, 3> by_board = by_rig_board * board.to_rig.rotation;
        int column = layout_.shape[b];
        for (const int i : board.free) {
            jg.col(column++) = by_board * d_shape.col(i);
        }
    }
    if (layout_.board_pose[b] >= 0) {
        jg.middleCols<3>(layout_.board_pose[b]) = -by_rig_board * cross(board.to_rig.rotation * at_board);
        jg.middleCols<3>(layout_.board_pose[b] + 3) = by_rig_board;
    }
    return true;
}

Eigen::Vector3d Observation::on_sheet(double x, double y) const
{
    const double curvature = bend.norm(), angle = x * curvature;
    if (curvature == 0.0) {
        return drawn + x * across + y * down;
    }
    const double half = std::sin(0.5 * angle); // 1 - cos without cancelling
    return drawn + std::sin(angle) / curvature * across + 2.0 * half * half / (curvature * curvature) * bend + y * down;
}

bool Bundle::project(const View &view, const Observation &point, Eigen::Vector2d &pixel, double *d_frame,
                     double *d_border) const
{
    if (circle_radius <= 0.0) {
        return project_point(view, point.drawn, point.parity, pixel, d_frame, d_border);
    }
    const std::array<Eigen::Vector2d, kRim> &directions = rim_directions();
    Eigen::Matrix<double, kRim, 2> rim;
    std::vector<double> jf(d_frame ? kRim * 12 : 0);
    std::vector<double> jg(d_frame ? static_cast<size_t>(kRim * 2 * layout_.size) : 0);
    for (size_t i = 0; i < kRim; i++) {
        const Eigen::Vector3d edge =
            point.on_sheet(circle_radius * directions[i].x(), circle_radius * directions[i].y());
        Eigen::Vector2d at;
        double *f = d_frame ? jf.data() + i * 12 : nullptr;
        double *g = d_frame ? jg.data() + i * static_cast<size_t>(2 * layout_.size) : nullptr;
        if (!project_point(view, edge, 0.0, at, f, g)) {
            return false;
        }
        rim.row(static_cast<Eigen::Index>(i)) = at;
    }
    std::array<Eigen::Matrix2d, kRim> d;
    pixel = centroid(rim, d_frame ? &d : nullptr);
    if (d_frame) {
        using Wide = Eigen::Matrix<double, 2, Eigen::Dynamic, Eigen::RowMajor>;
        Eigen::Map<Row2x6> sum_f(d_frame);
        Eigen::Map<Wide> sum_g(d_border, 2, layout_.size);
        sum_f.setZero();
        sum_g.setZero();
        for (size_t i = 0; i < kRim; i++) {
            sum_f += d[i] * Eigen::Map<const Row2x6>(jf.data() + i * 12);
            sum_g +=
                d[i] * Eigen::Map<const Wide>(jg.data() + i * static_cast<size_t>(2 * layout_.size), 2, layout_.size);
        }
    }
    return pixel.allFinite();
}

double Bundle::loss(double square, double *weight) const
{
    const optim::RobustLoss robust{huber > 0.0 ? optim::RobustLoss::Kind::huber : optim::RobustLoss::Kind::squared,
                                   huber};
    const optim::RobustLoss::Value value = robust(square);
    if (weight) {
        *weight = value.weight;
    }
    return value.rho;
}

double Bundle::cost(int frame) const
{
    double sum = 0.0;
    if (frame < 0) {
        Rows rows;
        fill_common(rows);
        for (const double r : rows.residual) {
            sum += r * r;
        }
        return 0.5 * sum;
    }
    for (const int v : views_of_frame_[static_cast<size_t>(frame)]) {
        const View &view = views[static_cast<size_t>(v)];
        for (const Observation &point : view.points) {
            if (!point.used) {
                continue;
            }
            Eigen::Vector2d at;
            if (!project(view, point, at, nullptr, nullptr)) {
                return std::numeric_limits<double>::infinity();
            }
            sum += loss((at - point.pixel).squaredNorm() / (point.sigma * point.sigma), nullptr);
        }
    }
    return 0.5 * sum;
}

void Bundle::fill(int frame, Rows &rows) const
{
    const size_t width = static_cast<size_t>(layout_.size);
    std::array<double, 12> jf{};
    std::vector<double> jg(2 * width);
    size_t points = 0;
    for (const int v : views_of_frame_[static_cast<size_t>(frame)]) {
        points += views[static_cast<size_t>(v)].points.size();
    }
    rows.residual.reserve(2 * points);
    rows.frame.reserve(12 * points);
    rows.border.reserve(2 * width * points);
    for (const int v : views_of_frame_[static_cast<size_t>(frame)]) {
        const View &view = views[static_cast<size_t>(v)];
        for (const Observation &point : view.points) {
            Eigen::Vector2d at;
            if (!point.used || !project(view, point, at, jf.data(), jg.data())) {
                continue;
            }
            const Eigen::Vector2d error = (at - point.pixel) / point.sigma;
            double weight = 1.0;
            (void)loss(error.squaredNorm(), &weight);
            const double root = std::sqrt(weight), scale = root / point.sigma;
            rows.residual.push_back(root * error.x());
            rows.residual.push_back(root * error.y());
            for (const double j : jf) {
                rows.frame.push_back(scale * j);
            }
            for (const double j : jg) {
                rows.border.push_back(scale * j);
            }
        }
    }
    if (rows.residual.empty()) { // nothing sees this frame: it stays
        rows.residual.assign(6, 0.0);
        rows.frame.assign(36, 0.0);
        for (size_t i = 0; i < 6; i++) {
            rows.frame[7 * i] = 1.0;
        }
        rows.border.assign(6 * width, 0.0);
    }
}

void Bundle::fill_common(Rows &rows) const
{
    const size_t width = static_cast<size_t>(layout_.size);
    const auto push = [&](double residual) {
        rows.residual.push_back(residual);
        rows.border.resize(rows.border.size() + width, 0.0);
        return rows.border.data() + rows.border.size() - width;
    };
    for (size_t c = 0; c < cameras.size(); c++) {
        const Camera &camera = cameras[c];
        int column = layout_.camera[c];
        std::array<int, 4> k{-1, -1, -1, -1};
        for (const uint32_t p : camera.free) {
            if (unit_vector(p) >= 0) {
                column += p == unit_start(unit_vector(p)) ? 3 : 0;
                continue;
            }
            if (p >= PF_PARAM_K2 && p <= PF_PARAM_K5) {
                k[p - PF_PARAM_K2] = column;
            }
            const double sigma = is_asymmetry(p) ? priors.asymmetry : p == PF_PARAM_PUPIL_E1 ? priors.pupil : 0.0;
            if (sigma > 0.0) {
                push(parameter(camera.model, p) / sigma)[column] = 1.0 / sigma;
            }
            column++;
        }
        if (layout_.corner[c] >= 0) {
            for (size_t i = 0; i < 2; i++) {
                push(camera.corner[i] / priors.corner)[layout_.corner[c] + static_cast<int>(i)] = 1.0 / priors.corner;
            }
        }
        if (camera.model.radial != PF_RADIAL_GENERIC || k[0] < 0) {
            continue;
        }
        for (int i = 1; i <= kSlopeChecks && camera.theta_end > 0.0; i++) {
            double d[4];
            const double short_of = kSlopeFloor - slope_at(camera.model, camera.theta_end * i / kSlopeChecks, d);
            if (short_of > 0.0) {
                double *row = push(kSlopeWeight * short_of);
                for (size_t j = 0; j < 4; j++) {
                    if (k[j] >= 0) {
                        row[k[j]] = -kSlopeWeight * d[j];
                    }
                }
            }
        }
    }
    for (size_t b = 0; b < boards.size(); b++) {
        int column = layout_.shape[b];
        for (const int i : boards[b].free) {
            push(boards[b].shape.coefficient[static_cast<size_t>(i)] / priors.shape)[column++] = 1.0 / priors.shape;
        }
    }
}

void Bundle::apply(const optim::Step<kFrame, 1> &step)
{
    cameras = saved_.cameras;
    boards = saved_.boards;
    for (size_t f = 0; f < frames.size(); f++) {
        frames[f] = saved_.frames[f].moved(step.e[f]);
    }
    if (layout_.size == 0) {
        return;
    }
    for (size_t c = 0; c < cameras.size(); c++) {
        Camera &camera = cameras[c];
        int column = layout_.camera[c];
        for (const uint32_t p : camera.free) {
            const int which = unit_vector(p);
            if (which < 0) {
                parameter(camera.model, p) += step.g[column++];
            } else if (p == unit_start(which)) {
                // The saved camera's tangent space: derivatives were taken there.
                const Eigen::Vector4d turn = tangent_of(saved_.cameras[c].model, which) * step.g.segment<3>(column);
                column += 3;
                Eigen::Vector4d v;
                for (uint32_t i = 0; i < 4; i++) {
                    v[i] = parameter(camera.model, p + i) + turn[i];
                }
                v.normalize();
                for (uint32_t i = 0; i < 4; i++) {
                    parameter(camera.model, p + i) = v[i];
                }
            }
        }
        if (layout_.corner[c] >= 0) {
            camera.corner[0] += step.g[layout_.corner[c]];
            camera.corner[1] += step.g[layout_.corner[c] + 1];
        }
        if (layout_.camera_pose[c] >= 0) {
            camera.from_rig = camera.from_rig.moved(step.g.segment<6>(layout_.camera_pose[c]));
        }
        tangents_[c] = {tangent_of(camera.model, 0), tangent_of(camera.model, 1)};
    }
    for (size_t b = 0; b < boards.size(); b++) {
        Board &board = boards[b];
        int column = layout_.shape[b];
        for (const int i : board.free) {
            board.shape.coefficient[static_cast<size_t>(i)] += step.g[column++];
        }
        if (layout_.board_pose[b] >= 0) {
            board.to_rig = board.to_rig.moved(step.g.segment<6>(layout_.board_pose[b]));
        }
    }
}

double Bundle::theta_observed(int camera) const
{
    double theta = 0.0;
    for (const View &view : views) {
        for (const Observation &point : view.points) {
            if (view.camera == camera && point.used) {
                const Eigen::Vector3d x = in_camera(view, point);
                theta = std::max(theta, std::atan2(std::hypot(x.x(), x.y()), x.z()));
            }
        }
    }
    return theta;
}

optim::Summary Bundle::adjust(const optim::Options &options)
{
    arrange();
    optim::LeastSquares<kFrame, 1> solver;
    const optim::Summary summary = solver.minimize(*this, options);
    for (Pose &frame : frames) {
        frame.rotation = nearest_rotation(frame.rotation);
    }
    return summary;
}

Eigen::MatrixXd Bundle::uncertainty() const
{
    const Eigen::Index width = layout_.size;
    Eigen::MatrixXd reduced = Eigen::MatrixXd::Zero(width, width);
    using Wide = Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>;
    for (int f = -1; f < eliminated(); f++) {
        Rows rows;
        f < 0 ? fill_common(rows) : fill(f, rows);
        const Eigen::Index count = static_cast<Eigen::Index>(rows.residual.size());
        const Wide jg(rows.border.data(), count, width);
        reduced.noalias() += jg.transpose() * jg;
        if (f < 0) {
            continue;
        }
        const Wide je(rows.frame.data(), count, 6);
        const Eigen::LLT<Eigen::Matrix<double, 6, 6>> llt(je.transpose() * je);
        if (llt.info() != Eigen::Success) {
            throw std::domain_error("calibration: a view does not determine its pose");
        }
        const Eigen::MatrixXd cross_term = je.transpose() * jg;
        reduced.noalias() -= cross_term.transpose() * llt.solve(cross_term);
    }
    const Eigen::VectorXd scale = reduced.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
    const Eigen::LLT<Eigen::MatrixXd> llt(scale.asDiagonal() * reduced * scale.asDiagonal());
    if (width > 0 && (llt.info() != Eigen::Success || !(llt.rcond() > 1e-14))) {
        throw std::domain_error("calibration: the views do not determine all of the model");
    }
    if (width == 0) {
        return reduced;
    }
    return scale.asDiagonal() * llt.solve(Eigen::MatrixXd::Identity(width, width)) * scale.asDiagonal();
}

} // namespace pipefish::calib
