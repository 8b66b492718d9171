// Brickwork: stretchers along the pipe, courses around it, every other one half a brick further on.
#pragma once

#include "sim/material.hpp"

namespace pipefish::sim
{

// Adds bricks and mortar to the (relative) albedo, height and roughness of a canvas.
void paint_bricks(const TextureSpec &spec, const Canvas &canvas, WallPaint &out);

} // namespace pipefish::sim
