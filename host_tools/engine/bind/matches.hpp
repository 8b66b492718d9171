// Matches from Python's arrays.
#pragma once

#include "bind/arrays.hpp"
#include "match/grow.hpp"

#include <nanobind/ndarray.h>

#include <vector>

using Rows2 = nanobind::ndarray<const double, nanobind::shape<-1, 2>, nanobind::c_contig, nanobind::device::cpu>;
using Maps = nanobind::ndarray<const double, nanobind::shape<-1, 2, 2>, nanobind::c_contig, nanobind::device::cpu>;
using Values = nanobind::ndarray<const double, nanobind::ndim<1>, nanobind::c_contig, nanobind::device::cpu>;

constexpr double kPixelMost = 1 << 20; // no picture has that many: rounded, scaled and squared it fits an integer

inline std::vector<pipefish::match::Match> matches_of(const Rows2 &xy1, const Rows2 &xy2, const Maps &affine,
                                                      const Values &zncc)
{
    const size_t n = xy1.shape(0);
    require(xy2.shape(0) == n && affine.shape(0) == n && zncc.shape(0) == n,
            "xy1, xy2, affine and zncc: must be as long as each other");
    require(all_within(xy1, -kPixelMost, kPixelMost) && all_within(xy2, -kPixelMost, kPixelMost),
            "xy1 and xy2: not pixels");
    std::vector<pipefish::match::Match> out(n);
    for (size_t k = 0; k < n; k++) {
        pipefish::match::Match &m = out[k];
        m.x = static_cast<int>(xy1(k, 0));
        m.y = static_cast<int>(xy1(k, 1));
        m.centre = {static_cast<float>(xy2(k, 0)), static_cast<float>(xy2(k, 1))};
        for (size_t i = 0; i < 4; i++)
            m.a(static_cast<int>(i / 2), static_cast<int>(i % 2)) = static_cast<float>(affine(k, i / 2, i % 2));
        m.zncc = static_cast<float>(zncc(k));
    }
    return out;
}
