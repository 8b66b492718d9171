#include "sim/brick.hpp"

namespace pipefish::sim
{

namespace
{

constexpr double LENGTH = 0.225, HEIGHT = 0.075; // of a brick with its joint, metres
constexpr float JOINT = 0.0045f;                 // half its width, metres
constexpr float MORTAR = 0.10f;                  // relative albedo
constexpr uint64_t BRICKS = STREAM_SURFACE + 130;

struct Brick {
    float tone, tilt_s, tilt_x, inset;
};

Brick brick_of(uint64_t seed, int course, int64_t number)
{
    Draws draws(hash64(seed, BRICKS, static_cast<uint64_t>(course), static_cast<uint64_t>(number)));
    const float tone = static_cast<float>(draws.within(-0.30, 0.30) + draws.within(-0.15, 0.15));
    const float tilt_s = static_cast<float>(draws.within(-0.02, 0.02)),
                tilt_x = static_cast<float>(draws.within(-0.06, 0.06));
    return {tone, tilt_s, tilt_x, static_cast<float>(draws.within(0.0, 8e-4))};
}

} // namespace

void paint_bricks(const TextureSpec &spec, const Canvas &canvas, WallPaint &out)
{
    const int courses = 2 * std::max(2, static_cast<int>(std::lround(0.5 * canvas.around() / HEIGHT)));
    const float height = static_cast<float>(canvas.around() / courses);
    Layer edge(canvas.size(), 0.0f); // how far the bricks' edges have gone back
    const double worn = 0.0008 + 0.003 * spec.wear;
    add_noise({0.035, 0.035, canvas.radius, spec.seed, BRICKS + 1}, static_cast<float>(0.5 * worn), canvas, edge);
    add_noise({0.012, 0.012, canvas.radius, spec.seed, BRICKS + 2}, static_cast<float>(0.4 * worn), canvas, edge);
    add_noise({0.004, 0.004, canvas.radius, spec.seed, BRICKS + 3}, static_cast<float>(0.4 * worn), canvas, edge);
    const float depth = static_cast<float>(0.0012 + 0.0018 * spec.wear); // of the mortar under the bricks' faces
    const float round = static_cast<float>(0.0015 + 0.003 * spec.wear);  // of the bricks' edges
    for (int i = 0; i < canvas.rows; i++) {
        int held_course = -1;
        int64_t held_number = 0;
        Brick brick{};
        float along = 0.0f;
        for (int j = 0; j < canvas.columns; j++) {
            const double x = canvas.turn(j) * courses;
            const int course = static_cast<int>(x);
            if (course != held_course) {
                const double jitter = uniform_of(hash64(spec.seed, BRICKS + 4, static_cast<uint64_t>(course)));
                const double y = canvas.s(i) / LENGTH + (course % 2 ? 0.5 : 0.0) + 0.2 * (jitter - 0.5);
                held_number = static_cast<int64_t>(std::floor(y));
                along = static_cast<float>((y - std::floor(y)) * LENGTH);
                brick = brick_of(spec.seed, course, held_number);
                held_course = course;
            }
            const size_t k = static_cast<size_t>(i) * static_cast<size_t>(canvas.columns) + static_cast<size_t>(j);
            const float across = static_cast<float>(x - course) * height;
            const float off = std::min({along, static_cast<float>(LENGTH) - along, across, height - across}) - JOINT -
                              edge[k] - static_cast<float>(0.3 * worn);
            const float face = smooth(-0.0008f, 0.0008f, off);
            const float shoulder = off > 0.0f ? std::exp(-off / round) : 1.0f;
            const float top = -brick.inset - 0.5f * depth * shoulder +
                              brick.tilt_s * (along - 0.5f * static_cast<float>(LENGTH)) +
                              brick.tilt_x * (across - 0.5f * height);
            out.albedo[k] += face * (brick.tone - 0.12f * shoulder) + (1.0f - face) * MORTAR;
            out.height[k] += face * top + (1.0f - face) * -depth;
            out.alpha[k] += (1.0f - face) * 0.2f;
        }
    }
}

} // namespace pipefish::sim
