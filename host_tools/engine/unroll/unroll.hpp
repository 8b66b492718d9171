// The wall as one picture: each cell from the keyframe that sees it best, in one light.
#pragma once

#include "geometry/sight.hpp"
#include "unroll/light.hpp"

#include <cstdint>
#include <span>
#include <vector>

namespace pipefish::unroll
{

using geometry::Pose;
using geometry::Vector2d;
using geometry::Vector3d;

struct Picture {
    const uint8_t *pixels = nullptr; // rows of camera.width bytes
    Pose pose;                       // cam_from_world
    int view = 0;                    // number of the keyframe: its place in Light::gain
};

// A place of the wall. `along` and `down` are unit and lie in the wall: to the right and down in the picture that is
// drawn, as somebody inside sees it, so along x down points out of the pipe.
struct Spot {
    Vector3d at, along, down;
};

// A spot as a keyframe sees it.
struct Look {
    bool seen = false;   // in front of the wall, on the sensor, in the image circle, inside the model
    Vector2d uv;         // pixels
    Eigen::Matrix2d j;   // pixels per metre along and down
    double fine = 0.0;   // pixels per metre in the direction that is seen worst, fading out towards the picture's rim
    double coarse = 0.0; // in the direction that is seen best
    double theta = 0.0, phi = 0.0;
    double fall_off = 0.0; // logarithm of cos(incidence) / distance^2
};
// Nothing is seen further from the eye than `reach`.
Look look(const pf_camera &camera, const Pose &pose, const Spot &spot, double reach);

// What each picture shows of each spot's surroundings, `side` metres wide: for balancing. Patches that are clipped or
// dark are left out. patch = first + place in `spots`. fine[i]: the best at spot i.
std::vector<Glance> glances(const pf_camera &camera, std::span<const Picture> pictures, std::span<const Spot> spots,
                            double side, double reach, int first, std::vector<double> &fine);

// A rectangle of cells. Nodes lie at every `step`-th corner of cells: (columns / step + 1) x (rows / step + 1) spots,
// column by column; columns and rows are multiples of step.
struct Sheet {
    int columns = 0, rows = 0, step = 1;
    double cell = 0.0; // metres
    std::vector<Spot> nodes;

    int node_rows() const { return rows / step + 1; }
    int node_columns() const { return columns / step + 1; }
};

struct Tone {
    double finest = 0.0; // pixels per metre: of a place that is seen as well as can be
    double radius = 0.0; // of the pipe, metres
    double reach = 0.0;  // metres
    double seam = 0.0;   // metres over which one keyframe goes over into the next
    double level = 0.0;  // logarithm of reflectance that becomes `grey`
    double grey = 118.0;
};

struct Drawing {
    std::vector<uint8_t> grey, seen; // rows x columns; seen: 0 or 255
    std::vector<int32_t> best;       // node_rows x node_columns: view that counts most, -1 none
    std::vector<float> fine;         // likewise, pixels per metre of it
};

// The same bits for any number of threads.
Drawing draw(const pf_camera &camera, std::span<const Picture> pictures, const Sheet &sheet, const Light &light,
             const Tone &tone, int threads);

} // namespace pipefish::unroll
