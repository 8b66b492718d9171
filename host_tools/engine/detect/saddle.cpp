#include "saddle.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace pipefish::detect
{
namespace
{

constexpr double kPixel = 0.29; // standard deviation of a unit square
constexpr int kShape = 7, kLight = 6, kAll = kShape + kLight;
using Vector = Eigen::Matrix<double, kAll, 1>;
using Matrix = Eigen::Matrix<double, kAll, kAll>;

struct Pixel {
    double x, y, grey, weight;
};

// Parameters: 0, 1 the corner; 2, 3 the edges' directions; 4, 5 their curvatures; 6 log of the blur; 7.. the lights
// a, b_x, b_y, c, d_x, d_y. Lengths are in units of the window's radius from its middle.
struct Model {
    double value;
    Vector slope;
};

// least: the blur that a pixel's own area makes, without which a perfectly sharp edge could lie anywhere within a
// pixel.
Model model_at(const Vector &p, double x, double y, double least)
{
    const double u = x - p[0], v = y - p[1];
    const double soft = std::exp(2 * p[6]), sigma = std::sqrt(soft + least * least);
    double step[2], d_u[2], d_v[2], d_angle[2], d_bend[2], d_sigma[2];
    for (int k = 0; k < 2; k++) {
        // The edge runs along t; f is the distance to its left, in units of the blur.
        const double cosine = std::cos(p[2 + k]), sine = std::sin(p[2 + k]), bend = p[4 + k];
        const double along = cosine * u + sine * v, across = -sine * u + cosine * v;
        const double f = (across + 0.5 * bend * along * along) / sigma;
        const double bell = std::exp(-0.5 * f * f) * M_2_SQRTPI * M_SQRT1_2;
        step[k] = std::erf(f * M_SQRT1_2);
        const double by_across = bell / sigma, by_along = bell * bend * along / sigma;
        d_u[k] = by_along * cosine - by_across * sine;
        d_v[k] = by_along * sine + by_across * cosine;
        d_angle[k] = by_along * across - by_across * along;
        d_bend[k] = 0.5 * bell * along * along / sigma;
        d_sigma[k] = -bell * f * soft / (sigma * sigma);
    }
    const double light = p[10] + p[11] * x + p[12] * y, both = step[0] * step[1];
    Model m;
    m.value = p[7] + p[8] * x + p[9] * y + light * both;
    m.slope[0] = -light * (d_u[0] * step[1] + step[0] * d_u[1]);
    m.slope[1] = -light * (d_v[0] * step[1] + step[0] * d_v[1]);
    for (int k = 0; k < 2; k++) {
        m.slope[2 + k] = light * d_angle[k] * step[1 - k];
        m.slope[4 + k] = light * d_bend[k] * step[1 - k];
    }
    m.slope[6] = light * (d_sigma[0] * step[1] + step[0] * d_sigma[1]);
    m.slope.tail<6>() << 1.0, x, y, both, x * both, y * both;
    return m;
}

// Weak beliefs that decide only where a small window cannot: edges bend by at most about 0.15 radians across the
// window, light changes by about half its value, the blur is about a pixel. Rows: parameter, belief, 1 / sigma.
struct Belief {
    int parameter;
    double value, strength;
};

class Fit
{
public:
    Fit(const cv::Mat &image, const Eigen::Vector2d &middle, const SaddleSetup &setup, double radius)
        : middle_(middle), radius_(radius)
    {
        const Eigen::Matrix2d to_cell = setup.cell.inverse();
        const int reach = static_cast<int>(std::ceil(radius));
        const int x0 = static_cast<int>(std::lround(middle.x())), y0 = static_cast<int>(std::lround(middle.y()));
        for (int y = y0 - reach; y <= y0 + reach; y++) {
            for (int x = x0 - reach; x <= x0 + reach; x++) {
                if (x < 0 || y < 0 || x >= image.cols || y >= image.rows)
                    continue;
                const Eigen::Vector2d off(x - middle.x(), y - middle.y());
                const Eigen::Vector2d c = (to_cell * off).cwiseAbs();
                const bool white = setup.dark != 0 && ((to_cell * off).prod() > 0) == (setup.dark < 0);
                if (off.norm() > radius || c.maxCoeff() > setup.reach || (white && c.minCoeff() > setup.white_free))
                    continue;
                pixels_.push_back({off.x() / radius, off.y() / radius, double(image.at<uint8_t>(y, x)), 1.0});
            }
        }
    }

    bool start(const SaddleSetup &setup)
    {
        if (pixels_.size() < 16)
            return false;
        p_.setZero();
        for (int k = 0; k < 2; k++) // edge 0 runs along the cell's first axis, edge 1 along its second
            p_[2 + k] = std::atan2(setup.cell(1, k), setup.cell(0, k));
        p_[6] = std::log(std::max(0.8, 0.04 * setup.cell.colwise().norm().minCoeff()) / radius_);
        // The lights follow linearly from the shape.
        Eigen::Matrix<double, 6, 6> n = 1e-9 * Eigen::Matrix<double, 6, 6>::Identity();
        Eigen::Matrix<double, 6, 1> r = Eigen::Matrix<double, 6, 1>::Zero();
        double sum = 0.0, square = 0.0;
        for (const Pixel &q : pixels_) {
            const Eigen::Matrix<double, 6, 1> s = model_at(p_, q.x, q.y, kPixel / radius_).slope.tail<6>();
            n += s * s.transpose();
            r += s * q.grey;
            sum += q.grey;
            square += q.grey * q.grey;
        }
        p_.tail<6>() = n.ldlt().solve(r);
        const double count = static_cast<double>(pixels_.size());
        total_ = square - sum * sum / count;
        const double size = std::max(std::abs(p_[10]), 2.0);
        noise_ = std::max(1.0, 0.05 * size);
        beliefs_ = {{4, 0.0, 1 / 0.15},         {5, 0.0, 1 / 0.15},         {6, p_[6], 1 / 0.7},
                    {8, 0.0, 1 / (0.7 * size)}, {9, 0.0, 1 / (0.7 * size)}, {11, 0.0, 1 / (0.7 * size)},
                    {12, 0.0, 1 / (0.7 * size)}};
        return true;
    }

    double cost(const Vector &p, Matrix *normal, Vector *right) const
    {
        double sum = 0.0;
        if (normal) {
            normal->setZero();
            right->setZero();
        }
        for (const Pixel &q : pixels_) {
            const Model m = model_at(p, q.x, q.y, kPixel / radius_);
            const double e = (q.grey - m.value) / noise_;
            sum += e * e;
            if (normal) {
                normal->selfadjointView<Eigen::Lower>().rankUpdate(m.slope / noise_);
                *right += m.slope * (e / noise_);
            }
        }
        for (const Belief &b : beliefs_) {
            const double e = (b.value - p[b.parameter]) * b.strength;
            sum += e * e;
            if (normal) {
                (*normal)(b.parameter, b.parameter) += b.strength * b.strength;
                (*right)[b.parameter] += e * b.strength;
            }
        }
        return sum;
    }

    // Levenberg-Marquardt. False when it runs away.
    bool run()
    {
        Matrix normal;
        Vector right;
        double damping = 1e-3, now = cost(p_, &normal, &right);
        for (int round = 0; round < 30; round++) {
            Matrix damped = normal;
            damped.diagonal() *= 1.0 + damping;
            damped.diagonal().array() += 1e-12;
            const Vector change = damped.selfadjointView<Eigen::Lower>().ldlt().solve(right);
            if (!change.allFinite())
                return false;
            Vector next = p_ + change;
            next[6] = std::max(next[6], -8.0); // a perfectly sharp edge: the pixel's own blur remains
            if (next.head<2>().norm() > 1.0 || next[6] > 6.0)
                return false;
            const double then = cost(next, nullptr, nullptr);
            if (then <= now) {
                p_ = next;
                damping = std::max(1e-9, damping * 0.2);
                if (change.head<2>().norm() * radius_ < 1e-4)
                    return true;
                now = cost(p_, &normal, &right);
            } else {
                damping *= 5.0;
                if (damping > 1e6)
                    return false;
            }
        }
        return true;
    }

    Saddle result() const
    {
        Saddle s;
        s.at = middle_ + radius_ * p_.head<2>();
        s.blur = std::hypot(radius_ * std::exp(p_[6]), kPixel);
        s.contrast = (p_[10] + p_[11] * p_[0] + p_[12] * p_[1]);
        Matrix normal;
        Vector right;
        cost(p_, &normal, &right);
        double left = 0.0;
        for (const Pixel &q : pixels_)
            left += std::pow(q.grey - model_at(p_, q.x, q.y, kPixel / radius_).value, 2);
        const double free = std::max(static_cast<double>(pixels_.size()) - kAll, 3.0);
        // Rounding to whole grey levels is noise of 0.29 at least.
        const double variance = std::max(left / free, 1.0 / 12) / (noise_ * noise_);
        const Matrix whole = normal.selfadjointView<Eigen::Lower>();
        s.covariance = variance * radius_ * radius_ * whole.inverse().topLeftCorner<2, 2>();
        s.share = 1.0 - left / std::max(total_, 1e-9);
        return s;
    }

    const Vector &parameters() const { return p_; }

private:
    Eigen::Vector2d middle_;
    double radius_, noise_ = 1.0, total_ = 0.0;
    std::vector<Pixel> pixels_;
    std::vector<Belief> beliefs_;
    Vector p_;
};

// The angle from a to b as lines, radians, 0 to pi / 2.
double line_angle(double a, double b)
{
    return std::abs(std::remainder(a - b, M_PI));
}

} // namespace

Saddle fit_saddle(const cv::Mat &image, const Eigen::Vector2d &start, const SaddleSetup &setup)
{
    Saddle none;
    const double shorter = setup.cell.colwise().norm().minCoeff();
    if (!(shorter > 3.0) || !start.allFinite())
        return none;
    const Eigen::Matrix2d to_cell = setup.cell.inverse();
    // Twice: the second window is centred on what the first one found.
    Eigen::Vector2d middle = start;
    for (int pass = 0; pass < 2; pass++) {
        const double longest = setup.reach * setup.cell.colwise().norm().maxCoeff();
        Fit fit(image, middle, setup, std::min(setup.max_radius, longest));
        if (!fit.start(setup) || !fit.run())
            return none;
        Saddle s = fit.result();
        if ((to_cell * (s.at - start)).cwiseAbs().maxCoeff() > 0.45)
            return none;
        middle = s.at;
        if (pass == 0)
            continue;
        const Vector &p = fit.parameters();
        // A wrong thing (a square's outer corner, a T, text) fits badly, or with turned edges, or in the wrong colours.
        // Directions are compared on the board, where the edges are square to each other whatever the view.
        for (int k = 0; k < 2; k++) {
            const Eigen::Vector2d t = to_cell * Eigen::Vector2d(std::cos(p[2 + k]), std::sin(p[2 + k]));
            if (line_angle(std::atan2(t.y(), t.x()), k * M_PI_2) > 0.35)
                return none;
        }
        const double spread = std::sqrt(s.covariance.selfadjointView<Eigen::Lower>().eigenvalues().maxCoeff());
        const bool right_colours = setup.dark == 0 || s.contrast * setup.dark > 0;
        s.found =
            right_colours && std::abs(s.contrast) > 3.0 && s.share > 0.8 && s.blur < 0.35 * shorter && spread < 0.3;
        return s;
    }
    return none;
}

} // namespace pipefish::detect
