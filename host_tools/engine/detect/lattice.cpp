#include "lattice_steps.hpp"

#include "disc.hpp"

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <set>

namespace pipefish::detect
{
namespace
{

Eigen::Vector2d direction(const Corner &c, int d)
{
    return d < 2 ? c.edge[d] : -c.edge[d - 2];
}

// From direction d towards the next one it is dark for even d, light for odd. Along an edge that holds all the way.
bool edge_between(const cv::Mat &image, const Corner &a, const Corner &b, int d)
{
    const Eigen::Vector2d way = b.at - a.at;
    const double length = way.norm();
    Eigen::Vector2d side(-way.y(), way.x());
    side *= std::clamp(0.15 * length, 1.2, 3.0) / length;
    for (const double t : {0.3, 0.5, 0.7}) {
        const Eigen::Vector2d p = a.at + t * way + side, q = a.at + t * way - side;
        const double step = grey_at(image, p.x(), p.y()) - grey_at(image, q.x(), q.y());
        if ((d % 2 == 0 ? -step : step) < 0.15 * std::min(a.strength, b.strength))
            return false;
    }
    return true;
}

// The neighbour of each corner in each direction, or -1, and the direction by which one arrives there.
struct Link {
    int to = -1, arrives = 0;
};

std::vector<std::array<Link, 4>> link_corners(const cv::Mat &image, const std::vector<Corner> &corners)
{
    const int n = static_cast<int>(corners.size());
    std::vector<std::array<Link, 4>> links(corners.size());
    const double steepest = std::cos(0.42);
    for (int i = 0; i < n; i++) {
        const Corner &a = corners[size_t(i)];
        std::array<std::vector<std::pair<double, int>>, 4> near;
        for (int j = 0; j < n; j++) {
            const Corner &b = corners[size_t(j)];
            const Eigen::Vector2d way = b.at - a.at;
            const double far = way.norm();
            if (j == i || far < 3 || far > 400)
                continue;
            for (int d = 0; d < 4; d++) {
                // The edge that leaves a as one kind arrives at b as the other: colours change sides there.
                if (direction(a, d).dot(way) > steepest * far && std::abs(b.edge[1 - d % 2].dot(way)) > steepest * far)
                    near[size_t(d)].push_back({far, j});
            }
        }
        for (int d = 0; d < 4; d++) {
            std::sort(near[size_t(d)].begin(), near[size_t(d)].end());
            const size_t tries = std::min<size_t>(near[size_t(d)].size(), 3);
            for (size_t k = 0; k < tries; k++) {
                const int j = near[size_t(d)][k].second;
                const Corner &b = corners[size_t(j)];
                if (!edge_between(image, a, b, d))
                    continue;
                const int line = 1 - d % 2;
                links[size_t(i)][size_t(d)] = {j, b.edge[line].dot(b.at - a.at) > 0 ? line : line + 2};
                break;
            }
        }
    }
    return links;
}

} // namespace

void prune(Grid &grid)
{
    while (grid.size() > 4) {
        double worst = 0.0;
        Site at{};
        for (const auto &[site, point] : grid) {
            double off = 0.0;
            int seen = 0;
            for (int d = 0; d < 2; d++) {
                const auto before = grid.find(plus(site, kSteps[size_t(d + 2)]));
                const auto after = grid.find(plus(site, kSteps[size_t(d)]));
                if (before == grid.end() || after == grid.end())
                    continue;
                const Eigen::Vector2d way = after->second.at - before->second.at;
                off += (0.5 * (after->second.at + before->second.at) - point.at).norm() / (0.5 * way.norm() + 1e-9);
                seen++;
            }
            if (seen && off / seen > worst) {
                worst = off / seen;
                at = site;
            }
        }
        if (worst < 0.35)
            return;
        grid.erase(at);
    }
}

Grid grid_of_corners(const cv::Mat &image, const std::vector<Corner> &corners)
{
    const auto links = link_corners(image, corners);
    const auto mutual = [&](int i, int d) {
        const Link &l = links[size_t(i)][size_t(d)];
        return l.to >= 0 && links[size_t(l.to)][size_t((l.arrives + 2) % 4)].to == i;
    };
    std::vector<int> done(corners.size(), 0);
    Grid best;
    for (size_t seed = 0; seed < corners.size(); seed++) {
        if (done[seed])
            continue;
        Grid grid;
        std::vector<std::pair<Site, int>> at(corners.size()); // site and turn of its directions
        std::deque<int> open = {static_cast<int>(seed)};
        std::set<int> reached = {static_cast<int>(seed)};
        at[seed] = {{0, 0}, 0};
        while (!open.empty()) {
            const int i = open.front();
            open.pop_front();
            done[size_t(i)] = 1;
            const auto [site, turn] = at[size_t(i)];
            if (grid.contains(site))
                continue;
            Point p;
            p.at = corners[size_t(i)].at;
            p.code = turn % 2 == 0;
            grid[site] = p;
            for (int d = 0; d < 4; d++) {
                if (!mutual(i, d))
                    continue;
                const Link &l = links[size_t(i)][size_t(d)];
                if (!reached.insert(l.to).second)
                    continue;
                const int step = (d + turn) % 4;
                at[size_t(l.to)] = {plus(site, kSteps[size_t(step)]), (step - l.arrives + 4) % 4};
                open.push_back(l.to);
            }
        }
        if (grid.size() > best.size())
            best = std::move(grid);
    }
    prune(best);
    return best;
}

std::optional<Forecast> forecast(const Grid &grid, const Site &site, int columns, bool with_itself)
{
    constexpr int reach = 3;
    Eigen::Matrix<double, 6, 6> n = Eigen::Matrix<double, 6, 6>::Zero();
    Eigen::Matrix<double, 6, 2> r = Eigen::Matrix<double, 6, 2>::Zero();
    int count = 0;
    for (int dj = -reach; dj <= reach; dj++) {
        for (int di = -reach; di <= reach; di++) {
            if (di == 0 && dj == 0 && !with_itself)
                continue;
            int i = site[0] + di;
            if (columns)
                i = (i % columns + columns) % columns;
            const auto found = grid.find({i, site[1] + dj});
            if (found == grid.end())
                continue;
            const double w = std::exp(-0.4 * (di * di + dj * dj));
            Eigen::Matrix<double, 6, 1> row;
            row << 1.0, di, dj, 0.5 * di * di, di * dj, 0.5 * dj * dj;
            n += w * row * row.transpose();
            r += w * row * found->second.at.transpose();
            count++;
        }
    }
    if (count < 3)
        return std::nullopt;
    // Near collinear: nothing is known across.
    const Eigen::Matrix3d linear = n.topLeftCorner<3, 3>();
    if (linear.selfadjointView<Eigen::Lower>().eigenvalues()[0] < 1e-3 * n(0, 0))
        return std::nullopt;
    for (int k = 3; k < 6; k++)
        n(k, k) += 0.02 * n(0, 0);
    const Eigen::Matrix<double, 6, 2> s = n.ldlt().solve(r);
    Forecast f;
    f.at = s.row(0).transpose();
    f.cell.col(0) = s.row(1).transpose();
    f.cell.col(1) = s.row(2).transpose();
    return f;
}

std::vector<Site> grow(Grid &grid, int columns, const std::function<bool(const Site &)> &wanted,
                       const std::function<std::optional<Point>(const Forecast &, const Site &)> &measure)
{
    std::map<Site, size_t> failed; // and of how many points the grid was then
    for (bool more = true; more;) {
        more = false;
        std::set<Site> border;
        for (const auto &[site, point] : grid)
            for (const Site &step : kSteps) {
                Site beside = plus(site, step);
                if (columns)
                    beside[0] = (beside[0] % columns + columns) % columns;
                if (!grid.contains(beside) && wanted(beside))
                    border.insert(beside);
            }
        for (const Site &site : border) {
            const auto before = failed.find(site);
            if (before != failed.end() && before->second == grid.size())
                continue;
            const auto f = forecast(grid, site, columns, false);
            const auto p = f ? measure(*f, site) : std::nullopt;
            if (p) {
                grid[site] = *p;
                failed.erase(site);
                more = true;
            } else {
                failed[site] = grid.size();
            }
        }
    }
    std::vector<Site> sites;
    for (const auto &[site, size] : failed)
        sites.push_back(site);
    return sites;
}

// ---- placement

namespace
{

class Places // of a board's points by their sites
{
public:
    explicit Places(const Board &board) : columns_(board.columns)
    {
        low_ = high_ = board.at[0];
        for (const Site &s : board.at)
            for (size_t k = 0; k < 2; k++) {
                low_[k] = std::min(low_[k], s[k]);
                high_[k] = std::max(high_[k], s[k]);
            }
        width_ = high_[0] - low_[0] + 1;
        code_.assign(size_t(width_ * (high_[1] - low_[1] + 1)), -1);
        for (size_t k = 0; k < board.at.size(); k++)
            code_[index(board.at[k])] = board.code.empty() ? 0 : board.code[k];
    }

    // The code of the point there; -1: none.
    int code(Site s) const
    {
        if (columns_)
            s[0] = (s[0] % columns_ + columns_) % columns_;
        if (s[0] < low_[0] || s[0] > high_[0] || s[1] < low_[1] || s[1] > high_[1])
            return -1;
        return code_[index(s)];
    }
    const Site &low() const { return low_; }
    const Site &high() const { return high_; }

private:
    size_t index(const Site &s) const { return size_t((s[1] - low_[1]) * width_ + s[0] - low_[0]); }

    int columns_;
    Site low_, high_;
    int width_ = 0;
    std::vector<int> code_;
};

struct Trial {
    Placement placement;
    int contradictions = 0;
};

// All ways to lay the grid on the board with a matrix, that have at least `least` hits.
void try_matrix(const Grid &grid, const std::vector<Site> &absent, const Board &board, const Places &places,
                const std::array<int, 4> &matrix, bool colours, std::vector<Trial> &trials)
{
    Placement p;
    p.matrix = matrix;
    p.mirrored = matrix[0] * matrix[3] - matrix[1] * matrix[2] < 0;
    Site low = {std::numeric_limits<int>::max(), std::numeric_limits<int>::max()}, high = {-low[0], -low[1]};
    for (const auto &[site, point] : grid) {
        const Site s = p(site);
        for (size_t k = 0; k < 2; k++) {
            low[k] = std::min(low[k], s[k]);
            high[k] = std::max(high[k], s[k]);
        }
    }
    // Upper left dark stays so under half turns and the transposition, else it becomes upper left light.
    const bool corners = board.kind == Kind::checkerboard;
    const bool flips = corners && matrix[0] * matrix[3] + matrix[1] * matrix[2] < 0;
    const int i0 = board.columns ? 0 : places.low()[0] - high[0];
    const int i1 = board.columns ? board.columns - 1 : places.high()[0] - low[0];
    for (int j = places.low()[1] - high[1]; j <= places.high()[1] - low[1]; j++) {
        for (int i = i0; i <= i1; i++) {
            Trial t{p, 0};
            t.placement.shift = {i, j};
            for (const auto &[site, point] : grid) {
                const int code = places.code(t.placement(site));
                t.placement.hits += code >= 0 && (!colours || code == (flips ? 1 - point.code : point.code));
            }
            if (t.placement.hits == 0)
                continue;
            for (const Site &site : absent)
                t.contradictions += places.code(t.placement(site)) >= 0;
            trials.push_back(t);
        }
    }
}

// How much a placement's rows read like text: the x component of the mean step along board x.
double reads(const Grid &grid, const Placement &p, const Board &board)
{
    Eigen::Vector2d mean = Eigen::Vector2d::Zero();
    Eigen::Vector2d middle = Eigen::Vector2d::Zero();
    Eigen::Vector2d flat_middle = Eigen::Vector2d::Zero();
    const auto flat = [&](const Site &s) -> Eigen::Vector2d { return s[0] * board.step_i + s[1] * board.step_j; };
    for (const auto &[site, point] : grid) {
        middle += point.at / static_cast<double>(grid.size());
        flat_middle += flat(p(site)) / static_cast<double>(grid.size());
    }
    for (const auto &[site, point] : grid)
        mean += (flat(p(site)) - flat_middle).x() * (point.at - middle);
    return mean.x() + 1e-6 * mean.y();
}

std::vector<std::array<int, 4>> matrices(const Board &board, bool mirrored)
{
    std::vector<std::array<int, 4>> all;
    const bool any_base = board.discs();
    for (int code = 0; code < 81; code++) {
        const std::array<int, 4> m = {code % 3 - 1, code / 3 % 3 - 1, code / 9 % 3 - 1, code / 27 - 1};
        const int zeros = int(std::count(m.begin(), m.end(), 0));
        if (m[0] * m[3] - m[1] * m[2] == (mirrored ? -1 : 1) && (any_base || zeros == 2))
            all.push_back(m);
    }
    return all;
}

} // namespace

std::array<int, 2> extent(const Grid &grid, const Board &board)
{
    std::array<int, 2> best = {0, 0};
    double most = -1.0;
    const bool staggered = board.kind == Kind::asymmetric_circles;
    for (const auto &m : matrices(board, false)) {
        std::vector<Site> sites;
        for (const auto &[site, point] : grid) {
            const Site s = Placement{m}(site);
            sites.push_back(staggered ? Site{s[0] - s[1], s[0] + s[1]} : s); // halves of a column, and the row
        }
        std::array<int, 2> size = {0, 0};
        for (size_t before = sites.size() + 1; !sites.empty() && sites.size() < before;) {
            before = sites.size();
            Site low = sites[0], high = low;
            std::map<int, size_t> along[2];
            for (const Site &s : sites)
                for (size_t k = 0; k < 2; k++) {
                    low[k] = std::min(low[k], s[k]);
                    high[k] = std::max(high[k], s[k]);
                    along[k][s[k]]++;
                }
            size = {high[0] - low[0] + 1, high[1] - low[1] + 1};
            const std::array<double, 2> full = {staggered ? size[1] / 2.0 : size[1],
                                                staggered ? size[0] / 2.0 : size[0]};
            std::erase_if(sites, [&](const Site &s) {
                for (size_t k = 0; k < 2; k++)
                    if ((s[k] == low[k] || s[k] == high[k]) && 2.0 * double(along[k][s[k]]) < full[k])
                        return true;
                return false;
            });
        }
        if (staggered)
            size[0] = size[0] / 2;
        const double filled = size[0] > 0 ? double(sites.size()) * double(sites.size()) / (size[0] * size[1]) : 0.0;
        if (filled > most) {
            most = filled;
            best = size;
        }
    }
    return best;
}

// In how many ways the whole board may be turned and look the same.
static int own_turns(const Board &board)
{
    Grid whole;
    for (size_t k = 0; k < board.at.size(); k++)
        whole[board.at[k]].code = board.code.empty() ? 0 : board.code[k];
    std::vector<Trial> trials;
    const Places places(board);
    for (const auto &m : matrices(board, false))
        try_matrix(whole, {}, board, places, m, true, trials);
    const int size = static_cast<int>(board.at.size());
    return int(std::count_if(trials.begin(), trials.end(), [&](const Trial &t) { return t.placement.hits == size; }));
}

std::optional<Placement> place_grid(const Grid &grid, const std::vector<Site> &absent, const Board &board)
{
    if (grid.empty())
        return std::nullopt;
    const Places places(board);
    std::vector<Trial> trials;
    const int size = static_cast<int>(grid.size());
    // As it should be, or clearly better as if seen in a mirror; a checkerboard's colours may be exchanged too.
    int hits[2] = {0, 0};
    for (const bool colours : {true, false}) {
        if (!colours && board.kind != Kind::checkerboard)
            break;
        for (const bool mirrored : {false, true}) {
            std::vector<Trial> some;
            for (const auto &m : matrices(board, mirrored))
                try_matrix(grid, absent, board, places, m, colours, some);
            for (const Trial &t : some)
                hits[mirrored] = std::max(hits[mirrored], t.placement.hits);
            if (!mirrored || hits[1] > hits[0] + std::max(2, size / 20))
                trials = std::move(some);
        }
        if (10 * std::max(hits[0], hits[1]) >= 9 * size)
            break;
    }
    if (trials.empty())
        return std::nullopt;
    const auto better = [](const Trial &a, const Trial &b) {
        return a.placement.hits != b.placement.hits ? a.placement.hits > b.placement.hits
                                                    : a.contradictions < b.contradictions;
    };
    const Trial top = *std::min_element(trials.begin(), trials.end(), better);
    // What explains the picture about as well. A code that is read wrong in places costs hits: these count there.
    const int slack = board.code.empty() || board.kind == Kind::checkerboard ? 0 : size / 12;
    const int doubt = absent.empty() ? 0 : 2;
    std::vector<Trial> equal;
    for (const Trial &t : trials)
        if (t.placement.hits >= top.placement.hits - slack && t.contradictions <= top.contradictions + doubt)
            equal.push_back(t);
    const Trial *best = nullptr;
    double most = 0.0;
    for (const Trial &t : equal) {
        const double score = reads(grid, t.placement, board);
        const bool leads = board.kind == Kind::sleeve ? !best || better(t, *best) : !best || score > most;
        if (leads) {
            best = &t;
            most = score;
        }
    }
    Placement p = best->placement;
    p.turns = own_turns(board);
    p.ways = static_cast<int>(equal.size());
    return p;
}

} // namespace pipefish::detect
