// What drawing a frame keeps between its passes.
#pragma once

#include "sim/scene.hpp"
#include "sim/shade.hpp"

#include <array>
#include <cstdint>
#include <vector>

namespace pipefish::sim
{

// What a row's pixels see, in the camera's frame, metres; unit normals towards the camera's side, zero: nothing.
struct RowHits {
    std::vector<float> x, y, z, nx, ny, nz;
    std::vector<Sight> water{}; // of the pixels that see water, in order

    explicit RowHits(size_t n) : x(n), y(n), z(n), nx(n), ny(n), nz(n) {}
};

// A thing that a pixel sees, for the light.
struct Met {
    Eigen::Vector3f at, normal, to_eye; // camera frame
    Material material;
    int part;
    double s;           // Hit::s
    float mirrored = 0; // of water: the share of the light that it mirrors
    float weight;       // of the pixel's light
    uint32_t pixel;     // index in the row's lit pixels
};

// The lit points of a row: one a pixel in order; then what comes with pixels that see several things.
struct RowPoints {
    enum Shadow : uint8_t { NONE, ROOTS, QUARTER, ALL }; // what may stand between the point and a lamp
    Samples samples;
    std::vector<float> weight;
    std::vector<uint32_t> pixel;
    std::vector<Shadow> shadow;
    double camera_s; // where the camera is along the pipe

    RowPoints(size_t n, double camera_s_) : samples(n), weight(n, 1.0f), pixel(n), shadow(n, NONE), camera_s(camera_s_)
    {
    }
    size_t grow() // index of one more
    {
        samples.resize(weight.size() + 1);
        weight.push_back(1.0f);
        pixel.push_back(0);
        shadow.push_back(NONE);
        return weight.size() - 1;
    }
};

struct Scene::Buffers {
    static constexpr uint32_t NOTHING = UINT32_MAX;
    static uint32_t key(const Hit &hit)
    {
        return static_cast<uint32_t>(hit.material) << 24 | static_cast<uint32_t>(hit.part);
    }
    // Of the lit pixels: material and part that each sees, whether something thinner than it may be there, where it
    // sees the surface (in water, the mirrored one).
    std::vector<uint32_t> seen;
    std::vector<uint8_t> thin;
    std::vector<Place> place;
    std::vector<RowHits> hits;       // of the rows
    float share = 1.0f;              // of the exposure that is being drawn
    std::vector<float> image, spare; // linear grey levels, height x width

    Buffers(size_t lit, size_t width, size_t height)
        : seen(lit), thin(lit), place(lit), hits(height, RowHits(0)), image(width * height), spare(width * height)
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
    // What is not wall, by material: albedo = textured x the wall's + plain; squared roughness, 0: the wall's; share of
    // the pipe's own light that reaches it; whether the wall's relief is on it.
    struct Look {
        float textured, plain, alpha2, sky;
        bool relief;
    };
    Lighting lighting;
    Window window;
    std::array<Look, 8> looks{};
    Veil veil{};                // empty without fog
    std::vector<double> gain{}; // of the frames: the exposure's
    double start = 0.0, per_metre = 1.0, camera_s = 0.0;
    std::vector<Eigen::Vector3f> axis{}; // the pipe's direction, camera frame, from arc length `start` on
};

} // namespace pipefish::sim
