// Light on wall points: what every one of a list of points sends to the camera.
#pragma once

#include "sim/light.hpp"

#include <Eigen/Core>

#include <algorithm>
#include <cstddef>
#include <vector>

namespace pipefish::sim
{

// Points on a wall, in the camera's frame (metres, unit vectors).
struct Samples {
    std::vector<float> x, y, z;        // places
    std::vector<float> nx, ny, nz;     // normals, relief included; zero: black
    std::vector<float> vx, vy, vz;     // towards the eye
    std::vector<float> nv;             // n.v, at least 0.02
    std::vector<float> albedo, alpha2; // alpha2: squared roughness
    std::vector<float> along;          // arc length ahead of the camera, metres
    std::vector<float> sky;            // share of the pipe's own light that reaches the point
    std::vector<float> lit;            // lamp by lamp, factors of its light on every point; empty: all 1

    explicit Samples(size_t n)
        : x(n), y(n), z(n), nx(n), ny(n), nz(n), vx(n), vy(n), vz(n), nv(n, 1.0f), albedo(n), alpha2(n, 1.0f), along(n),
          sky(n, 1.0f)
    {
    }
    size_t size() const { return x.size(); }
    void resize(size_t n)
    {
        for (std::vector<float> *part : {&x, &y, &z, &nx, &ny, &nz, &vx, &vy, &vz, &albedo, &along}) {
            part->resize(n);
        }
        nv.resize(n, 1.0f);
        alpha2.resize(n, 1.0f);
        sky.resize(n, 1.0f);
    }
    // Unit normal of point i; its view must be set.
    void set_normal(size_t i, const Eigen::Vector3f &n)
    {
        nx[i] = n.x();
        ny[i] = n.y();
        nz[i] = n.z();
        nv[i] = std::max(n.x() * vx[i] + n.y() * vy[i] + n.z() * vz[i], 0.02f);
    }
};

struct Lighting {
    std::vector<Lamp> lamps;
    int exponent;
    float widen;   // squared roughness that a lamp's size adds, times its squared distance
    float scale;   // grey levels a unit of I / d^2
    float radius;  // of the pipe
    float albedo;  // mean, of the wall
    float bounce;  // factor of Ambient's light
    float gloss;   // factor of the mirror-like part
    float density; // fog's extinction
    Ambient ambient;

    Lighting(const LampSpec &lamp, const FogSpec &fog, double pipe_radius, double wall_albedo, double gloss);
};

// out[i]: linear grey levels, without vignetting; fog dims but its veil is not in it.
void shade(const Samples &samples, const Lighting &lighting, float *out);

} // namespace pipefish::sim
