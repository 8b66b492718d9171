// Maximum flow is Boost.Graph's (Boykov and Kolmogorov, 2004). OpenCV's detail::GCGraph takes 0.4 times the time, but
// its cut is wrong where the search trees ended in free nodes: 55 of 3000 small random functions, though the flow is
// right (tests/bench/bench_cut.cpp).
#include "segment/cut.hpp"

#include <boost/graph/boykov_kolmogorov_max_flow.hpp>
#include <boost/graph/compressed_sparse_row_graph.hpp>
#include <boost/property_map/property_map.hpp>

#include <algorithm>
#include <stdexcept>
#include <utility>

namespace pipefish::segment
{

// The pairs of each variable, both ways.
struct Cut::Arcs {
    std::vector<int> start;
    std::vector<int> to, twin;     // twin: the same pair seen from the other side
    std::vector<int64_t> capacity; // paid where this is 0 and `to` is 1

    Arcs(size_t variables, const std::vector<Pair> &pairs) : start(variables + 1, 0)
    {
        for (const Pair &p : pairs) {
            start[static_cast<size_t>(p.i) + 1]++;
            start[static_cast<size_t>(p.j) + 1]++;
        }
        for (size_t k = 1; k < start.size(); k++)
            start[k] += start[k - 1];
        std::vector<int> next(start.begin(), start.end() - 1);
        to.resize(2 * pairs.size());
        twin.resize(to.size());
        capacity.resize(to.size());
        const auto put = [&](int i, int j, int64_t forth) {
            const auto at = static_cast<size_t>(next[static_cast<size_t>(i)]++);
            to[at] = j, capacity[at] = forth;
            return at;
        };
        for (const Pair &p : pairs) {
            const size_t a = put(p.i, p.j, p.there), b = put(p.j, p.i, 0);
            twin[a] = static_cast<int>(b), twin[b] = static_cast<int>(a);
        }
    }

    size_t first(size_t i) const { return static_cast<size_t>(start[i]); }
    size_t last(size_t i) const { return static_cast<size_t>(start[i + 1]); }
};

void Cut::add(int i, int j, const int64_t (&c)[4])
{
    const int64_t there = c[1] + c[2] - c[0] - c[3];
    if (there < 0)
        throw std::invalid_argument("a pair of variables costs more where they differ: not submodular");
    constant_ += c[0];
    term_[static_cast<size_t>(i)] += c[2] - c[0];
    term_[static_cast<size_t>(j)] += c[3] - c[2];
    if (there > 0)
        pairs_.push_back({i, j, there});
}

// The source is 0, the sink 1.
int64_t Cut::solve()
{
    const Arcs arcs(term_.size(), pairs_);
    using Graph = boost::compressed_sparse_row_graph<boost::directedS, boost::no_property, boost::no_property,
                                                     boost::no_property, int, int>;
    using Edge = boost::graph_traits<Graph>::edge_descriptor;
    const size_t variables = term_.size();
    std::vector<int> place(arcs.to.size()), own(variables, -1), mate;
    std::vector<std::pair<int, int>> ends;
    std::vector<int64_t> capacity, residual;
    const auto n = static_cast<int>(variables);
    const int source = n, sink = n + 1;
    const auto put = [&](int from, int to, int64_t c) {
        ends.emplace_back(from, to);
        capacity.push_back(c);
        return static_cast<int>(ends.size()) - 1;
    };
    // In the order of their tails, as the graph wants them: of each variable, of the source, of the sink.
    for (size_t i = 0; i < variables; i++) {
        for (size_t k = arcs.first(i); k < arcs.last(i); k++)
            place[k] = put(static_cast<int>(i), arcs.to[k], arcs.capacity[k]);
        if (term_[i] != 0)
            own[i] = put(static_cast<int>(i), term_[i] > 0 ? source : sink, std::max<int64_t>(-term_[i], 0));
    }
    mate.resize(ends.size());
    for (size_t k = 0; k < place.size(); k++)
        mate[static_cast<size_t>(place[k])] = place[static_cast<size_t>(arcs.twin[k])];
    for (const int terminal : {source, sink})
        for (size_t i = 0; i < variables; i++)
            if (own[i] >= 0 && ends[static_cast<size_t>(own[i])].second == terminal) {
                mate[static_cast<size_t>(own[i])] = put(terminal, static_cast<int>(i), std::max<int64_t>(term_[i], 0));
                mate.push_back(own[i]);
            }
    const Graph graph(boost::edges_are_sorted, ends.begin(), ends.end(), n + 2);
    std::vector<Edge> reverse(ends.size()), predecessor(static_cast<size_t>(n) + 2);
    for (size_t k = 0; k < ends.size(); k++)
        reverse[k] = Edge(ends[k].second, mate[k]);
    std::vector<boost::default_color_type> colour(predecessor.size());
    std::vector<int> distance(predecessor.size());
    residual.resize(ends.size());
    const auto edges = boost::get(boost::edge_index, graph);
    const auto nodes = boost::get(boost::vertex_index, graph);
    const auto of_edge = [&](auto &values) { return boost::make_iterator_property_map(values.begin(), edges); };
    const auto of_node = [&](auto &values) { return boost::make_iterator_property_map(values.begin(), nodes); };
    const int64_t most = boost::boykov_kolmogorov_max_flow(graph, of_edge(capacity), of_edge(residual),
                                                           of_edge(reverse), of_node(predecessor), of_node(colour),
                                                           of_node(distance), nodes, source, sink);
    int64_t below = 0;
    one_.resize(variables);
    for (size_t i = 0; i < variables; i++) {
        below += std::min<int64_t>(term_[i], 0);
        one_[i] = colour[i] != boost::black_color;
    }
    return constant_ + below + most;
}

} // namespace pipefish::segment
