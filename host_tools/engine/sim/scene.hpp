// A scene: everything that the simulator needs for a recording, and the recording itself. Frames are pure functions of
// the configuration: any order, any number of threads, the same bits.
#pragma once

#include "sim/lens.hpp"
#include "sim/motion.hpp"
#include "sim/surface.hpp"
#include "sim/tube.hpp"

#include <memory>
#include <mutex>

namespace pipefish::sim
{

struct CameraConfig {
    int width, height; // pixels
    double c_u, c_v;   // principal point = centre of the image circle
    double vignetting; // share of the light lost at the edge of the field, grows with theta^4
    double blur;       // pixels, standard deviation of the optics' Gaussian blur; 0 = none
    double read_noise; // grey levels, standard deviation
    double shot_noise; // variance a grey level of signal
    double gamma;      // encoded = 255 (linear / 255)^(1 / gamma)
};

struct LightConfig {
    bool ring;       // false: even light from everywhere, for tests of geometry
    int lamps;       // of the ring, 1..64
    double radius;   // of the ring around the optical axis, metres; 0 = one lamp at the camera centre
    double rim_grey; // exposure: linear grey level of the mean albedo, lit squarely by one lamp of the ring's power at
                     // the distance of the pipe's radius
};

struct SceneConfig {
    uint64_t seed;
    double radius; // of the pipe, metres
    std::vector<Run> runs;
    std::vector<OvalStretch> ovals;
    SurfaceConfig surface;
    LightConfig light;
    CameraConfig camera;
    LensTable lens;
    MotionConfig motion;
    SensorConfig sensors;
};

class Scene
{
public:
    // Throws std::invalid_argument saying what is wrong with the configuration.
    explicit Scene(const SceneConfig &config);
    ~Scene();

    const SceneConfig &config() const { return config_; }
    const Tube &tube() const { return tube_; }
    const Lens &lens() const { return lens_; }
    const std::vector<FrameState> &frames() const { return frames_; }

    // Draws a frame into out[height * width] on `threads` threads. One call at a time per scene; others wait.
    void render(int frame, int threads, uint8_t *out);

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
    static constexpr int RESPONSE_STEPS = 64; // a grey level

    static Reach lit_reach(const SceneConfig &config);
    bool ray(const double px[2], PixelRay &ray) const;
    bool on_sensor(const double px[2]) const;
    void make_pixel_table();
    void make_blur_kernel();
    void make_response();
    void cast_row(const Tube::View &view, int row, Buffers &buffers) const;
    void shade_row(int row, Buffers &buffers) const;
    void develop_row(int frame, int row, const Buffers &buffers, uint8_t *out) const;

    SceneConfig config_;
    Tube tube_;
    Lens lens_;
    std::vector<FrameState> frames_;
    Reach reach_;
    Surface surface_;
    std::vector<PixelRay> rays_;         // of the lit pixels, row by row
    std::vector<float> vignette_;        // of the same
    std::vector<int> row_from_, row_to_; // lit pixels of a row: columns [from, to)
    std::vector<size_t> row_offset_;     // of a row in rays_
    std::vector<float> blur_;            // half kernel: weights of 0, 1, 2, ... pixels
    std::vector<uint8_t> response_;      // linear grey times RESPONSE_STEPS to the encoded grey
    std::unique_ptr<Buffers> buffers_;
    std::mutex rendering_;
};

} // namespace pipefish::sim
