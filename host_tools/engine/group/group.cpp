#include "group/group.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>
#include <numbers>
#include <numeric>
#include <unordered_map>

namespace pipefish::group
{

namespace
{

using Eigen::Matrix2d;
using Eigen::Vector2d;
using match::Match;

// A match with its map both ways.
struct Local {
    Vector2d one, two;
    Matrix2d there, back;
    double slack_there = 1, slack_back = 1; // how much a pixel of the coarser image is in image 2 and 1
    double det = 0;
};

Local local(const Match &m)
{
    Local out;
    out.one = {m.x, m.y};
    out.two = m.centre.cast<double>();
    out.there = m.a.cast<double>();
    out.det = out.there.determinant();
    out.back = out.there.inverse();
    const double scale = std::sqrt(std::abs(out.det));
    out.slack_there = std::max(1.0, scale);
    out.slack_back = std::max(1.0, 1 / scale);
    return out;
}

bool near(const Vector2d &got, const Vector2d &wanted, double slack, const Options &o)
{
    return (got - wanted).norm() <= o.absolute * slack + o.relative * 0.5 * (got.norm() + wanted.norm());
}

// Whether `to` lies in both images where the map of `from` has it.
bool leads(const Local &from, const Local &to, const Options &o)
{
    const Vector2d one = to.one - from.one, two = to.two - from.two;
    return near(two, from.there * one, from.slack_there, o) && near(one, from.back * two, from.slack_back, o);
}

bool agree(const Local &a, const Local &b, const Options &o)
{
    return leads(a, b, o) && leads(b, a, o);
}

double cross(const Vector2d &a, const Vector2d &b)
{
    return a.x() * b.y() - a.y() * b.x();
}

// Whether the triangle's own map is of the same turn and scale as its corners'.
bool same_scale(const Local &a, const Local &b, const Local &c, const Options &o)
{
    const double change = cross(b.two - a.two, c.two - a.two) / cross(b.one - a.one, c.one - a.one);
    const auto fits = [&](const Local &v) {
        return change * v.det > 0 && std::abs(std::log(change / v.det)) <= o.scale;
    };
    return fits(a) && fits(b) && fits(c);
}

// Edges short enough and no angle below 5 degrees.
bool well_shaped(const Local &a, const Local &b, const Local &c, const Options &o)
{
    const double longest = o.edge * o.cell, sine = std::sin(5 * std::numbers::pi / 180);
    const Vector2d ab = b.one - a.one, bc = c.one - b.one, ca = a.one - c.one;
    const double l[3] = {ab.norm(), bc.norm(), ca.norm()};
    if (std::max({l[0], l[1], l[2]}) > longest)
        return false;
    const double twice = std::abs(cross(ab, bc));
    return twice >= sine * l[0] * l[1] && twice >= sine * l[1] * l[2] && twice >= sine * l[2] * l[0];
}

struct Mesh {
    std::vector<int> vertices; // indices of matches
    std::vector<Local> at;
    std::vector<Corners> triangles; // indices into vertices
};

// The best match of each cell stands for it: with every pixel a vertex, edges of one pixel would be all noise.
std::vector<int> thinned(const std::vector<Match> &matches, int cell)
{
    std::unordered_map<int64_t, size_t> place;
    std::vector<int> out;
    for (size_t k = 0; k < matches.size(); k++) {
        const int64_t key = static_cast<int64_t>(matches[k].y / cell) << 32 | (matches[k].x / cell);
        const auto [entry, fresh] = place.try_emplace(key, out.size());
        int *best = fresh ? &out.emplace_back(static_cast<int>(k)) : &out[entry->second];
        if (matches[k].zncc > matches[static_cast<size_t>(*best)].zncc)
            *best = static_cast<int>(k);
    }
    return out;
}

void triangulate(const std::vector<Match> &matches, Mesh &mesh)
{
    std::vector<Pixel> points;
    mesh.at.clear();
    for (const int k : mesh.vertices) {
        const Match &m = matches[static_cast<size_t>(k)];
        points.push_back({m.x, m.y});
        mesh.at.push_back(local(m));
    }
    mesh.triangles = delaunay(points);
}

// Takes out vertices that agree with too few of their neighbours, a round. False when there is none.
bool prune(Mesh &mesh, const Options &o)
{
    std::vector<int> edges(mesh.vertices.size(), 0), good(mesh.vertices.size(), 0);
    for (const Corners &t : mesh.triangles)
        for (size_t k = 0; k < 3; k++) {
            const auto i = static_cast<size_t>(t[k]), j = static_cast<size_t>(t[(k + 1) % 3]);
            const int ok = agree(mesh.at[i], mesh.at[j], o);
            edges[i]++, edges[j]++;
            good[i] += ok, good[j] += ok;
        }
    std::vector<int> kept;
    for (size_t i = 0; i < edges.size(); i++)
        if (good[i] >= o.pruned * edges[i] && edges[i] > 0)
            kept.push_back(mesh.vertices[i]);
    const bool fewer = kept.size() < mesh.vertices.size();
    mesh.vertices = std::move(kept);
    return fewer;
}

class Sets
{
public:
    explicit Sets(size_t n) : parent_(n) { std::iota(parent_.begin(), parent_.end(), size_t{0}); }
    size_t root(size_t i)
    {
        while (parent_[i] != i)
            i = parent_[i] = parent_[parent_[i]];
        return i;
    }
    void join(size_t i, size_t j)
    {
        i = root(i), j = root(j);
        parent_[std::max(i, j)] = std::min(i, j);
    }

private:
    std::vector<size_t> parent_;
};

// Triangles that pass, joined where they share an edge.
std::vector<std::vector<Corners>> components(const Mesh &mesh, const Options &o)
{
    std::vector<Corners> good;
    for (const Corners &t : mesh.triangles) {
        const Local &a = mesh.at[static_cast<size_t>(t[0])], &b = mesh.at[static_cast<size_t>(t[1])];
        const Local &c = mesh.at[static_cast<size_t>(t[2])];
        if (well_shaped(a, b, c, o) && agree(a, b, o) && agree(b, c, o) && agree(c, a, o) && same_scale(a, b, c, o))
            good.push_back(t);
    }
    struct Side {
        int low, high, triangle;
        auto key() const { return std::pair(low, high); }
    };
    std::vector<Side> sides;
    for (size_t k = 0; k < good.size(); k++)
        for (size_t i = 0; i < 3; i++) {
            const int p = good[k][i], q = good[k][(i + 1) % 3];
            sides.push_back({std::min(p, q), std::max(p, q), static_cast<int>(k)});
        }
    std::stable_sort(sides.begin(), sides.end(), [](const Side &a, const Side &b) { return a.key() < b.key(); });
    Sets sets(good.size());
    for (size_t k = 1; k < sides.size(); k++)
        if (sides[k].key() == sides[k - 1].key())
            sets.join(static_cast<size_t>(sides[k].triangle), static_cast<size_t>(sides[k - 1].triangle));
    std::vector<std::vector<Corners>> out;
    std::vector<int> number(good.size(), -1);
    for (size_t k = 0; k < good.size(); k++) {
        int &n = number[sets.root(k)];
        if (n < 0) {
            n = static_cast<int>(out.size());
            out.emplace_back();
        }
        out[static_cast<size_t>(n)].push_back(good[k]);
    }
    std::stable_sort(out.begin(), out.end(), [](const auto &a, const auto &b) { return a.size() > b.size(); });
    return out;
}

// A match belongs to the group of the nearest vertex of its surroundings with which it agrees.
void label_all(const std::vector<Match> &matches, const Options &o, Groups &groups)
{
    const auto key = [&](int cx, int cy) { return static_cast<int64_t>(cy) << 32 | static_cast<uint32_t>(cx); };
    std::unordered_map<int64_t, int> vertex;
    for (size_t k = 0; k < matches.size(); k++)
        if (groups.label[k] >= 0)
            vertex[key(matches[k].x / o.cell, matches[k].y / o.cell)] = static_cast<int>(k);
    for (size_t k = 0; k < matches.size(); k++) {
        const Match &m = matches[k];
        if (groups.label[k] >= 0)
            continue;
        int best = -1, nearest = 0;
        for (int c = 0; c < 9; c++) {
            const auto entry = vertex.find(key(m.x / o.cell + c % 3 - 1, m.y / o.cell + c / 3 - 1));
            if (entry == vertex.end())
                continue;
            const Match &v = matches[static_cast<size_t>(entry->second)];
            const int far = (v.x - m.x) * (v.x - m.x) + (v.y - m.y) * (v.y - m.y);
            if ((best < 0 || far < nearest) && agree(local(m), local(v), o)) {
                best = entry->second;
                nearest = far;
            }
        }
        if (best >= 0)
            groups.label[k] = -2 - groups.label[static_cast<size_t>(best)]; // not a vertex for those that follow
    }
    for (int &label : groups.label)
        label = label < -1 ? -2 - label : label;
}

} // namespace

Groups group_matches(const std::vector<Match> &matches, const Options &o)
{
    Groups out;
    out.label.assign(matches.size(), -1);
    Mesh mesh;
    mesh.vertices = thinned(matches, o.cell);
    triangulate(matches, mesh);
    for (int round = 0; round < o.rounds && prune(mesh, o); round++)
        triangulate(matches, mesh);
    for (const std::vector<Corners> &component : components(mesh, o)) {
        std::vector<int> own;
        for (const Corners &t : component)
            own.insert(own.end(), t.begin(), t.end());
        std::sort(own.begin(), own.end());
        own.erase(std::unique(own.begin(), own.end()), own.end());
        const auto label = [&](int v) -> int & {
            return out.label[static_cast<size_t>(mesh.vertices[static_cast<size_t>(v)])];
        };
        std::erase_if(own, [&](int v) { return label(v) >= 0; }); // where groups touch: the larger one's
        if (static_cast<int>(own.size()) < o.least)
            continue;
        for (const int v : own)
            label(v) = out.count;
        for (const Corners &t : component)
            out.triangles.push_back(
                {{mesh.vertices[static_cast<size_t>(t[0])], mesh.vertices[static_cast<size_t>(t[1])],
                  mesh.vertices[static_cast<size_t>(t[2])]},
                 out.count});
        out.vertices.push_back(static_cast<int>(own.size()));
        out.count++;
    }
    label_all(matches, o, out);
    return out;
}

std::vector<double> evidence(const std::vector<Match> &matches, const Groups &groups)
{
    // Of a neighbour from where its map has it, as a share of the distance: mean of groups of unrelated pictures, of
    // which 0.05 (small ones) to 0.29 were seen. Those of one surface have 0.02 to 0.11.
    constexpr double by_chance = 0.15;
    const size_t n = static_cast<size_t>(groups.count);
    std::vector<double> off(n, 0), triangles(n, 0), weight(n, 0);
    for (const Triangle &t : groups.triangles) {
        const size_t g = static_cast<size_t>(t.group);
        std::array<Local, 3> at;
        for (size_t k = 0; k < 3; k++)
            at[k] = local(matches[static_cast<size_t>(t.vertex[k])]);
        for (size_t k = 0; k < 3; k++) {
            const Local &from = at[k], &to = at[(k + 1) % 3];
            const Vector2d edge = to.one - from.one;
            off[g] += (from.back * (to.two - from.two) - edge).norm() / (3 * edge.norm());
        }
        const double det = (std::abs(at[0].det) + std::abs(at[1].det) + std::abs(at[2].det)) / 3;
        triangles[g]++;
        weight[g] += std::min(1.0, det); // cells of image 1 crowd in a smaller image 2
    }
    // Normal distributions in the plane, of deviations s and s0: ln(s0 / s)^2 - 1 + (s / s0)^2 for each independent
    // edge, of which a mesh has one a vertex, that is one for two triangles.
    std::vector<double> out(n, 0);
    for (size_t g = 0; g < n; g++) {
        const double ratio = std::clamp(off[g] / (std::max(1.0, triangles[g]) * by_chance), 1e-3, 1.0);
        out[g] = weight[g] * (-std::log(ratio) - 0.5 * (1 - ratio * ratio));
    }
    return out;
}

} // namespace pipefish::group
