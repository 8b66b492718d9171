// Regions that are found again in another picture of the same thing.
#pragma once

#include "match/region.hpp"

#include <vector>

namespace pipefish::match
{

// Circles of SIFT's detector and, where asked for, of the Hessian's determinant, and ellipses of extremal regions; of
// the detected size.
std::vector<Region> detect(const ScaleStack &stack, const RegionOptions &options);

} // namespace pipefish::match
