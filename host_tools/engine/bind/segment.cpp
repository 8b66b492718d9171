// Motion segmentation for Python: _engine.segment_expand. pipefish/segmentation.py is what people use.
#include "segment/expand.hpp"

#include "bind/arrays.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace nb = nanobind;
using namespace pipefish::segment;

void bind_segment(nb::module_ &m);

namespace
{

using Table = nb::ndarray<const int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Line = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

std::vector<std::vector<int32_t>> rows_of(const Table &table)
{
    std::vector<std::vector<int32_t>> out;
    for (size_t k = 0; k < table.shape(0); k++)
        out.emplace_back(table.data() + k * table.shape(1), table.data() + (k + 1) * table.shape(1));
    return out;
}

nb::tuple expand_one(const Table &cost, const Table &ends, const Line &weight, const Table &partner, int lonely,
                     int alpha, const Bytes &start)
{
    Problem problem{rows_of(cost), {}, rows_of(partner), lonely};
    for (size_t e = 0; e < ends.shape(0); e++)
        problem.edges.push_back({ends(e, 0), ends(e, 1), weight(e)});
    Labels labels(start.data(), start.data() + start.shape(0));
    if (alpha >= 0)
        expand_once(problem, alpha, labels);
    else
        expand(problem, 100, labels);
    return nb::make_tuple(to_numpy<uint8_t>(labels.data(), {labels.size()}), problem.energy(labels));
}

} // namespace

void bind_segment(nb::module_ &m)
{
    m.def("segment_expand", &expand_one, nb::arg("cost"), nb::arg("edges"), nb::arg("weight"), nb::arg("partner"),
          nb::arg("lonely"), nb::arg("alpha"), nb::arg("labels"),
          "Costs (labels,N), edges (E,2) with weights (E,), partners (labels,N), cost of being alone, label to expand "
          "(-1: all, until none gains), labels (N,) -> labels (N,), their energy. For tests.");
}
