#include "geometry/between.hpp"

#include <cmath>

namespace pipefish::geometry
{

namespace
{

// Exp(v + dv) = Exp(J dv) Exp(v) to first order (Chirikjian, Stochastic Models II, eq. 10.86), and J's inverse.
Matrix3d left_jacobian(const Vector3d &v)
{
    const double s = v.squaredNorm(), angle = std::sqrt(s);
    const Matrix3d k = cross_matrix(v);
    const double a = s < 1e-6 ? 0.5 - s / 24.0 : (1.0 - std::cos(angle)) / s;
    const double b = s < 1e-6 ? 1.0 / 6.0 - s / 120.0 : (angle - std::sin(angle)) / (s * angle);
    return Matrix3d::Identity() + a * k + b * k * k;
}

Matrix3d inverse_left_jacobian(const Vector3d &v)
{
    const double s = v.squaredNorm(), angle = std::sqrt(s);
    const Matrix3d k = cross_matrix(v);
    const double b = s < 1e-6 ? 1.0 / 12.0 + s / 720.0 : 1.0 / s - 0.5 / (angle * std::tan(0.5 * angle));
    return Matrix3d::Identity() - 0.5 * k + b * k * k;
}

} // namespace

Pose pose_between(const Pose &first, const Pose &second, double share)
{
    const Matrix3d r = rotation_exp(share * rotation_log(second.r * first.r.transpose())) * first.r;
    return {r, -r * ((1.0 - share) * first.centre() + share * second.centre())};
}

TurnBetween turn_between(const Matrix3d &r1, const Vector3d &turn, double share)
{
    TurnBetween out;
    const Matrix3d part = rotation_exp(share * turn);
    out.r = part * r1;
    // Log(Exp(w2) Exp(turn) Exp(-w1)) = turn + J(turn)^-1 (w2 - Exp(turn) w1).
    out.by_second = share * left_jacobian(share * turn) * inverse_left_jacobian(turn);
    out.by_first = part - out.by_second * rotation_exp(turn);
    return out;
}

} // namespace pipefish::geometry
