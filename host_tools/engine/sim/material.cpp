#include "sim/material.hpp"

#include "sim/brick.hpp"

namespace pipefish::sim
{

namespace
{

constexpr double PI = std::numbers::pi;
constexpr float JOINT_DARKNESS = 0.75f; // share of the albedo lost in it

// One layer of smooth noise: cells of along x around metres, amplitude relative to the mean albedo or in metres of
// height. The finest ones fall away where the texels cannot carry them.
struct Noise {
    double along, around, amplitude;
};

// Scattered ellipses: at most one a cell.
struct Grains {
    double cell, smallest, largest; // metres: cell size, semi-axes
    double share;                   // of cells that hold one
    double dark, bright;            // relative albedo is drawn between the two
    double dome;                    // height over the smaller semi-axis; negative: a pit
};

// Streams of the layers: kept apart so that a change of one leaves the others as they are.
enum Part : uint64_t {
    PART_ALBEDO = STREAM_SURFACE,
    PART_HEIGHT = STREAM_SURFACE + 20,
    PART_GRAINS = STREAM_SURFACE + 40,
    PART_STROKES = STREAM_SURFACE + 60,
    PART_WET = STREAM_SURFACE + 80,
    PART_DIRT = STREAM_SURFACE + 90,
    PART_JOINT = STREAM_SURFACE + 100,
    PART_WEAR = STREAM_SURFACE + 110,
};

class Painter
{
public:
    Painter(const TextureSpec &spec, const Canvas &canvas, WallPaint &out)
        : spec_(spec), canvas_(canvas), out_(out), wear_(0.23, 0.23, canvas.radius, spec.seed, PART_WEAR)
    {
        for (int j = 0; j < canvas.columns; j++) {
            down_.push_back(static_cast<float>(-std::cos(2.0 * PI * canvas.turn(j))));
        }
    }

    void concrete();
    void brick();
    void clay();
    void pvc();
    void lined();

private:
    const TextureSpec &spec_;
    const Canvas &canvas_;
    WallPaint &out_; // while painting, albedo is relative: 0 = the mean
    Lattice wear_;
    std::vector<float> down_; // of the columns: how far towards the invert, 1 there, -1 at the crown

    template <size_t N> void noises(const Noise (&list)[N], uint64_t stream, Layer &layer, double scale = 1.0)
    {
        for (const Noise &n : list) {
            add_noise({n.along, n.around, canvas_.radius, spec_.seed, stream++},
                      static_cast<float>(scale * n.amplitude), canvas_, layer);
        }
    }

    template <size_t N> void grains(const Grains (&list)[N], double density)
    {
        uint64_t stream = PART_GRAINS;
        for (const Grains &g : list) {
            grains_of(g, stream++, density);
        }
    }

    void grains_of(const Grains &g, uint64_t stream, double density);
    Layer strokes(const Strokes &kind, uint64_t part) const;
    template <typename Apply> void each(const Layer &mask, const Apply &apply)
    {
        for (size_t i = 0; i < mask.size(); i++) {
            if (mask[i] > 0.0f) {
                apply(i, mask[i]);
            }
        }
    }
    void erode();
    void streaks(double strength);
    void film(float albedo, float alpha, double amount, double patch);
    void wet(float darken, float alpha);
    void drops();
    void bundles();
    void swarms();
};

void Painter::grains_of(const Grains &g, uint64_t stream, double density)
{
    const Lattice lattice(g.cell, g.cell, canvas_.radius, spec_.seed, stream);
    scatter(lattice, canvas_, g.largest + 2.0 * canvas_.texel, [&](double s, double across, Draws &draws) {
        const double chance = draws(), size = draws(), shape = draws(), turn = PI * draws(), tone = draws();
        if (chance >= 1.8 * g.share * density) { // 1.8: the most that wear adds
            return;
        }
        const double wear = 1.0 + 0.8 * static_cast<double>(wear_.at(s, across / canvas_.around()));
        if (chance >= g.share * density * wear) {
            return;
        }
        const double a = g.smallest + (g.largest - g.smallest) * size * size, b = a * (0.55 + 0.45 * shape);
        const float value = static_cast<float>(g.dark + (g.bright - g.dark) * tone);
        const float dome = static_cast<float>(g.dome * b);
        draw({s, across, a, b, std::cos(turn), std::sin(turn)}, canvas_, [&](size_t i, float cover, float q) {
            out_.albedo[i] += cover * (value - 0.5f * out_.albedo[i]);
            out_.height[i] += cover * dome * std::max(1.0f - q * q, -0.2f);
        });
    });
}

Layer Painter::strokes(const Strokes &kind, uint64_t part) const
{
    Layer mask(canvas_.size(), 0.0f);
    add_strokes(kind, spec_.seed, PART_STROKES + part, canvas_, mask);
    return mask;
}

// Where the matrix is washed out stones stand free: darker, rougher ground, round stones in it.
void Painter::erode()
{
    Layer loss(canvas_.size(), 0.0f);
    constexpr Noise EDGE[] = {{0.19, 0.19, 0.55}, {0.06, 0.06, 0.35}, {0.017, 0.017, 0.22}};
    noises(EDGE, PART_WEAR + 1, loss);
    const Lattice cells(0.0115, 0.0115, canvas_.radius, spec_.seed, PART_WEAR + 5);
    const size_t columns = static_cast<size_t>(canvas_.columns);
    const float level = static_cast<float>(1.0 - 1.5 * spec_.wear);
    for (size_t i = 0; i < loss.size(); i++) {
        loss[i] = smooth(level, level + 0.35f, loss[i] + 0.45f * down_[i % columns]);
        out_.albedo[i] -= 0.22f * loss[i];
        out_.height[i] -= 2.5e-4f * loss[i];
        out_.alpha[i] += 0.15f * loss[i];
    }
    scatter(cells, canvas_, 0.008, [&](double s, double across, Draws &draws) {
        const double size = draws(), shape = draws(), turn = PI * draws();
        const float tone = static_cast<float>(draws.within(-0.3, 0.42));
        const double a = 0.0025 + 0.0035 * size, b = a * (0.6 + 0.4 * shape);
        draw({s, across, a, b, std::cos(turn), std::sin(turn)}, canvas_, [&](size_t i, float cover, float q) {
            const float c = cover * loss[i];
            out_.albedo[i] += c * (tone - 0.5f * out_.albedo[i]);
            out_.height[i] += c * 4e-4f * (1.0f - 0.8f * q * q);
            out_.alpha[i] -= 0.25f * c;
        });
    });
}

// What water carried down the wall: narrow along the pipe, long around it; rust and lime.
void Painter::streaks(double strength)
{
    Layer streak(canvas_.size(), 0.0f);
    constexpr Noise LIST[] = {{0.035, 0.30, 0.6}, {0.011, 0.16, 0.5}, {0.13, 0.13, 0.5}};
    noises(LIST, PART_DIRT, streak);
    const float k = static_cast<float>(strength);
    for (size_t i = 0; i < streak.size(); i++) {
        out_.albedo[i] -= k * smooth(0.25f, 0.9f, streak[i]);
        out_.albedo[i] += 0.7f * k * smooth(0.45f, 1.0f, -streak[i]);
    }
}

// A film of scale or slime with soft and hard edges, thicker towards the invert: of its own relative albedo and alpha.
void Painter::film(float albedo, float alpha, double amount, double patch)
{
    Layer cover(canvas_.size(), 0.0f);
    const Noise list[] = {
        {2.5 * patch, patch, 0.5}, {0.4 * patch, 0.4 * patch, 0.3}, {0.08 * patch, 0.08 * patch, 0.2}};
    noises(list, PART_DIRT + 4, cover);
    const size_t columns = static_cast<size_t>(canvas_.columns);
    const float level = static_cast<float>(1.25 - 1.6 * amount);
    for (size_t i = 0; i < cover.size(); i++) {
        const float there = cover[i] + 0.6f * down_[i % columns];
        const float c = smooth(level, level + 0.5f, there);
        out_.albedo[i] += c * (albedo - 0.7f * out_.albedo[i]);
        out_.alpha[i] += c * (alpha - out_.alpha[i]);
        out_.height[i] += c * 2e-5f * cover[i];
    }
}

// A film of water: fills the relief, shines, and darkens what it soaks.
void Painter::wet(float darken, float alpha)
{
    if (spec_.wetness <= 0.0) {
        return;
    }
    Layer level(canvas_.size(), 0.0f);
    constexpr Noise LIST[] = {{0.5, 0.25, 0.35}, {0.12, 0.08, 0.22}, {0.03, 0.025, 0.10}};
    noises(LIST, PART_WET, level);
    Layer waves(canvas_.size(), 0.0f); // of the film's own surface
    constexpr Noise WAVES[] = {{0.011, 0.011, 4e-4}, {0.0045, 0.0045, 2e-4}};
    noises(WAVES, PART_WET + 8, waves);
    const size_t columns = static_cast<size_t>(canvas_.columns);
    const float dry = static_cast<float>(std::cos(PI * spec_.wetness)); // the share of the circumference below it
    for (size_t i = 0; i < level.size(); i++) {
        const float w = smooth(dry - 0.06f, dry + 0.10f, level[i] + down_[i % columns]);
        out_.albedo[i] = (1.0f + out_.albedo[i]) * (1.0f - darken * w) - 1.0f;
        out_.alpha[i] += w * (alpha - out_.alpha[i]);
        out_.height[i] = out_.height[i] * (1.0f - 0.6f * w) + w * waves[i];
    }
}

// Beads of water.
void Painter::drops()
{
    const Lattice cells(0.013, 0.013, canvas_.radius, spec_.seed, PART_WET + 6);
    scatter(cells, canvas_, 0.006, [&](double s, double across, Draws &draws) {
        if (draws() >= 0.5 * spec_.wetness) {
            return;
        }
        const double a = 0.0006 + 0.0026 * std::pow(draws(), 3.0), b = a * draws.within(0.75, 1.0);
        draw({s, across, b, a, 1.0, 0.0}, canvas_, [&](size_t i, float cover, float q) {
            out_.height[i] += cover * static_cast<float>(0.45 * b) * (1.0f - q * q);
            out_.alpha[i] += cover * (0.04f - out_.alpha[i]);
            out_.albedo[i] -= 0.06f * cover;
        });
    });
}

void Painter::concrete()
{
    constexpr Noise TONE[] = {{0.410, 0.410, 0.13},   {0.170, 0.170, 0.10},   {0.063, 0.063, 0.08},
                              {0.024, 0.024, 0.08},   {0.0087, 0.0087, 0.09}, {0.0034, 0.0034, 0.12},
                              {0.0015, 0.0015, 0.12}, {0.006, 0.35, 0.05}}; // the last: marks of the mould, around
    constexpr Noise RELIEF[] = {{0.024, 0.024, 4.0e-4},
                                {0.0087, 0.0087, 2.4e-4},
                                {0.0034, 0.0034, 1.4e-4},
                                {0.0015, 0.0015, 0.7e-4},
                                {0.006, 0.35, 0.8e-4}};
    constexpr Grains LIST[] = {
        {0.021, 0.0025, 0.0065, 0.28, -0.22, 0.26, 0.06},   // coarse aggregate
        {0.0085, 0.0010, 0.0030, 0.50, -0.34, 0.36, 0.10},  // fine aggregate
        {0.0060, 0.0004, 0.0011, 0.35, -0.55, -0.2, -0.5},  // pores
        {0.047, 0.0012, 0.0045, 0.35, -0.60, -0.30, -0.35}, // bug holes
    };
    noises(TONE, PART_ALBEDO, out_.albedo);
    noises(RELIEF, PART_HEIGHT, out_.height);
    grains(LIST, 1.0);
    streaks(0.35 * spec_.dirt);
    erode();
    const Layer cracks = strokes({0.16, 0.11, 0.7 * spec_.wear, 30, 0.006, 0.0, PI, 0.55, 0.00008, 0.0003}, 0);
    each(cracks, [&](size_t i, float m) {
        out_.albedo[i] -= 0.75f * m;
        out_.height[i] -= 2e-4f * m;
    });
    // The mould's seam: a ridge along the pipe.
    const Layer seam =
        strokes({0.31, 2.0 * PI * canvas_.radius / 3.0, 0.3, 25, 0.03, 0.0, 0.0, 0.002, 0.0008, 0.0015}, 1);
    each(seam, [&](size_t i, float m) {
        out_.albedo[i] += 0.10f * m;
        out_.height[i] += 2e-4f * m;
    });
    wet(0.35f, 0.14f);
}

void Painter::brick()
{
    paint_bricks(spec_, canvas_, out_);
    constexpr Noise TONE[] = {
        {0.30, 0.30, 0.10}, {0.05, 0.05, 0.08}, {0.011, 0.011, 0.08}, {0.0042, 0.0042, 0.10}, {0.0019, 0.0019, 0.09}};
    constexpr Noise RELIEF[] = {
        {0.02, 0.02, 3e-4}, {0.008, 0.008, 1.8e-4}, {0.0035, 0.0035, 0.9e-4}, {0.0016, 0.0016, 0.4e-4}};
    constexpr Grains LIST[] = {
        {0.009, 0.0006, 0.0025, 0.35, -0.45, 0.25, -0.25}, // burnt specks and pits
        {0.035, 0.0020, 0.0060, 0.30, -0.40, 0.05, -0.15}, // spalls
    };
    noises(TONE, PART_ALBEDO, out_.albedo);
    noises(RELIEF, PART_HEIGHT, out_.height);
    grains(LIST, 0.6 + spec_.wear);
    streaks(0.5 * spec_.dirt);
    const Layer cracks = strokes({0.3, 0.2, 0.6 * spec_.wear, 30, 0.008, 0.0, PI, 0.5, 0.0001, 0.0004}, 0);
    each(cracks, [&](size_t i, float m) {
        out_.albedo[i] -= 0.7f * m;
        out_.height[i] -= 3e-4f * m;
    });
    wet(0.35f, 0.15f);
}

void Painter::clay()
{
    constexpr Noise TONE[] = {{0.5, 0.3, 0.16}, {0.12, 0.07, 0.10}, {0.03, 0.012, 0.05}, {0.0022, 0.0022, 0.025}};
    // The skin of the glaze, like an orange's; wavy along the drawing of the pipe.
    constexpr Noise RELIEF[] = {{0.05, 0.02, 2.5e-4}, {0.012, 0.009, 4e-5}, {0.0055, 0.0055, 1.0e-5}};
    constexpr Grains LIST[] = {
        {0.030, 0.0004, 0.0013, 0.30, -0.7, -0.3, 0.0}, // iron specks
        {0.055, 0.0006, 0.0018, 0.25, 0.2, 0.8, 0.12},  // blisters
    };
    noises(TONE, PART_ALBEDO, out_.albedo);
    noises(RELIEF, PART_HEIGHT, out_.height);
    grains(LIST, 1.0);
    const Layer crazing = strokes({0.016, 0.016, 0.8 * spec_.wear, 12, 0.003, 0.0, PI, 0.35, 0.00002, 0.00006}, 0);
    each(crazing, [&](size_t i, float m) {
        out_.albedo[i] -= 0.8f * m;
        out_.alpha[i] += 0.15f * m;
    });
    const Layer chips = strokes({0.35, 0.3, 0.5 * spec_.wear, 3, 0.004, 0.0, PI, 1.0, 0.0006, 0.0025}, 1);
    each(chips, [&](size_t i, float m) {
        out_.albedo[i] += 0.7f * m;
        out_.alpha[i] += 0.5f * m;
        out_.height[i] -= 2e-4f * m;
    });
    film(-0.15f, 0.45f, 0.8 * spec_.dirt, 0.12);
    wet(0.05f, 0.07f);
    drops();
}

// Bundles of fine parallel scratches, and specks in swarms: what a passing hose or a nozzle leaves.
void Painter::bundles()
{
    const Lattice cells(0.10, 0.07, canvas_.radius, spec_.seed, PART_STROKES + 10);
    scatter(cells, canvas_, 0.09, [&](double s, double across, Draws &draws) {
        if (draws() >= 0.7 * spec_.wear) {
            return;
        }
        const int lines = 5 + static_cast<int>(14.0 * draws());
        const double length = draws.within(0.006, 0.022), heading = draws.within(-0.12, 0.12),
                     gap = draws.within(0.0008, 0.0022);
        const float tone = static_cast<float>(draws() < 0.6 ? draws.within(-0.35, -0.15) : draws.within(0.15, 0.4));
        for (int k = 0; k < lines; k++) {
            const double at = across + gap * (k + draws.within(-0.4, 0.4)),
                         from = s + 0.4 * length * draws.within(-1.0, 1.0);
            const double half = length * draws.within(0.4, 1.0), width = draws.within(0.00006, 0.0002);
            const float strength = static_cast<float>(std::min(1.0, 2.0 * width / canvas_.texel));
            draw({from, at, half, width, std::cos(heading), std::sin(heading)}, canvas_,
                 [&](size_t i, float cover, float) {
                     out_.albedo[i] += strength * cover * tone;
                     out_.alpha[i] += 0.25f * strength * cover;
                     out_.height[i] -= 2e-5f * strength * cover;
                 });
        }
    });
}

void Painter::swarms()
{
    const Lattice cells(0.13, 0.11, canvas_.radius, spec_.seed, PART_GRAINS + 12);
    scatter(cells, canvas_, 0.035, [&](double s, double across, Draws &draws) {
        if (draws() >= 0.9 * spec_.dirt) {
            return;
        }
        const int specks = 4 + static_cast<int>(18.0 * draws());
        const double spread = draws.within(0.006, 0.018);
        for (int k = 0; k < specks; k++) {
            const double away = spread * draws(), angle = 2.0 * PI * draws(), a = draws.within(0.0002, 0.0008);
            const float tone = static_cast<float>(draws.within(-0.8, -0.4));
            draw({s + 1.6 * away * std::cos(angle), across + away * std::sin(angle), a, a * draws.within(0.6, 1.0), 1.0,
                  0.0},
                 canvas_, [&](size_t i, float cover, float) { out_.albedo[i] += cover * (tone - out_.albedo[i]); });
        }
    });
}

void Painter::pvc()
{
    // Extrusion: lines along the pipe; rings of the calibration sleeve and of its starts and stops around it.
    constexpr Noise TONE[] = {{0.8, 0.4, 0.05},   {1.5, 0.006, 0.012}, {0.9, 0.0021, 0.010}, {0.055, 0.9, 0.07},
                              {0.018, 0.6, 0.04}, {0.006, 0.5, 0.025}, {0.0025, 0.7, 0.02},  {0.10, 0.06, 0.03}};
    constexpr Noise RELIEF[] = {{0.30, 0.08, 3e-4},   {1.2, 0.006, 1.0e-5}, {0.7, 0.0021, 0.5e-5},
                                {0.022, 0.7, 1.2e-4}, {0.010, 0.5, 2.5e-5}, {0.0035, 0.7, 0.8e-5}};
    noises(TONE, PART_ALBEDO, out_.albedo);
    noises(RELIEF, PART_HEIGHT, out_.height);
    constexpr Grains SPECKS[] = {{0.034, 0.0003, 0.0011, 0.30, -0.8, -0.3, 0.1}};
    grains(SPECKS, 0.2 + 1.6 * spec_.dirt);
    swarms();
    bundles();
    // Rings: edges of the sleeve's marks, thin.
    each(strokes({0.14, 0.30, 0.6, 40, 0.012, 0.5 * PI, 0.01, 0.004, 0.00015, 0.0005}, 2), [&](size_t i, float m) {
        out_.albedo[i] += 0.16f * m;
        out_.height[i] -= 6e-5f * m;
    });
    each(strokes({0.11, 0.035, 0.8 * spec_.wear, 12, 0.012, 0.0, 0.06, 0.02, 0.00003, 0.00015}, 0),
         [&](size_t i, float m) {
             out_.albedo[i] += 0.3f * m;
             out_.alpha[i] += 0.3f * m;
             out_.height[i] -= 3e-5f * m;
         });
    each(strokes({0.30, 0.14, 0.9 * spec_.wear, 14, 0.014, 0.0, 0.5, 0.06, 0.0002, 0.0006}, 1), [&](size_t i, float m) {
        out_.albedo[i] -= 0.40f * m;
        out_.alpha[i] += 0.3f * m;
        out_.height[i] -= 1.2e-4f * m;
    });
    // Smears of dirt along the flow.
    each(strokes({0.16, 0.10, spec_.dirt, 9, 0.010, 0.0, 0.2, 0.12, 0.0008, 0.0040}, 3), [&](size_t i, float m) {
        out_.albedo[i] -= 0.35f * m;
        out_.alpha[i] += 0.25f * m;
    });
    film(-0.18f, 0.40f, 0.8 * spec_.dirt, 0.20);
    wet(0.02f, 0.06f);
    drops();
}

void Painter::lined()
{
    // Felt under resin: two sets of threads across each other, fine and irregular.
    constexpr Noise TONE[] = {{0.35, 0.25, 0.12},    {0.07, 0.05, 0.07},     {0.006, 0.0016, 0.06},
                              {0.0016, 0.006, 0.06}, {0.0022, 0.0022, 0.05}, {0.02, 0.014, 0.05}};
    constexpr Noise RELIEF[] = {
        {0.09, 0.05, 5e-4}, {0.007, 0.0018, 2.0e-5}, {0.0018, 0.007, 2.0e-5}, {0.014, 0.010, 6e-5}};
    constexpr Grains LIST[] = {
        {0.045, 0.0010, 0.0040, 0.35, -0.30, -0.10, -0.06}, // dry spots
        {0.060, 0.0006, 0.0020, 0.30, 0.15, 0.40, 0.15},    // drops of resin
    };
    noises(TONE, PART_ALBEDO, out_.albedo);
    noises(RELIEF, PART_HEIGHT, out_.height);
    grains(LIST, 1.0);
    Layer resin(canvas_.size(), 0.0f);
    constexpr Noise POOLS[] = {{0.11, 0.06, 0.7}, {0.03, 0.02, 0.3}};
    noises(POOLS, PART_DIRT + 8, resin);
    each(resin, [&](size_t i, float m) { out_.alpha[i] += 0.16f * smooth(0.1f, 0.6f, m); });
    const Layer folds = strokes({0.45, 0.16, 0.8, 22, 0.025, 0.0, 0.15, 0.10, 0.0025, 0.008}, 0);
    each(folds, [&](size_t i, float m) {
        out_.albedo[i] -= 0.10f * m;
        out_.height[i] += 1e-3f * m;
    });
    const Layer wrinkles = strokes({0.25, 0.15, 0.5, 10, 0.010, 0.5 * PI, 0.3, 0.2, 0.0012, 0.0035}, 1);
    each(wrinkles, [&](size_t i, float m) { out_.height[i] += 5e-4f * m; });
    const Layer scratches = strokes({0.2, 0.08, 0.5 * spec_.wear, 10, 0.01, 0.0, 0.2, 0.05, 0.0001, 0.0003}, 2);
    each(scratches, [&](size_t i, float m) {
        out_.albedo[i] += 0.25f * m;
        out_.alpha[i] += 0.3f * m;
    });
    film(-0.25f, 0.45f, 0.8 * spec_.dirt, 0.15);
    wet(0.08f, 0.08f);
}

void dark_rings(const TextureSpec &spec, const Canvas &canvas, WallPaint &out)
{
    const double first = std::abs(std::remainder(canvas.s(0), spec.joint_spacing));
    const double last = std::abs(std::remainder(canvas.s(canvas.rows - 1), spec.joint_spacing));
    if (std::min(first, last) > canvas.rows * canvas.texel + 0.02) {
        return;
    }
    const double half = static_cast<double>(wall_look(spec).joint_half);
    Layer ragged(canvas.size(), 0.0f);
    add_noise({0.02, 0.02, canvas.radius, spec.seed, PART_JOINT}, 0.0012f, canvas, ragged);
    add_noise({0.005, 0.005, canvas.radius, spec.seed, PART_JOINT + 1}, 0.0006f, canvas, ragged);
    const size_t columns = static_cast<size_t>(canvas.columns);
    for (int row = 0; row < canvas.rows; row++) {
        const double off = std::abs(std::remainder(canvas.s(row), spec.joint_spacing)) - half;
        const size_t line = static_cast<size_t>(row) * columns;
        for (size_t i = line; off <= 0.01 && i < line + columns; i++) {
            const double edge = (off - static_cast<double>(ragged[i])) / (1.5 * canvas.texel);
            const float cover = static_cast<float>(std::clamp(0.5 - edge, 0.0, 1.0));
            out.albedo[i] *= 1.0f - JOINT_DARKNESS * cover;
            out.alpha[i] += cover * (0.8f - out.alpha[i]);
        }
    }
}

} // namespace

WallLook wall_look(const TextureSpec &spec)
{
    constexpr WallLook LOOKS[] = {
        {0.45f, 0.55f, 0.8f, 0.004f},  // concrete
        {0.28f, 0.60f, 0.8f, 0.004f},  // brick
        {0.22f, 0.13f, 1.1f, 0.004f},  // clay
        {0.55f, 0.17f, 1.1f, 0.0013f}, // PVC
        {0.48f, 0.16f, 1.1f, 0.0010f}, // lined
    };
    WallLook look = LOOKS[static_cast<int>(spec.material)];
    if (spec.contrast <= 0.0) {
        look.albedo = 0.45f;
    }
    if (spec.roughness > 0.0) {
        look.alpha = static_cast<float>(spec.roughness);
    }
    return look;
}

WallPaint paint_wall(const TextureSpec &spec, const Canvas &canvas)
{
    WallPaint out(canvas.size());
    const WallLook look = wall_look(spec);
    std::fill(out.alpha.begin(), out.alpha.end(), look.alpha);
    if (spec.contrast > 0.0) {
        Painter painter(spec, canvas, out);
        switch (spec.material) {
        case WallMaterial::CONCRETE:
            painter.concrete();
            break;
        case WallMaterial::BRICK:
            painter.brick();
            break;
        case WallMaterial::CLAY:
            painter.clay();
            break;
        case WallMaterial::PVC:
            painter.pvc();
            break;
        case WallMaterial::LINED:
            painter.lined();
            break;
        }
    }
    const float contrast = static_cast<float>(spec.contrast), relief = static_cast<float>(spec.relief * spec.contrast);
    for (size_t i = 0; i < canvas.size(); i++) {
        out.albedo[i] = look.albedo * (1.0f + contrast * out.albedo[i]);
        out.height[i] *= relief;
    }
    if (spec.roughness > 0.0) {
        std::fill(out.alpha.begin(), out.alpha.end(), look.alpha);
    }
    if (spec.joint_spacing > 0.0) {
        dark_rings(spec, canvas, out);
    }
    return out;
}

} // namespace pipefish::sim
