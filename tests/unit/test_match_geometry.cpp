// What quasi-dense matching rests on: the affine map from second moments of a blob, in both forms, and the constraint
// that a rigid motion puts on it, for surfaces seen by a pinhole and by a fisheye camera beyond 90 degrees. Tolerances
// are rounding. That growth uses them well is the subject of tests/python/test_match.py.
#include "match/epipolar.hpp"
#include "match/moments.hpp"

#include "unity.h"

#include <Eigen/Dense>

#include <algorithm>
#include <cmath>
#include <random>

extern "C" void setUp() {}
extern "C" void tearDown() {}

namespace
{

using namespace pipefish::match;
using Eigen::Matrix2d, Eigen::Matrix3d, Eigen::Vector2d, Eigen::Vector3d;
using Slope23 = Eigen::Matrix<double, 2, 3, Eigen::RowMajor>;
using Slope32 = Eigen::Matrix<double, 3, 2, Eigen::RowMajor>;

// Moments of a Gaussian blob of covariance c by sums over a grid, which are exact for it to rounding.
struct Moments {
    Matrix2d intensity = Matrix2d::Zero(), gradient = Matrix2d::Zero();
    double mass = 0;

    explicit Moments(const Matrix2d &c)
    {
        const Matrix2d inverse = c.inverse();
        constexpr double kStep = 0.25, kReach = 40;
        for (double y = -kReach; y <= kReach; y += kStep)
            for (double x = -kReach; x <= kReach; x += kStep) {
                const Vector2d v(x, y);
                const double f = std::exp(-0.5 * v.dot(inverse * v));
                const Vector2d slope = -f * inverse * v;
                intensity += f * v * v.transpose();
                gradient += slope * slope.transpose();
                mass += f;
            }
        intensity /= mass;
        gradient /= mass; // per unit of area that moves with the blob
    }
};

Matrix2d turn_between(const Vector2d &p, const Vector2d &q)
{
    const double a = std::atan2(p.x() * q.y() - p.y() * q.x(), p.dot(q));
    return Eigen::Rotation2Dd(a).toRotationMatrix();
}

Matrix2d maps[4];
const Matrix2d blob = (Matrix2d() << 9, 2, 2, 5).finished();

void fill_maps()
{
    maps[0] << 1.2, 0.1, -0.2, 0.9;
    maps[1] << 0.6, -0.4, 0.5, 0.8;
    maps[2] << -0.9, 0.3, -0.2, -1.3;
    maps[3] << 1.6, 0, 0, 0.7;
}

// The map from both blobs' moments, the rotation from one direction d and its image, as epipolar lines give them.
Matrix2d recovered(const Matrix2d &m, const Matrix2d &m_2, const Matrix2d &a, bool gradient)
{
    const Vector2d d(0.8, 0.6), d_2 = a * d;
    const Matrix2d t = gradient ? root(m) : Matrix2d(root(m).inverse());
    const Matrix2d t_2 = gradient ? root(m_2) : Matrix2d(root(m_2).inverse());
    return map_of_moments(m, m_2, turn_between(t * d, t_2 * d_2), gradient);
}

void test_the_map_comes_back_from_moments_of_intensity()
{
    fill_maps();
    for (const Matrix2d &a : maps) {
        const Moments one(blob), two(a * blob * a.transpose());
        const Matrix2d got = recovered(one.intensity, two.intensity, a, false);
        TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0, (got - a).norm());
    }
}

void test_the_map_comes_back_from_moments_of_the_gradient()
{
    fill_maps();
    for (const Matrix2d &a : maps) {
        const Moments one(blob), two(a * blob * a.transpose());
        const Matrix2d got = recovered(one.gradient, two.gradient, a, true);
        TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0, (got - a).norm());
    }
}

// Mixing the two forms is the classical mistake; this shows that the tests above would notice it.
void test_one_forms_moments_in_the_others_formula_do_not_give_the_map()
{
    fill_maps();
    for (const Matrix2d &a : maps) {
        const Moments one(blob), two(a * blob * a.transpose());
        TEST_ASSERT_TRUE((recovered(one.gradient, two.gradient, a, false) - a).norm() > 0.1);
        TEST_ASSERT_TRUE((recovered(one.intensity, two.intensity, a, true) - a).norm() > 0.1);
    }
}

pf_camera camera_of(pf_radial radial, double theta_max)
{
    pf_camera c = {};
    c.radial = radial;
    c.width = 1280;
    c.height = 960;
    c.f_u = 310;
    c.f_v = 305;
    c.c_u = 640;
    c.c_v = 470;
    c.theta_max = theta_max;
    if (radial == PF_RADIAL_GENERIC)
        c.k2 = -0.02;
    return c;
}

struct Scene {
    pf_camera camera;
    Matrix3d r;
    Vector3d t;
};

Scene scene_of(const pf_camera &camera)
{
    const Matrix3d r = (Eigen::AngleAxisd(0.21, Vector3d(0.2, 1, 0.1).normalized())).toRotationMatrix();
    return {camera, r, {0.3, -0.05, 0.12}};
}

// The exact map at a point of a surface with this normal, both in camera 1's frame, and the constraint's residual
// there, over the size of its terms. Negative where a camera does not see the point.
double residual_at(const Scene &s, const Vector3d &point, const Vector3d &normal, double *distance)
{
    double x[2], x_2[2];
    Slope23 j_2;
    const Vector3d there = s.r * point + s.t;
    if (pf_camera_project(&s.camera, point.data(), x, nullptr, nullptr) != PF_OK ||
        pf_camera_project(&s.camera, there.data(), x_2, j_2.data(), nullptr) != PF_OK)
        return -1;
    Vector3d ray;
    Slope32 j;
    if (pf_camera_unproject(&s.camera, x, ray.data(), nullptr, j.data()) != PF_OK || std::abs(ray.dot(normal)) < 0.05)
        return -1;
    // The point stays on the tangent plane as the ray turns.
    const Matrix3d along = Matrix3d::Identity() - ray * normal.transpose() / ray.dot(normal);
    const Matrix2d a = j_2 * s.r * (point.norm() * along * j);
    Eigen::Matrix<double, 3, 4> pose;
    pose << s.r, s.t;
    const Epipolar epipolar(s.camera, s.camera, pose);
    const auto line = epipolar.at({x[0], x[1]}, {x_2[0], x_2[1]});
    TEST_ASSERT_TRUE(line.has_value());
    *distance = line->distance();
    return (a.transpose() * line->n_2 + line->n).norm() / (a.norm() * line->n_2.norm() + line->n.norm());
}

void check_surfaces(const Scene &s, int least)
{
    std::mt19937_64 random(5);
    std::uniform_real_distribution<double> u(-1, 1);
    int seen = 0, beyond = 0;
    for (int k = 0; k < 4000; k++) {
        const bool plane = k % 2 == 0;
        Vector3d point, normal;
        if (plane) { // slanted, 2 m ahead
            normal = Vector3d(0.2, -0.3, 1).normalized();
            point = {3 * u(random), 3 * u(random), 0};
            point.z() = 2 - (normal.x() * point.x() + normal.y() * point.y()) / normal.z();
        } else { // a pipe of 0.8 m around z, camera inside and aside
            const double phi = 3.14159265358979 * u(random);
            normal = {std::cos(phi), std::sin(phi), 0};
            point = 0.8 * normal + Vector3d(0.1, -0.2, 1.5 * u(random));
        }
        double distance = 0;
        const double residual = residual_at(s, point, normal, &distance);
        if (residual < 0)
            continue;
        seen++;
        beyond += point.z() < 0;
        TEST_ASSERT_DOUBLE_WITHIN(1e-9, 0, residual);
        TEST_ASSERT_DOUBLE_WITHIN(1e-8, 0, distance);
    }
    TEST_ASSERT_TRUE(seen > least);
    if (s.camera.theta_max > 2)
        TEST_ASSERT_TRUE(beyond > 200); // behind the image plane
}

void test_the_epipolar_constraint_holds_on_planes_and_cylinders_for_a_pinhole()
{
    check_surfaces(scene_of(camera_of(PF_RADIAL_PERSPECTIVE, 1.3)), 1000);
}

void test_the_epipolar_constraint_holds_on_planes_and_cylinders_for_a_fisheye_to_145_degrees()
{
    check_surfaces(scene_of(camera_of(PF_RADIAL_GENERIC, 145 * 3.14159265358979 / 180)), 2000);
}

// A correction leaves no residual, and the map that was right as it was.
void test_a_corrected_map_fulfils_the_constraint()
{
    const EpipolarLine line{0, {0.3, -0.7}, {-0.4, 0.5}, 0.01};
    Eigen::Matrix2f a;
    a << 1.1F, 0.2F, -0.1F, 0.8F;
    const Eigen::Matrix2f once = line.corrected(a), twice = line.corrected(once);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0, (once.cast<double>().transpose() * line.n_2 + line.n).norm());
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0, static_cast<double>((twice - once).norm()));
    TEST_ASSERT_TRUE((once - a).norm() > 0.1F);
}

// A camera that moves forwards towards a wall: image 2 is image 1, 1.25 times as large about the epipole. Matches are
// wrong by 0.1 px, the map is exact. Far from the epipole a correction moves it by less than a fit's own error
// (0.013); near it, where both normals vanish together, it is to be left alone.
void test_near_the_epipole_the_lines_move_no_map()
{
    pf_camera camera = camera_of(PF_RADIAL_PERSPECTIVE, 1.3);
    camera.f_v = camera.f_u;
    Eigen::Matrix<double, 3, 4> pose = Eigen::Matrix<double, 3, 4>::Identity();
    pose(2, 3) = -0.2;
    const Epipolar epipolar(camera, camera, pose);
    const Vector2d middle(camera.c_u, camera.c_v);
    const Eigen::Matrix2f exact = 1.25F * Eigen::Matrix2f::Identity();
    std::mt19937_64 random(3);
    std::normal_distribution<double> noise(0, 0.1);
    for (const double away : {0.5, 1.0, 1.5, 30.0, 100.0}) {
        double sum = 0, most = 0;
        for (int k = 0; k < 500; k++) {
            const Vector2d offset = away * Vector2d(std::cos(k), std::sin(k));
            const auto line =
                epipolar.at(middle + offset, middle + 1.25 * offset + Vector2d(noise(random), noise(random)));
            TEST_ASSERT_TRUE(line.has_value());
            const double moved = static_cast<double>((line->corrected(exact) - exact).norm());
            sum += moved;
            most = std::max(most, moved);
        }
        TEST_ASSERT_TRUE(away < 2 ? most == 0 : sum > 0 && sum / 500 < 0.013);
    }
}

} // namespace

int main()
{
    UNITY_BEGIN();
    RUN_TEST(test_the_map_comes_back_from_moments_of_intensity);
    RUN_TEST(test_the_map_comes_back_from_moments_of_the_gradient);
    RUN_TEST(test_one_forms_moments_in_the_others_formula_do_not_give_the_map);
    RUN_TEST(test_the_epipolar_constraint_holds_on_planes_and_cylinders_for_a_pinhole);
    RUN_TEST(test_the_epipolar_constraint_holds_on_planes_and_cylinders_for_a_fisheye_to_145_degrees);
    RUN_TEST(test_a_corrected_map_fulfils_the_constraint);
    RUN_TEST(test_near_the_epipole_the_lines_move_no_map);
    return UNITY_END();
}
