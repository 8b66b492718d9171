// A scene: everything that the simulator needs for a recording, and the recording itself. Frames are pure functions of
// the description: any order, any number of threads, the same bits.
#pragma once

#include "sim/exposure.hpp"
#include "sim/lens.hpp"
#include "sim/light.hpp"
#include "sim/motion.hpp"
#include "sim/sensor.hpp"
#include "sim/surface.hpp"
#include "sim/telemetry.hpp"
#include "sim/tone.hpp"
#include "sim/tube.hpp"
#include "sim/window.hpp"

#include <memory>
#include <mutex>
#include <optional>

namespace pipefish::sim
{

struct SceneSpec {
    double diameter = 0.3; // metres
    std::vector<Piece> pieces;
    std::vector<OvalStretch> ovals;
    std::vector<Marker> markers;
    FeatureSpec features;
    TextureSpec texture;
    LensSpec lens;
    LampSpec lamp;
    FogSpec fog;
    WindowSpec window;
    ExposureSpec exposure;
    ToneSpec tone;
    SensorSpec sensor;
    MotionSpec motion;
    TelemetrySpec telemetry;
};

struct Seen {
    Sight sight;                             // in the camera's frame
    Eigen::Vector3d point, normal, mirrored; // world; `mirrored` if sight.mirrors
};

struct Gaze { // a camera at a moment, and the tube as it sees it
    CameraState camera;
    Tube::View view;
};

class Scene;

// The camera during a frame: one Gaze, or with a rolling shutter one a row, of which the last one is kept. Borrows the
// scene.
class FrameView
{
public:
    FrameView(const Scene &scene, int frame) : scene_(scene), frame_(frame) {}
    int frame() const { return frame_; }
    const Gaze &at(double v); // in the middle of the exposure of row v (pixels, any real number)

private:
    const Scene &scene_;
    int frame_;
    double time_ = 0.0;
    std::optional<Gaze> gaze_{};
};

struct RowPoints;
struct Met;

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

    // Factor of a frame's light: lamps' flicker (in its middle row) times the exposure's gain.
    double light_level(int frame);

    Gaze gaze(double time) const; // seconds since frame 0
    // What the ray of a pixel meets first, and what that mirrors. False outside the circle and the sensor.
    bool see(FrameView &from, const double px[2], Seen &seen) const;
    // The pixel of a world point, not asking what stands between. False outside the field, the circle and the sensor.
    bool project(int frame, const double world[3], double px[2]) const;
    // Does nothing stand between the camera and the point? It must project.
    bool visible(FrameView &from, const double world[3], double px[2]) const;
    // Where the point seen by a pixel of frame `a` is in frame `b`; false where it is hidden or outside, and on water.
    bool flow(FrameView &a, FrameView &b, const double px[2], double out[2]) const;

private:
    struct PixelRay {
        double dx, dy, dz, pupil;
    };
    struct Buffers;
    struct Reach {
        double behind, ahead; // metres of wall that the surface is made for, around the camera
    };
    static Reach lit_reach(const SceneSpec &spec);
    void check_places() const; // throws SpecError
    bool ray(const double px[2], PixelRay &ray) const;
    bool on_sensor(const double px[2]) const;
    void prepare(); // what only drawing needs, at the first frame
    void make_pixel_table();
    int exposures(int frame) const; // how many sharp pictures make up a blurred one
    bool see_from(const Gaze &from, const double px[2], Seen &seen) const;
    bool project_from(const CameraState &camera, const double world[3], double px[2]) const;
    struct Shading;
    struct Place {
        float row, column; // of the surface, texels
    };
    struct Footprint {
        float along, across; // texels
    };
    Place place(const Hit &hit) const;
    void cast_row(const Tube::View &view, int row, Buffers &buffers) const;
    void make_shading();
    void set_looks();
    void make_veil();
    double flicker(int frame, double row) const;
    std::vector<float> meter(int frame) const;
    void prepare_shading(const CameraState &camera);
    Footprint footprint(int row, int x, size_t own, const Buffers &buffers) const;
    void put(const Tube::View &view, const Met &met, const Texel &wall, size_t slot, RowPoints &out) const;
    void put_sight(const Tube::View &view, const PixelRay &r, const Sight &sight, const Footprint *size, float weight,
                   uint32_t pixel, RowPoints &out) const;
    void divide(const Tube::View &view, int x, int row, const Footprint &size, RowPoints &out) const;
    RowPoints gather_row(const Tube::View &view, int row, Buffers &buffers) const;
    void find_shadows(const Tube::View &view, RowPoints &points) const;
    void shade_row(int frame, const Tube::View &view, int row, Buffers &buffers) const;

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
    std::unique_ptr<Shading> shading_;
    std::mutex rendering_;
};

} // namespace pipefish::sim
