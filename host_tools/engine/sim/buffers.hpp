// What drawing a frame keeps between its passes.
#pragma once

#include "sim/scene.hpp"
#include "sim/shade.hpp"

namespace pipefish::sim
{

// Positions and inward normals of a row's wall points, in the camera's frame, metres.
struct RowHits {
    std::vector<float> x, y, z, nx, ny, nz;

    explicit RowHits(size_t n) : x(n), y(n), z(n), nx(n), ny(n), nz(n) {}
};

struct Scene::Buffers {
    std::vector<float> texel_row, texel_column; // of the lit pixels: where each sees the wall, in texels
    std::vector<RowHits> hits;                  // of the rows
    float share = 1.0f;                         // of the exposure that is being drawn
    std::vector<float> image, spare;            // linear grey levels, height x width

    Buffers(size_t lit, size_t width, size_t height)
        : texel_row(lit), texel_column(lit), hits(height, RowHits(0)), image(width * height), spare(width * height)
    {
    }
};

// What fog adds to every view: a table over the image, one node every STEP pixels, and over the depth d as
// d / (d + radius).
struct Veil {
    static constexpr int STEP = 16, DEPTHS = 24;
    int columns = 0, rows = 0;
    float radius = 1.0f;
    std::vector<float> nodes{}; // rows x columns x DEPTHS

    float at(float x, float y, float depth) const;
};

// What lighting knows: of the scene, and of the frame that is being drawn.
struct Scene::Shading {
    Lighting lighting;
    Window window;
    Veil veil{};                // empty without fog
    std::vector<double> gain{}; // of the frames: the exposure's
    double start = 0.0, per_metre = 1.0, camera_s = 0.0;
    std::vector<Eigen::Vector3f> axis{}; // the pipe's direction, camera frame, from arc length `start` on
};

} // namespace pipefish::sim
