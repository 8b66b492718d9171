#include "group/delaunay.hpp"

#include <boost/polygon/point_data.hpp>
#include <boost/polygon/voronoi.hpp>

#include <algorithm>

namespace pipefish::group
{

std::vector<Corners> delaunay(const std::vector<Pixel> &points)
{
    std::vector<boost::polygon::point_data<int>> sites;
    sites.reserve(points.size());
    for (const Pixel &p : points)
        sites.emplace_back(p.x, p.y);
    boost::polygon::voronoi_diagram<double> diagram;
    boost::polygon::construct_voronoi(sites.begin(), sites.end(), &diagram);
    std::vector<Corners> out;
    out.reserve(diagram.vertices().size());
    std::vector<int> around;
    for (const auto &vertex : diagram.vertices()) {
        around.clear();
        const auto *edge = vertex.incident_edge();
        do {
            around.push_back(static_cast<int>(edge->cell()->source_index()));
            edge = edge->rot_next();
        } while (edge != vertex.incident_edge());
        std::rotate(around.begin(), std::min_element(around.begin(), around.end()), around.end());
        for (size_t k = 2; k < around.size(); k++)
            out.push_back({around[0], around[k - 1], around[k]});
    }
    return out;
}

} // namespace pipefish::group
