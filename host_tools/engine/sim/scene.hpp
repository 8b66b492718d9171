// A scene: everything that the simulator needs for a recording, and the recording itself. Frames are pure functions of
// the description: any order, any number of threads, the same bits.
#pragma once

#include "sim/lens.hpp"
#include "sim/motion.hpp"
#include "sim/sensor.hpp"
#include "sim/surface.hpp"
#include "sim/telemetry.hpp"
#include "sim/tube.hpp"

#include <memory>
#include <mutex>
#include <optional>

namespace pipefish::sim
{

// A ring of small lamps around the lens, in the plane of the camera centre. Each shines with the intensity
// side + forward cos^2 a at the angle a from the optical axis, and with `side` alone behind it; the ring's mean counts.
struct LampSpec {
    int lamps = 8;
    double ring_radius = 0.03; // metres; 0 = one lamp at the camera centre
    double side = 0.12, forward = 1.0;
    double exposure =
        1150.0; // linear grey level of a white wall, square to a lamp of unit intensity at the pipe's radius
};

struct SceneSpec {
    double diameter = 0.3; // metres
    std::vector<Piece> pieces;
    std::vector<OvalStretch> ovals;
    std::vector<Marker> markers;
    TextureSpec texture;
    LensSpec lens;
    LampSpec lamp;
    SensorSpec sensor;
    MotionSpec motion;
    TelemetrySpec telemetry;
};

struct RowHits;

class Scene
{
public:
    // Ranges are checked where the description is read (bind/sim.cpp). Throws std::invalid_argument for what only the
    // parts know: a lens table that does not rise, a bend that meets itself.
    explicit Scene(const SceneSpec &spec);
    ~Scene();

    const SceneSpec &spec() const { return spec_; }
    const Tube &tube() const { return tube_; }
    const Lens &lens() const { return lens_; }
    const std::vector<FrameState> &frames() const { return frames_; }
    const std::vector<Reading> &readings() const { return readings_; }

    // The camera in the middle of the exposure of row v (pixels, any real number) of a frame.
    CameraState camera(int frame, double v) const;
    double row_time(int frame, double v) const; // of the same, seconds since the middle of frame 0

    // Draws a frame into out[height * width], uint8_t or, of more than 8 bits, uint16_t, on `threads` threads. One call
    // at a time per scene; others wait.
    void render(int frame, int threads, void *out);

    // Where the ray of a pixel meets the wall, world. False outside the circle and the sensor.
    bool cast(int frame, const double px[2], double world[3]) const;
    // The pixel of a world point, not asking what stands between. False outside the field, the circle and the sensor.
    bool project(int frame, const double world[3], double px[2]) const;

private:
    struct PixelRay {
        double dx, dy, dz, pupil;
    };
    struct Buffers;
    struct Reach {
        double behind, ahead; // metres of wall that the surface is made for, around the camera
    };
    static Reach lit_reach(const SceneSpec &spec);
    bool ray(const double px[2], PixelRay &ray) const;
    bool on_sensor(const double px[2]) const;
    void prepare(); // what only drawing needs, at the first frame
    void make_pixel_table();
    int exposures(int frame) const; // how many sharp pictures make up a blurred one
    bool cast_from(const CameraState &camera, const double px[2], double world[3]) const;
    bool project_from(const CameraState &camera, const double world[3], double px[2]) const;
    RowHits cast_row(const Tube::View &view, int row, Buffers &buffers) const;
    void light_row(int row, const RowHits &hits, Buffers &buffers) const;
    void shade_row(int row, Buffers &buffers) const;

    SceneSpec spec_;
    Tube tube_;
    Lens lens_;
    Trajectory trajectory_;
    std::vector<FrameState> frames_;
    std::vector<Reading> readings_;
    Reach reach_;
    std::optional<Surface> surface_;
    std::vector<PixelRay> rays_;         // of the lit pixels, row by row
    std::vector<float> vignette_;        // of the same
    std::vector<int> row_from_, row_to_; // lit pixels of a row: columns [from, to)
    std::vector<size_t> row_offset_;     // of a row in rays_
    std::optional<Film> film_;
    std::unique_ptr<Buffers> buffers_;
    std::mutex rendering_;
};

} // namespace pipefish::sim
