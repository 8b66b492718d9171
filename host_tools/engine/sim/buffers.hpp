// What drawing a frame keeps between its passes.
#pragma once

#include "sim/scene.hpp"

namespace pipefish::sim
{

// Lit points of a row, in the camera's frame: a pixel has one, or several where its footprint meets more than one
// thing. The pixel's grey level is the sum over its points of light x (textured x surface albedo + plain).
struct RowPoints {
    enum Shadow : uint8_t { NONE, ROOTS, QUARTER, ALL };
    std::vector<float> x, y, z, nx, ny, nz; // metres; unit normals, towards the camera's side
    std::vector<float> textured, plain;
    std::vector<uint32_t> pixel; // index in the row's lit pixels, rising
    std::vector<Shadow> shadow;  // what may stand between the point and a lamp
};

struct Scene::Buffers {
    // Of the lit pixels: where each sees the wall, in texels, what it sees (material and part; NOTHING), the light that
    // reaches it from a white wall, and grey levels that do not depend on the surface.
    static constexpr uint32_t NOTHING = UINT32_MAX;
    std::vector<float> texel_row, texel_column, light, plain;
    std::vector<uint32_t> seen;
    std::vector<Hit> hits;
    std::vector<uint8_t> thin; // something thinner than the pixel may be there
    std::vector<float> image;  // linear grey levels, height x width, blurred along the rows

    Buffers(size_t lit, size_t pixels)
        : texel_row(lit), texel_column(lit), light(lit), plain(lit), seen(lit), hits(lit), thin(lit), image(pixels)
    {
    }
};

} // namespace pipefish::sim
