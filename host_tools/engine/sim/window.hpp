// What sticks to the glass in front of the lens: drops of water, which show a small picture upside down, and dirt,
// which takes light away and scatters some of its surroundings. Far out of focus, so soft; at rest in the image.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct WindowSpec {
    uint64_t seed = 1;
    int drops = 0, dirt = 0;                   // how many
    double drop_radius = 40, dirt_radius = 25; // pixels, the largest; the smallest have a third of it
    double dirt_density = 0.5;                 // share of the light that the middle of the darkest one takes
};

class Window
{
public:
    // Spots are spread evenly over the image circle (pixels).
    Window(const WindowSpec &spec, int width, int height, double c_u, double c_v, double circle);
    // Lays the spots over a picture of width x height linear values.
    void apply(std::vector<float> &picture) const;

private:
    struct Touched { // a pixel under a drop or dirt: out = keep * own + take * blurred picture at (x, y)
        uint32_t pixel;
        float keep, take, x, y;
    };
    int width_, height_;
    std::vector<Touched> touched_;
};

} // namespace pipefish::sim
