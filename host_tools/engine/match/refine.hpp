// The local affine map between two images, fitted to a patch.
#pragma once

#include "match/patch.hpp"

namespace pipefish::match
{

// One Gauss-Newton step over translation, the four entries of the map, gain and offset, on a patch of radius r with
// the mean gradient of both images (Malis' efficient second-order minimisation, linearised once). Taken only when the
// shift is below max_shift samples, |C - 1| <= max_change and the correlation over the patch, which goes into
// `local.zncc` also where it is not taken, does not fall; max_change 0 keeps the map and moves the place only. Returns
// whether it was taken.
bool refine(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, float max_shift,
            float max_change, Local &local);

} // namespace pipefish::match
