// Where a group is: the union of its triangles in either image, and the outlines of that.
#pragma once

#include "group/group.hpp"

#include <opencv2/core.hpp>

namespace pipefish::group
{

using Mask = cv::Mat_<uint8_t>; // 0 or 255
using Outline = std::vector<cv::Point>;

enum class Side { kFirst, kSecond };

// The union of the triangles of `group` in image 1 or 2 of `size`, gaps of up to 6 pixels closed, then made larger by
// `reach` pixels: the windows that were correlated reach beyond the outermost matches.
Mask support(const std::vector<match::Match> &matches, const Groups &groups, int group, Side side, cv::Size size,
             double reach);

// The outer boundaries, to a pixel, largest first.
std::vector<Outline> outlines(const Mask &mask);

} // namespace pipefish::group
