// A scene: everything that the simulator needs for a recording, and the recording itself. Frames are pure functions of
// the description: any order, any number of threads, the same bits.
#pragma once

#include "sim/lens.hpp"
#include "sim/motion.hpp"
#include "sim/surface.hpp"
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

struct SensorSpec {
    uint64_t seed = 1;
    double blur_px = 0.55;     // pixels, standard deviation of the optics' Gaussian blur
    double read_noise = 1.2;   // grey levels, standard deviation
    double shot_noise = 0.025; // variance a grey level of signal
};

struct SceneSpec {
    double diameter = 0.3; // metres
    std::vector<Piece> pieces;
    std::vector<OvalStretch> ovals;
    std::vector<Marker> markers;
    FeatureSpec features;
    TextureSpec texture;
    LensSpec lens;
    LampSpec lamp;
    SensorSpec sensor;
    MotionSpec motion;
};

struct Seen {
    Sight sight;                             // in the camera's frame
    Eigen::Vector3d point, normal, mirrored; // world; `mirrored` if sight.mirrors
};

struct RowPoints;

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

    // Draws a frame into out[height * width] on `threads` threads. One call at a time per scene; others wait.
    void render(int frame, int threads, uint8_t *out);

    // The tube as the frame's camera sees it, for the calls below.
    Tube::View view(int frame) const;
    // What the ray of a pixel meets first, and what that mirrors. False outside the circle and the sensor.
    bool see(const Tube::View &view, int frame, const double px[2], Seen &seen) const;
    // The pixel of a world point, not asking what stands between. False outside the field, the circle and the sensor.
    bool project(int frame, const double world[3], double px[2]) const;
    // Does nothing stand between the camera and the point? It must project.
    bool visible(const Tube::View &view, int frame, const double world[3], double px[2]) const;
    // Where the wall point seen by a pixel of frame `a` is in frame `b`; false where it is hidden or outside, and on
    // water.
    bool flow(const Tube::View &view_a, int a, const Tube::View &view_b, int b, const double px[2],
              double out[2]) const;

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
    void make_blur_kernel();
    void cast_row(const Tube::View &view, int row, Buffers &buffers) const;
    RowPoints gather_row(const Tube::View &view, int row, Buffers &buffers) const;
    void add_point(const Tube::View &view, const PixelRay &r, const Hit &hit, float weight, uint32_t pixel,
                   RowPoints &out) const;
    void place_texel(const Hit &hit, size_t pixel, Buffers &buffers) const;
    void light_row(const Tube::View &view, int row, Buffers &buffers) const;
    void shade_row(int row, Buffers &buffers) const;
    void develop_row(int frame, int row, const Buffers &buffers, uint8_t *out) const;

    SceneSpec spec_;
    Tube tube_;
    Lens lens_;
    std::vector<FrameState> frames_;
    Reach reach_;
    std::optional<Surface> surface_;
    std::vector<PixelRay> rays_;         // of the lit pixels, row by row
    std::vector<float> vignette_;        // of the same
    std::vector<int> row_from_, row_to_; // lit pixels of a row: columns [from, to)
    std::vector<size_t> row_offset_;     // of a row in rays_
    std::vector<float> blur_;            // half kernel: weights of 0, 1, 2, ... pixels
    std::unique_ptr<Buffers> buffers_;
    std::mutex rendering_;
};

} // namespace pipefish::sim
