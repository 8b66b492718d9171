// Delaunay triangulation of pixels: the dual of Boost.Polygon's Voronoi diagram, whose predicates are exact on
// integers.
#pragma once

#include <array>
#include <vector>

namespace pipefish::group
{

struct Pixel {
    int x = 0, y = 0;
};

using Corners = std::array<int, 3>; // indices of points

// The triangles of `points`, which must differ; where more than three are on one circle, a fan from the lowest of them.
// The order follows from the points alone. Fewer than three points, or all in one line: none.
std::vector<Corners> delaunay(const std::vector<Pixel> &points);

} // namespace pipefish::group
