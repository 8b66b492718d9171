// The local affine map between two images, fitted to a patch.
#pragma once

#include "match/patch.hpp"

namespace pipefish::match
{

// One Gauss-Newton step over translation, the four entries of the map, gain and offset, on a patch of radius r with
// the mean gradient of both images (Malis' efficient second-order minimisation, linearised once). `local.zncc` must be
// that of measure() at the same radius. Taken only when the shift is below max_shift samples, |C - 1| <= max_change and
// the correlation does not fall; max_change 0 keeps the map and moves the place only. Returns whether it was taken;
// *shift (may be NULL) gets its length.
bool refine(const ScaleStack &first, const ScaleStack &second, int x, int y, int r, double sigma_min, float max_shift,
            float max_change, Local &local, float *shift = nullptr);

} // namespace pipefish::match
