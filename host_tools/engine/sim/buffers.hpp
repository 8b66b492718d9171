// What drawing a frame keeps between its passes.
#pragma once

#include "sim/scene.hpp"

namespace pipefish::sim
{

// Positions and inward normals of a row's wall points, in the camera's frame, metres.
struct RowHits {
    std::vector<float> x, y, z, nx, ny, nz;

    explicit RowHits(size_t n) : x(n), y(n), z(n), nx(n), ny(n), nz(n) {}
};

struct Scene::Buffers {
    // Of the lit pixels: where each sees the wall, in texels, and the light that reaches it from a white wall.
    std::vector<float> texel_row, texel_column, light;
    std::vector<float> image; // linear grey levels, height x width, blurred along the rows

    Buffers(size_t lit, size_t pixels) : texel_row(lit), texel_column(lit), light(lit), image(pixels) {}
};

} // namespace pipefish::sim
