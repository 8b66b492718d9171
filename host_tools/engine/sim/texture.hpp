// Reflectance of a concrete wall, baked on the unrolled plane (arc length by circumference) with a mip pyramid.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct TextureSpec {
    uint64_t seed = 1;
    double contrast = 1;      // of aggregate, pores and stains together
    double joint_spacing = 1; // metres between dark rings, 0 = none
    double texel = 0.0005;    // metres
};

class Texture
{
public:
    // Covers arc lengths from s0 to s1 (further away it is continued by its edge); seamless around.
    Texture(const TextureSpec &spec, double radius, double s0, double s1, unsigned threads);

    // Mean reflectance (0..1) over an ellipse about (s, phi): `minor` metres across, `major` along s.
    double sample(double s, double phi, double minor, double major) const;

private:
    struct Level {
        int width = 0, height = 0; // around, along
        std::vector<uint8_t> data;
    };
    std::vector<Level> levels_;
    double s0_, texel_;

    void bake(const TextureSpec &spec, double radius, unsigned threads);
    double bilinear(std::size_t level, double s, double phi) const;
};

} // namespace pipefish::sim
