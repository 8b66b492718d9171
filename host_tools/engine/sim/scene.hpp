// Everything together: what the camera sees at a frame, and the exact truth behind each pixel.
#pragma once

#include "sim/lens.hpp"
#include "sim/motion.hpp"
#include "sim/texture.hpp"
#include "sim/tube.hpp"

#include <memory>
#include <optional>
#include <vector>

namespace pipefish::sim
{

// A ring of lamps around the lens. Intensity over the field angle is side + forward cos^2 (forward hemisphere).
struct LampSpec {
    double side = 0.12, forward = 1.0;
    double exposure = 1150; // grey levels of a white wall under unit intensity at one pipe radius, head on
};

struct SensorSpec {
    uint64_t seed = 1;
    double blur_px = 0.55;     // sigma of the optics
    double read_noise = 1.2;   // grey levels
    double shot_noise = 0.025; // variance per grey level
};

// A bright disc on the wall, for tests that need a point whose image is known.
struct Marker {
    double s = 0, phi = 0, radius = 0; // metres, radians, metres
};

struct SceneSpec {
    double diameter = 0.3;
    std::vector<Piece> pieces;
    std::vector<OvalStretch> ovals;
    TextureSpec texture;
    LensSpec lens;
    LampSpec lamp;
    SensorSpec sensor;
    MotionSpec motion;
    std::vector<Marker> markers;
};

class Scene
{
public:
    explicit Scene(const SceneSpec &spec);

    const SceneSpec &spec() const { return spec_; }
    const Tube &tube() const { return tube_; }
    const Lens &lens() const { return lens_; }
    const Motion &motion() const { return motion_; }

    // Row-major width x height grey levels. The texture is baked at the first call. Same bits for any thread count.
    std::vector<uint8_t> render(int frame, unsigned threads);

    // The wall point behind a pixel; nothing outside the image circle.
    std::optional<Hit> cast(int frame, const Vec2 &px) const;
    // The pixel of a world point; nothing beyond the field. Does not ask whether something is in between.
    std::optional<Vec2> project(int frame, const Vec3 &point) const;

private:
    SceneSpec spec_;
    Tube tube_;
    Lens lens_;
    Motion motion_;
    std::unique_ptr<Texture> texture_;
    struct PixelRay {
        float theta;                           // < 0 outside the circle
        float dx, dy, dz, oz, vignette, angle; // direction, origin, light kept, radians a pixel covers
    };
    std::vector<PixelRay> rays_;

    void prepare(unsigned threads);
    double shade(const Pose &pose, const PixelRay &ray) const;
};

} // namespace pipefish::sim
