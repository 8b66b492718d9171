// What drawing a frame keeps between its passes.
#pragma once

#include "sim/scene.hpp"

namespace pipefish::sim
{

struct Scene::Buffers {
    // Of the lit pixels: where each sees the wall, in texels, and the light that reaches it from a white wall.
    std::vector<float> texel_row, texel_column, light;
    std::vector<float> image; // linear grey levels, height x width, blurred along the rows

    Buffers(size_t lit, size_t pixels) : texel_row(lit), texel_column(lit), light(lit), image(pixels) {}
};

} // namespace pipefish::sim
