#include "tube/trace.hpp"

#include "counter_random.hpp"
#include "linalg/linalg.hpp"
#include "parallel.hpp"
#include "tube/nearest.hpp"

#include <Eigen/Geometry>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace pipefish::tube
{

using Eigen::Vector2d;
using Eigen::Vector3d;

namespace
{

constexpr int LOOK_AT = 1200; // points of a neighbourhood
constexpr int SEEDS = 10;     // places
constexpr int HYPOTHESES = 250;
constexpr double HALF = 0.75; // of a section, radii
constexpr double OFF = 0.3;   // radii: a section whose points lie further to one side hangs over the wall's end
constexpr double BAND = 0.05; // of the radius: what counts as on the wall

std::vector<int> thinned(const std::vector<int> &all, int count, uint64_t stream)
{
    if (static_cast<int>(all.size()) <= count) {
        return all;
    }
    std::vector<int> out;
    for (int i = 0; i < count; i++) { // one of each of `count` equal runs
        const size_t from = all.size() * static_cast<size_t>(i) / static_cast<size_t>(count);
        const size_t to = all.size() * static_cast<size_t>(i + 1) / static_cast<size_t>(count);
        out.push_back(all[from + hash64(2, stream, static_cast<uint64_t>(i)) % (to - from)]);
    }
    return out;
}

// Normal of the plane through the nearest points. Its sign means nothing.
std::vector<Vector3d> normals_of(const Eigen::Matrix3Xd &points)
{
    constexpr int NEIGHBOURS = 16;
    const Nearest<3> nearest(points);
    std::vector<Vector3d> out;
    for (Eigen::Index i = 0; i < points.cols(); i++) {
        const std::vector<int> near = nearest.nearest(points.col(i), NEIGHBOURS);
        Vector3d mean = Vector3d::Zero();
        for (const int k : near) {
            mean += points.col(k);
        }
        mean /= static_cast<double>(near.size());
        Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
        for (const int k : near) {
            spread += (points.col(k) - mean) * (points.col(k) - mean).transpose();
        }
        out.push_back(linalg::symmetric_eigen<3>(spread).vectors.col(0));
    }
    return out;
}

// Share of the wall that is there, times how empty the inside is: 24 sectors by 4 rings over a length of three radii.
double score(const Eigen::Matrix3Xd &points, const Cylinder &c)
{
    constexpr int AROUND = 24, ALONG = 4;
    std::array<int, AROUND * ALONG> wall{}, inside{};
    for (Eigen::Index i = 0; i < points.cols(); i++) {
        const Vector3d x = points.col(i) - c.centre;
        const double z = x.dot(c.axis) / (3.0 * c.rho) + 0.5;
        if (z < 0.0 || z >= 1.0) {
            continue;
        }
        const Vector2d y = c.basis.transpose() * x;
        const double r = y.norm() / c.rho;
        if (r > 1.0 + BAND) {
            continue;
        }
        const double turn = std::atan2(y[1], y[0]) / (2.0 * std::numbers::pi) + 0.5;
        const int cell = std::min(AROUND - 1, static_cast<int>(turn * AROUND)) * ALONG + static_cast<int>(z * ALONG);
        (r < 1.0 - BAND ? inside : wall)[static_cast<size_t>(cell)]++;
    }
    double sum = 0.0;
    for (size_t i = 0; i < wall.size(); i++) {
        if (wall[i] >= 2) {
            sum += std::max(0.0, static_cast<double>(wall[i] - inside[i]) / (wall[i] + inside[i]));
        }
    }
    return sum / (AROUND * ALONG);
}

// The cylinder through two points with the normals n1, n2.
bool cylinder_through(const Vector3d &p1, const Vector3d &n1, const Vector3d &p2, const Vector3d &n2, Cylinder &out)
{
    const Vector3d cross = n1.cross(n2);
    if (cross.norm() < 0.3) {
        return false; // under 17 degrees apart the axis is noise
    }
    out.axis = cross.normalized();
    out.basis = basis_across(out.axis, n1);
    const Vector2d d = out.basis.transpose() * (p2 - p1), m = out.basis.transpose() * n1,
                   k = out.basis.transpose() * n2;
    const double det = m[0] * -k[1] + k[0] * m[1];
    if (std::abs(det) < 1e-6) {
        return false;
    }
    const double t1 = (d[0] * -k[1] + k[0] * d[1]) / det; // p1 + t1 n1 = p2 + t2 n2 in the plane
    const Vector2d q = t1 * m;
    const double t2 = (q - d).dot(k);
    const double r1 = std::abs(t1), r2 = std::abs(t2);
    if (t1 * t2 == 0.0 || std::abs(r1 - r2) > 0.15 * std::max(r1, r2)) {
        return false;
    }
    out.rho = 0.5 * (r1 + r2);
    out.centre = p1 + out.basis * q + 0.5 * out.axis.dot(p2 - p1) * out.axis;
    return true;
}

struct Found {
    double score = 0.0;
    Cylinder cylinder;
    std::vector<int> index;
};

// Looks for a cylinder in one neighbourhood.
Found look(const Cloud &cloud, const std::vector<int> &around, uint64_t stream)
{
    Found best;
    best.index = thinned(around, LOOK_AT, stream);
    Eigen::Matrix3Xd points(3, static_cast<Eigen::Index>(best.index.size()));
    for (size_t i = 0; i < best.index.size(); i++) {
        points.col(static_cast<Eigen::Index>(i)) = cloud.points.col(best.index[i]);
    }
    const std::vector<Vector3d> normal = normals_of(points);
    const uint64_t n = normal.size();
    for (uint64_t i = 0; i < HYPOTHESES; i++) {
        const uint64_t bits = hash64(3, stream, i);
        const size_t a = mix64(bits) % n, b = mix64(bits + 1) % n;
        Cylinder c;
        if (a != b && cylinder_through(points.col(static_cast<Eigen::Index>(a)), normal[a],
                                       points.col(static_cast<Eigen::Index>(b)), normal[b], c)) {
            const double s = score(points, c);
            if (s > best.score) {
                best.score = s;
                best.cylinder = c;
            }
        }
    }
    return best;
}

bool good(const Cylinder &c)
{
    return c.status == FitStatus::ok || c.status == FitStatus::circle_only;
}

// The `count` points nearest to x, ascending: a tree's list of the nearest is slow when it is long.
std::vector<int> nearest_many(const Eigen::Matrix3Xd &points, const Vector3d &x, int count)
{
    std::vector<std::pair<double, int>> all;
    for (Eigen::Index i = 0; i < points.cols(); i++) {
        all.emplace_back((points.col(i) - x).squaredNorm(), static_cast<int>(i));
    }
    std::nth_element(all.begin(), all.begin() + count, all.end());
    std::vector<int> out;
    for (int i = 0; i < count; i++) {
        out.push_back(all[static_cast<size_t>(i)].second);
    }
    std::sort(out.begin(), out.end());
    return out;
}

std::vector<int> window(const Cloud &cloud, const std::vector<int> &near, const Vector3d &centre, const Vector3d &axis,
                        double rho, double half)
{
    std::vector<int> out;
    for (const int i : near) {
        const Vector3d x = cloud.points.col(i) - centre;
        const double z = x.dot(axis), r = (x - z * axis).norm();
        if (std::abs(z) < half && r > 0.4 * rho && r < 1.7 * rho) {
            out.push_back(i);
        }
    }
    return out;
}

} // namespace

Cylinder find_cylinder(const Cloud &cloud, int threads)
{
    constexpr std::array<int, 5> SIZES{600, 2400, 9600, 38400, 1 << 30};
    const int n = cloud.size();
    Cylinder none;
    if (n < 60) {
        none.status = FitStatus::too_few_points;
        return none;
    }
    const Nearest<3> nearest(cloud.points);
    std::vector<Found> found(SEEDS * SIZES.size());
    parallel_for(static_cast<int>(found.size()), threads, [&](int job) {
        const int size = SIZES[static_cast<size_t>(job) % SIZES.size()];
        const int place = job / static_cast<int>(SIZES.size());
        // Neighbourhoods larger than the cloud are the cloud: four looks at it are enough.
        if (size / 4 >= n && size != SIZES.back() && size != SIZES.front()) {
            return;
        }
        if (size >= n && place >= 4) {
            return;
        }
        std::vector<int> around;
        if (size >= n) {
            around.resize(static_cast<size_t>(n));
            for (int i = 0; i < n; i++) {
                around[static_cast<size_t>(i)] = i;
            }
        } else {
            const auto at =
                static_cast<Eigen::Index>(hash64(4, static_cast<uint64_t>(place), 0) % static_cast<uint64_t>(n));
            around = nearest_many(cloud.points, cloud.points.col(at), size);
        }
        found[static_cast<size_t>(job)] = look(cloud, around, static_cast<uint64_t>(job));
    });
    std::stable_sort(found.begin(), found.end(), [](const Found &a, const Found &b) { return a.score > b.score; });
    double best = 0.0;
    Cylinder chosen = none;
    for (size_t i = 0; i < std::min<size_t>(6, found.size()) && found[i].score > 0.1; i++) {
        const Cylinder &c = found[i].cylinder;
        std::vector<int> all(nearest.within(c.centre, 2.5 * c.rho));
        const std::vector<int> wall = thinned(window(cloud, all, c.centre, c.axis, c.rho, 1.5 * c.rho), 4000, i);
        const Cylinder fitted = fit_cylinder(cloud, wall, c, {.ellipse = false, .cone = 0.15, .min_inliers = 40});
        if (!good(fitted)) {
            chosen.status = i == 0 && fitted.status == FitStatus::one_sided ? fitted.status : chosen.status;
            continue;
        }
        Eigen::Matrix3Xd some(3, static_cast<Eigen::Index>(all.size()));
        for (size_t k = 0; k < all.size(); k++) {
            some.col(static_cast<Eigen::Index>(k)) = cloud.points.col(all[k]);
        }
        const double s = score(some, fitted);
        if (s > best) {
            best = s;
            chosen = fitted;
        }
    }
    return chosen;
}

namespace
{

// Follows the pipe from `from`, in the direction of its axis.
std::vector<Cylinder> follow(const Cloud &cloud, const Nearest<3> &nearest, const Cylinder &from, double radius)
{
    constexpr double STEP = 0.5, BRIDGE = 4.0; // radii
    std::vector<Cylinder> out;
    Cylinder last = from;
    double bridged = 0.0;
    const size_t most = 1000000;
    while (bridged <= BRIDGE * radius && out.size() < most) {
        Cylinder guess = last;
        bridged += STEP * radius;
        guess.centre += bridged * last.axis;
        guess.rho = last.rho;
        guess.ec = guess.es = 0.0;
        const std::vector<int> near = nearest.within(guess.centre, 2.0 * radius);
        const std::vector<int> wall =
            thinned(window(cloud, near, guess.centre, guess.axis, guess.rho, HALF * radius), 1500, out.size());
        Cylinder next = fit_cylinder(cloud, wall, guess, {.ellipse = false, .cone = 0.15, .min_inliers = 24});
        const bool likely = (next.status == FitStatus::ok || next.status == FitStatus::circle_only) &&
                            std::abs(next.rho - last.rho) < 0.1 * radius && next.axis.dot(last.axis) > 0.96 &&
                            next.roughness < 0.06 * radius && std::abs(next.rho - radius) < 0.3 * radius &&
                            next.inliers > 0.5 * static_cast<double>(wall.size()) &&
                            std::abs((next.centre - guess.centre).dot(next.axis)) < OFF * radius;
        if (!likely) {
            continue;
        }
        next.centre += (guess.centre - next.centre).dot(next.axis) * next.axis;
        out.push_back(next);
        last = next;
        bridged = 0.0;
    }
    return out;
}

Cylinder reversed(Cylinder c)
{
    c.axis = -c.axis;
    c.basis.col(1) = -c.basis.col(1);
    c.es = -c.es;
    return c;
}

// `middle`, with what follows it both ways.
std::vector<Cylinder> extended(const Cloud &cloud, const Nearest<3> &nearest, const std::vector<Cylinder> &middle,
                               double radius)
{
    std::vector<Cylinder> out;
    for (const Cylinder &c : follow(cloud, nearest, reversed(middle.front()), radius)) {
        out.push_back(reversed(c));
    }
    std::reverse(out.begin(), out.end());
    out.insert(out.end(), middle.begin(), middle.end());
    const std::vector<Cylinder> after = follow(cloud, nearest, middle.back(), radius);
    out.insert(out.end(), after.begin(), after.end());
    return out;
}

} // namespace

std::vector<Cylinder> trace(const Cloud &cloud, const Cylinder &seed)
{
    const Nearest<3> nearest(cloud.points);
    return extended(cloud, nearest, {seed}, seed.rho);
}

namespace
{

// Where along a path sections are tried, with its tangents. Who drives a diameter or two sees most of the wall beyond
// the path's ends: there it goes on straight.
std::vector<Cylinder> nodes_on(const Eigen::Matrix3Xd &path, double stride, double length, double radius)
{
    constexpr int BEYOND = 3;
    std::vector<Cylinder> out;
    const Eigen::Index count = path.cols();
    const auto add = [&](Eigen::Index i, double ahead) {
        const Eigen::Index a = std::max<Eigen::Index>(0, i - 3), b = std::min(count - 1, i + 3);
        Cylinder c;
        c.axis = (path.col(b) - path.col(a)).normalized();
        c.centre = path.col(i) + ahead * c.axis;
        c.rho = radius;
        out.push_back(c);
    };
    const int beyond = length < 4.0 * radius ? BEYOND : 0;
    for (int k = beyond; k > 0; k--) {
        add(0, -0.5 * k * radius);
    }
    for (Eigen::Index i = 0, last = 0; i + 1 < count; i++) {
        if (i == 0 || (path.col(i) - path.col(last)).norm() >= stride) {
            add(i, 0.0);
            last = i;
        }
    }
    for (int k = 1; k <= beyond; k++) {
        add(count - 1, 0.5 * k * radius);
    }
    return out;
}

} // namespace

std::vector<Cylinder> along(const Cloud &cloud, const Eigen::Matrix3Xd &path, int threads)
{
    const Nearest<3> nearest(cloud.points), on_path(path);
    std::vector<double> away;
    for (Eigen::Index i = 0; i < cloud.points.cols(); i++) {
        const Vector3d x = cloud.points.col(i);
        away.push_back((path.col(on_path.nearest(x, 1)[0]) - x).norm());
    }
    const auto median_of = [](std::vector<double> v) {
        std::nth_element(v.begin(), v.begin() + static_cast<std::ptrdiff_t>(v.size() / 2), v.end());
        return v[v.size() / 2];
    };
    double radius = median_of(away), length = 0.0;
    for (Eigen::Index i = 0; i + 1 < path.cols(); i++) {
        length += (path.col(i + 1) - path.col(i)).norm();
    }
    // Twice: the second time with the radius that the first found.
    std::vector<Cylinder> found;
    for (int round = 0; round < 2; round++) {
        // Nodes half a radius apart; a coarser look suffices for the radius.
        const double stride = round == 0 ? std::min(2.0 * radius, 0.25 * length) : 0.75 * radius;
        const std::vector<Cylinder> start = nodes_on(path, stride, length, radius);
        std::vector<Cylinder> fitted(start.size());
        parallel_for(static_cast<int>(start.size()), threads, [&](int k) {
            const Cylinder &c = start[static_cast<size_t>(k)];
            const std::vector<int> near = nearest.within(c.centre, 2.8 * radius);
            const std::vector<int> wall =
                thinned(window(cloud, near, c.centre, c.axis, radius, HALF * radius), 1500, static_cast<uint64_t>(k));
            Cylinder &f = fitted[static_cast<size_t>(k)];
            f = fit_cylinder(cloud, wall, c, {.ellipse = false, .cone = 0.35, .min_inliers = 24});
            if (good(f)) { // the section of the node, not of its points' mean
                const double off = (c.centre - f.centre).dot(f.axis);
                f.centre += off * f.axis;
                f.status = std::abs(off) < OFF * radius ? f.status : FitStatus::one_sided;
            }
        });
        std::vector<double> rho;
        found.clear();
        for (const Cylinder &c : fitted) {
            if (good(c)) {
                rho.push_back(c.rho);
            }
        }
        if (rho.empty()) {
            return {};
        }
        radius = median_of(rho);
        for (const Cylinder &c : fitted) {
            if (good(c) && std::abs(c.rho - radius) < 0.3 * radius &&
                (found.empty() || (c.centre - found.back().centre).dot(c.axis) > 0.2 * radius)) {
                found.push_back(c);
            }
        }
    }
    return found.empty() ? found : extended(cloud, nearest, found, radius);
}

} // namespace pipefish::tube
