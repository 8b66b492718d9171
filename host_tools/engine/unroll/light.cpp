#include "unroll/light.hpp"

#include <Eigen/LU>
#include <Eigen/SparseCholesky>

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <utility>

namespace pipefish::unroll
{

namespace
{

constexpr int FIELD = LightField::RINGS * LightField::SECTORS;
constexpr int ROUNDS = 6;           // of reweighting
constexpr double NOISE = 0.03;      // of a difference, for the weight of what is known before
constexpr double GAIN_SIGMA = 0.5;  // logarithms
constexpr double BEND_SIGMA = 3.0;  // of the field's second difference from ring to ring
constexpr double TURN_SIGMA = 0.02; // of its first difference around: what never turns could be the wall's
constexpr int LAGS[] = {1, 2, 4, 8};

struct Pair {
    const Glance *a, *b;
    double weight;
};

double median(std::vector<double> values)
{
    if (values.empty()) {
        return 0.0;
    }
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

// Views of one patch, near and far: far ones hold the field's slow parts.
std::vector<Pair> pairs_of(const std::vector<Glance> &glances)
{
    std::vector<Pair> pairs;
    for (size_t from = 0, to; from < glances.size(); from = to) {
        to = from;
        while (to < glances.size() && glances[to].patch == glances[from].patch) {
            to++;
        }
        for (const int lag : LAGS) {
            for (size_t i = from; i + static_cast<size_t>(lag) < to; i++) {
                pairs.push_back({&glances[i], &glances[i + static_cast<size_t>(lag)], 1.0});
            }
        }
    }
    return pairs;
}

// The trend along the pipe of views by how much they show; zero where all stand at one place.
Eigen::VectorXd trend_of(const std::vector<Glance> &glances, const Eigen::VectorXd &along)
{
    Eigen::VectorXd count = Eigen::VectorXd::Zero(along.size());
    for (const Glance &g : glances) {
        count[g.view] += 1.0;
    }
    const Eigen::VectorXd trend = count.array() * (along.array() - along.dot(count) / count.sum());
    return trend / std::max(trend.norm(), 1e-9);
}

double difference(const Pair &p, const Light &light)
{
    return p.a->level - p.b->level - light.gain[p.a->view] + light.gain[p.b->view] -
           light.field.at(p.a->theta, p.a->phi) + light.field.at(p.b->theta, p.b->phi);
}

// Smoothness of the field: rows of `normal`.
void add_prior(Eigen::MatrixXd &normal)
{
    const auto add = [&normal](const std::vector<std::pair<int, double>> &row, double sigma) {
        const double w = NOISE * NOISE / (sigma * sigma);
        for (const auto &[i, x] : row) {
            for (const auto &[j, y] : row) {
                normal(i, j) += w * x * y;
            }
        }
    };
    for (int r = 0; r < LightField::RINGS; r++) {
        for (int s = 0; s < LightField::SECTORS; s++) {
            const int here = r * LightField::SECTORS + s,
                      next = r * LightField::SECTORS + (s + 1) % LightField::SECTORS;
            add({{here, 1.0}, {next, -1.0}}, TURN_SIGMA);
            if (r > 0 && r + 1 < LightField::RINGS) {
                add({{here - LightField::SECTORS, 1.0}, {here, -2.0}, {here + LightField::SECTORS, 1.0}}, BEND_SIGMA);
            }
            add({{here, 1.0}}, 30.0);
        }
    }
}

// Gains that rise evenly along the pipe and a field that falls with the distance ahead explain the same pictures (and a
// wall that darkens along the pipe). So the gains are given no trend: the last unknown of the border is the multiplier.
void solve(const std::vector<Pair> &pairs, const Eigen::VectorXd &along, Light &light)
{
    const Eigen::Index views = light.gain.size();
    Eigen::MatrixXd field = Eigen::MatrixXd::Zero(FIELD + 1, FIELD + 1);
    Eigen::MatrixXd cross = Eigen::MatrixXd::Zero(views, FIELD + 1);
    Eigen::VectorXd right = Eigen::VectorXd::Zero(views), right_field = Eigen::VectorXd::Zero(FIELD + 1);
    Eigen::VectorXd diagonal = Eigen::VectorXd::Constant(views, NOISE * NOISE / (GAIN_SIGMA * GAIN_SIGMA));
    std::map<std::pair<int, int>, double> coupling;
    add_prior(field);
    cross.col(FIELD) = along;
    for (const Pair &p : pairs) {
        const double y = p.a->level - p.b->level;
        const LightField::Place a = light.field.place(p.a->theta, p.a->phi),
                                b = light.field.place(p.b->theta, p.b->phi);
        int knot[8];
        double slope[8];
        for (int k = 0; k < 4; k++) {
            knot[k] = a.knot[k], slope[k] = a.weight[k];
            knot[4 + k] = b.knot[k], slope[4 + k] = -b.weight[k];
        }
        for (int k = 0; k < 8; k++) {
            for (int l = 0; l < 8; l++) {
                field(knot[k], knot[l]) += p.weight * slope[k] * slope[l];
            }
            cross(p.a->view, knot[k]) += p.weight * slope[k];
            cross(p.b->view, knot[k]) -= p.weight * slope[k];
            right_field[knot[k]] += p.weight * slope[k] * y;
        }
        right[p.a->view] += p.weight * y;
        right[p.b->view] -= p.weight * y;
        diagonal[p.a->view] += p.weight;
        diagonal[p.b->view] += p.weight;
        coupling[std::minmax(p.a->view, p.b->view)] -= p.weight;
    }
    std::vector<Eigen::Triplet<double>> entries;
    for (int i = 0; i < views; i++) {
        entries.emplace_back(i, i, diagonal[i]);
    }
    for (const auto &[at, value] : coupling) {
        entries.emplace_back(at.second, at.first, value);
    }
    Eigen::SparseMatrix<double> gains(views, views);
    gains.setFromTriplets(entries.begin(), entries.end());
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> factor(gains); // lower part
    const Eigen::MatrixXd reduced = factor.solve(cross);
    const Eigen::MatrixXd schur = field - cross.transpose() * reduced;
    const Eigen::VectorXd border = schur.fullPivLu().solve(right_field - reduced.transpose() * right);
    light.field.value = border.head(FIELD);
    light.gain = factor.solve(right - cross * border);
}

} // namespace

LightField::Place LightField::place(double theta, double phi) const
{
    const double r = std::clamp(theta / theta_max, 0.0, 1.0) * (RINGS - 1);
    const int ring = std::min(static_cast<int>(r), RINGS - 2);
    double s = phi / (2.0 * std::numbers::pi) * SECTORS;
    s -= SECTORS * std::floor(s / SECTORS);
    const int sector = std::min(static_cast<int>(s), SECTORS - 1), next = (sector + 1) % SECTORS;
    const double up = r - ring, on = s - sector;
    const int low = ring * SECTORS, high = low + SECTORS;
    return {{low + sector, low + next, high + sector, high + next},
            {(1 - up) * (1 - on), (1 - up) * on, up * (1 - on), up * on}};
}

double LightField::at(double theta, double phi) const
{
    const Place p = place(theta, phi);
    double sum = 0.0;
    for (int k = 0; k < 4; k++) {
        sum += p.weight[k] * value[p.knot[k]];
    }
    return sum;
}

Light balance(const std::vector<Glance> &glances, const Eigen::VectorXd &along, double theta_max)
{
    const Eigen::Index views = along.size();
    Light light;
    light.field.theta_max = theta_max;
    light.gain = Eigen::VectorXd::Zero(views);
    std::vector<Pair> pairs = pairs_of(glances);
    if (pairs.empty()) {
        return light;
    }
    const Eigen::VectorXd trend = trend_of(glances, along);
    for (int round = 0; round < ROUNDS; round++) {
        solve(pairs, trend, light);
        std::vector<double> size;
        for (const Pair &p : pairs) {
            size.push_back(std::abs(difference(p, light)));
        }
        light.scatter = 1.4826 * median(size);
        const double limit = std::max(2.0 * light.scatter, 1e-3);
        for (size_t i = 0; i < pairs.size(); i++) { // Huber, then nothing beyond three limits: glints and shadows
            pairs[i].weight = size[i] <= limit ? 1.0 : size[i] > 3.0 * limit && round > 1 ? 0.0 : limit / size[i];
        }
    }
    std::vector<double> level;
    for (const Glance &g : glances) {
        level.push_back(g.level - light.gain[g.view] - light.field.at(g.theta, g.phi));
    }
    light.level = median(level);
    return light;
}

} // namespace pipefish::unroll
