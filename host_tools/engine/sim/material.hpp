// What pipes are made of: procedural walls over (arc length, clock angle), and how each looks in lamp light.
//
// A wall is painted in three channels: albedo; roughness (GGX alpha: 0 = mirror, 1 = matt); and relief, a height in
// metres that only tilts the normal: the true wall stays the tube, and relief that is higher than half a millimetre
// (bricks' joints 3 mm, folds of a lining 1 mm) is what a picture shows as tone, not as a shift.
#pragma once

#include "sim/paint.hpp"

namespace pipefish::sim
{

enum class WallMaterial { CONCRETE, BRICK, CLAY, PVC, LINED };

struct TextureSpec {
    WallMaterial material = WallMaterial::CONCRETE;
    uint64_t seed = 1;
    double contrast = 1.0;      // of all that is painted; 0 = an even wall of albedo 0.45, without relief
    double relief = 1.0;        // factor of the heights
    double wear = 0.4;          // 0..1: erosion, scratches, cracks
    double dirt = 0.4;          // 0..1: stains, deposits' film, specks
    double wetness = 0.25;      // 0..1: share of the wall under a film of water, from the invert up; drops
    double gloss = 1.0;         // factor of the mirror-like reflection; an even wall has it only with a roughness
    double roughness = 0.0;     // GGX alpha of the whole wall; 0 = as painted
    double joint_spacing = 1.0; // metres between dark rings; 0 = none
};

struct WallLook {
    float albedo;      // mean, 0..1
    float alpha;       // roughness of the plain wall
    float slope_range; // largest slope of the relief that is kept
    float joint_half;  // half the width of a dark ring, metres
};
WallLook wall_look(const TextureSpec &spec);

struct WallPaint {
    Layer albedo; // 0..1
    Layer alpha;  // 0..1
    Layer height; // metres, towards the axis

    explicit WallPaint(size_t n) : albedo(n, 0.0f), alpha(n, 0.0f), height(n, 0.0f) {}
};

// Paints a stretch of wall. The same place looks the same on every canvas.
WallPaint paint_wall(const TextureSpec &spec, const Canvas &canvas);

} // namespace pipefish::sim
