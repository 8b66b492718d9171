#include "unroll/unroll.hpp"

#include "parallel.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace pipefish::unroll
{

namespace
{

constexpr double RIM = 24.0;           // pixels over which a picture fades out towards its rim
constexpr double LEAST_COS = 0.1;      // of incidence: flatter looks show nothing
constexpr double FADE_COS = 0.15;      // and fade out over this
constexpr double FADE_REACH = 0.1;     // share of the reach over which a look fades out
constexpr int CLIPPED = 250, DARK = 3; // greys beyond which nothing is known of the wall
constexpr int SAMPLES = 4;             // most, a cell and direction
constexpr double CLIPPED_WEIGHT = 0.003;

// Distance from the rim of what the camera sees, pixels; negative outside.
double inside(const pf_camera &camera, const Vector2d &uv, double theta)
{
    double d = std::min({uv.x() - 1.0, uv.y() - 1.0, camera.width - 2.0 - uv.x(), camera.height - 2.0 - uv.y()});
    if (camera.circle_radius > 0.0) {
        d = std::min(d, camera.circle_radius - std::hypot(uv.x() - camera.circle_u, uv.y() - camera.circle_v) - 1.0);
    }
    return std::min(d, (camera.theta_max - theta) * camera.f_u);
}

// Bilinear; uv at least a pixel inside.
double sample(const pf_camera &camera, const uint8_t *pixels, double u, double v)
{
    const int x = static_cast<int>(u), y = static_cast<int>(v);
    const double a = u - x, b = v - y;
    const uint8_t *p = pixels + static_cast<size_t>(y) * camera.width + x, *q = p + camera.width;
    return (1 - b) * ((1 - a) * p[0] + a * p[1]) + b * ((1 - a) * q[0] + a * q[1]);
}

// A value over a block of cells, from its corners 0 0, 1 0 (right), 0 1 (below), 1 1: bilinear.
struct Bilinear {
    double at, right, below, both;

    explicit Bilinear(const std::array<double, 4> &c)
        : at(c[0]), right(c[1] - c[0]), below(c[2] - c[0]), both(c[0] + c[3] - c[1] - c[2])
    {
    }
    double operator()(double x, double y) const { return at + x * right + y * (below + x * both); }
};

// What a view brings to a block.
struct Share {
    Bilinear u, v, weight, light;
    const Picture *picture;
    int samples;
    bool counts; // anywhere in the block
};

// Mean grey of a cell whose upper left corner is at x, y of the block, `size` wide; clipped: whether any sample is.
double cell_grey(const pf_camera &camera, const Share &c, double x, double y, double size, bool &clipped)
{
    double sum = 0.0;
    const double step = size / c.samples;
    for (int k = 0; k < c.samples; k++) {
        const double yk = y + (k + 0.5) * step;
        for (int i = 0; i < c.samples; i++) {
            const double xi = x + (i + 0.5) * step, grey = sample(camera, c.picture->pixels, c.u(xi, yk), c.v(xi, yk));
            clipped |= grey > CLIPPED || grey < DARK;
            sum += grey;
        }
    }
    return sum / (c.samples * c.samples);
}

struct Artist {
    const pf_camera &camera;
    std::span<const Picture> pictures;
    const Sheet &sheet;
    const Light &light;
    const Tone &tone;
    std::vector<Look> looks; // [picture][node]
    Drawing &out;

    size_t nodes() const { return sheet.nodes.size(); }

    // How far along the pipe a look is from the best place to see the spot: its resolution as a distance.
    double away(const Look &l) const
    {
        return tone.radius * std::sqrt(std::max(0.0, tone.finest / std::max(l.fine, 1e-9) - 1.0));
    }

    void look_from(int picture)
    {
        const Picture &p = pictures[static_cast<size_t>(picture)];
        for (size_t n = 0; n < nodes(); n++) {
            looks[static_cast<size_t>(picture) * nodes() + n] = look(camera, p.pose, sheet.nodes[n], tone.reach);
        }
    }

    void choose(size_t node)
    {
        const size_t column = node / static_cast<size_t>(sheet.node_rows()),
                     row = node % static_cast<size_t>(sheet.node_rows());
        const size_t at = row * static_cast<size_t>(sheet.node_columns()) + column;
        out.best[at] = -1;
        out.fine[at] = 0.0F;
        for (size_t k = 0; k < pictures.size(); k++) {
            const Look &l = looks[k * nodes() + node];
            if (l.seen && static_cast<float>(l.fine) > out.fine[at]) {
                out.fine[at] = static_cast<float>(l.fine);
                out.best[at] = pictures[k].view;
            }
        }
    }

    std::vector<Share> shares_of(int column, int row) const
    {
        const size_t first = static_cast<size_t>(column * sheet.node_rows() + row),
                     right = first + static_cast<size_t>(sheet.node_rows());
        const std::array<size_t, 4> node{first, right, first + 1, right + 1};
        const auto sees = [&](size_t k) {
            return std::all_of(node.begin(), node.end(), [&](size_t n) { return looks[k * nodes() + n].seen; });
        };
        std::array<double, 4> nearest;
        nearest.fill(std::numeric_limits<double>::max());
        for (size_t k = 0; k < pictures.size(); k++) {
            for (size_t i = 0; i < 4 && sees(k); i++) {
                nearest[i] = std::min(nearest[i], away(looks[k * nodes() + node[i]]));
            }
        }
        std::vector<Share> shares;
        for (size_t k = 0; k < pictures.size(); k++) {
            if (!sees(k)) {
                continue;
            }
            std::array<double, 4> u, v, weight, bright;
            double coarse = 0.0;
            for (size_t i = 0; i < 4; i++) {
                const Look &l = looks[k * nodes() + node[i]];
                u[i] = l.uv.x();
                v[i] = l.uv.y();
                weight[i] = std::max(0.0, 1.0 - (away(l) - nearest[i]) / tone.seam);
                bright[i] = std::exp(-l.fall_off - light.gain[pictures[k].view] - light.field.at(l.theta, l.phi));
                coarse = std::max(coarse, l.coarse);
            }
            const int samples = std::clamp(static_cast<int>(std::ceil(coarse * sheet.cell - 0.5)), 1, SAMPLES);
            const bool counts = *std::max_element(weight.begin(), weight.end()) > 0.0;
            shares.push_back(
                {Bilinear(u), Bilinear(v), Bilinear(weight), Bilinear(bright), &pictures[k], samples, counts});
        }
        return shares;
    }

    void block(int column, int row) const
    {
        const std::vector<Share> shares = shares_of(column, row);
        if (shares.empty()) {
            return;
        }
        const double size = 1.0 / sheet.step, factor = tone.grey * std::exp(-tone.level);
        for (int i = 0; i < sheet.step; i++) {
            for (int k = 0; k < sheet.step; k++) {
                const size_t at = static_cast<size_t>(row * sheet.step + i) * static_cast<size_t>(sheet.columns) +
                                  static_cast<size_t>(column * sheet.step + k);
                const double grey = factor * cell(shares, k * size, i * size, size);
                out.grey[at] = static_cast<uint8_t>(std::clamp(grey + 0.5, 0.0, 255.0));
                out.seen[at] = 255;
            }
        }
    }

    // The reflectance: by the views that count here; by all, where glare or the dark hides it from them.
    double cell(const std::vector<Share> &shares, double x, double y, double size) const
    {
        double sum = 0.0, total = 0.0;
        for (const bool all : {false, true}) {
            bool open = false;
            sum = total = 0.0;
            for (const Share &c : shares) {
                if (!all && !c.counts) {
                    continue;
                }
                const double weight = c.weight(x + 0.5 * size, y + 0.5 * size) + (all ? 1e-3 : 0.0);
                if (weight <= 0.0) {
                    continue;
                }
                bool clipped = false;
                const double grey = cell_grey(camera, c, x, y, size, clipped);
                const double w = weight * (clipped ? CLIPPED_WEIGHT : 1.0);
                open |= !clipped;
                sum += w * grey * c.light(x + 0.5 * size, y + 0.5 * size);
                total += w;
            }
            if (open) {
                break;
            }
        }
        return sum / total;
    }
};

} // namespace

Look look(const pf_camera &camera, const Pose &pose, const Spot &spot, double reach)
{
    Look out;
    const Vector3d x = pose * spot.at;
    const double distance = x.norm(), facing = spot.along.cross(spot.down).dot(pose.r.transpose() * x) / distance;
    if (facing < LEAST_COS || distance > reach) {
        return out;
    }
    Eigen::Matrix<double, 2, 3, Eigen::RowMajor> d;
    if (pf_camera_project(&camera, x.data(), out.uv.data(), d.data(), nullptr) != PF_OK) {
        return out;
    }
    const double rho = std::hypot(x.x(), x.y());
    out.theta = std::atan2(rho, x.z());
    out.phi = std::atan2(x.y(), x.x());
    const double margin = inside(camera, out.uv, out.theta);
    if (margin <= 0.0) {
        return out;
    }
    out.j.col(0) = d * (pose.r * spot.along);
    out.j.col(1) = d * (pose.r * spot.down);
    const double half = 0.5 * out.j.squaredNorm(), det = out.j.determinant();
    const double root = std::sqrt(std::max(0.0, half * half - det * det));
    out.coarse = std::sqrt(half + root);
    out.fine = std::abs(det) / out.coarse * std::min(1.0, margin / RIM) *
               std::min(1.0, (facing - LEAST_COS) / FADE_COS) *
               std::min(1.0, (reach - distance) / (FADE_REACH * reach));
    out.fall_off = std::log(facing) - 2.0 * std::log(distance);
    out.seen = out.fine > 0.0;
    return out;
}

std::vector<Glance> glances(const pf_camera &camera, std::span<const Picture> pictures, std::span<const Spot> spots,
                            double side, double reach, int first, std::vector<double> &fine)
{
    constexpr int SIDE = 5;
    std::vector<Glance> out;
    fine.assign(spots.size(), 0.0);
    for (size_t i = 0; i < spots.size(); i++) {
        for (const Picture &p : pictures) {
            const Look l = look(camera, p.pose, spots[i], reach);
            if (!l.seen) {
                continue;
            }
            fine[i] = std::max(fine[i], l.fine);
            double sum = 0.0;
            bool sound = true;
            for (int a = 0; a < SIDE * SIDE && sound; a++) {
                const Vector2d off(a % SIDE - SIDE / 2, a / SIDE - SIDE / 2);
                const Vector2d uv = l.uv + l.j * (off * (side / SIDE));
                sound = inside(camera, uv, l.theta) > 0.0;
                const double grey = sound ? sample(camera, p.pixels, uv.x(), uv.y()) : 0.0;
                sound &= grey > 2 * DARK && grey < CLIPPED;
                sum += grey;
            }
            if (sound) {
                out.push_back(
                    {first + static_cast<int>(i), p.view, std::log(sum / (SIDE * SIDE)) - l.fall_off, l.theta, l.phi});
            }
        }
    }
    return out;
}

Drawing draw(const pf_camera &camera, std::span<const Picture> pictures, const Sheet &sheet, const Light &light,
             const Tone &tone, int threads)
{
    Drawing out;
    const size_t cells = static_cast<size_t>(sheet.columns) * static_cast<size_t>(sheet.rows);
    out.grey.assign(cells, 0);
    out.seen.assign(cells, 0);
    out.best.assign(sheet.nodes.size(), -1);
    out.fine.assign(sheet.nodes.size(), 0.0F);
    Artist artist{camera, pictures, sheet, light, tone, {}, out};
    artist.looks.resize(pictures.size() * sheet.nodes.size());
    parallel_for(static_cast<int>(pictures.size()), threads, [&](int k) { artist.look_from(k); });
    for (size_t n = 0; n < sheet.nodes.size(); n++) {
        artist.choose(n);
    }
    parallel_for(sheet.columns / sheet.step, threads, [&](int column) {
        for (int row = 0; row < sheet.rows / sheet.step; row++) {
            artist.block(column, row);
        }
    });
    return out;
}

} // namespace pipefish::unroll
