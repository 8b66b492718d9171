// Drawing sheets: what each pixel's centre sees; from the neighbours, what lies within the pixel; where edges run
// through it, many rays.
#include "sim/studio.hpp"
#include "parallel.hpp"

#include "sim/random.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace pipefish::sim
{

Picture::Picture(const PictureSpec &spec, std::vector<std::shared_ptr<const Texture>> textures)
    : spec_(spec), textures_(std::move(textures))
{
    for (size_t k = 0; k < spec_.sheets.size(); k++) {
        const std::string where = "sheets[" + std::to_string(k) + "].";
        if (static_cast<size_t>(spec_.sheets[k].texture) >= textures_.size()) {
            throw std::invalid_argument(where + "texture: there are " + std::to_string(textures_.size()));
        }
        try {
            sheets_.emplace_back(spec_.sheets[k]);
        } catch (const std::invalid_argument &error) {
            throw std::invalid_argument(where + error.what());
        }
    }
}

Sighting Picture::look(const Eigen::Vector3d &origin, const Eigen::Vector3d &direction) const
{
    Sighting seen;
    for (size_t k = 0; k < sheets_.size(); k++) {
        SheetHit hit;
        if (sheets_[k].cast(origin, direction, hit) && (seen.sheet < 0 || hit.t < seen.hit.t)) {
            seen = {static_cast<int>(k), hit};
        }
    }
    return seen;
}

double Picture::light(const Sighting &seen) const
{
    const Sheet &sheet = sheets_[static_cast<size_t>(seen.sheet)];
    double light = spec_.ambient;
    if (!spec_.lamps.empty()) {
        Eigen::Vector3d normal;
        const Eigen::Vector3d point = sheet.place(seen.hit.a, seen.hit.b, &normal);
        if (seen.hit.back) {
            normal = -normal;
        }
        for (const PointLamp &lamp : spec_.lamps) {
            const Eigen::Vector3d to = Eigen::Vector3d(lamp.x, lamp.y, lamp.z) - point;
            const double d2 = to.squaredNorm();
            light += lamp.power * std::max(to.dot(normal), 0.0) / (d2 * std::sqrt(d2));
        }
    }
    return spec_.gain * light * sheet.light(seen.hit.a, seen.hit.b);
}

// What the passes of a picture share.
struct Studio::Draft {
    const Picture &picture;
    int samples, step; // and the lattice's generator
    std::vector<Sighting> centres;
    std::vector<float> image, spare;
};

Studio::Studio(const LensSpec &lens, const SensorSpec &sensor)
    : lens_spec_(lens), sensor_spec_(sensor), lens_(lens),
      film_(lens, lens_.circle_radius(), sensor, ToneSpec{1.0, 1.0})
{
    lens_spec_.theta_max = lens_.theta_max();
    lens_spec_.circle_radius = lens_.circle_radius();
}

bool Studio::ray(double u, double v, Ray &ray) const
{
    double theta = 0.0, phi = 0.0;
    if (!lens_.angles(u - lens_spec_.c_u, v - lens_spec_.c_v, theta, phi)) {
        ray = {0.0, 0.0, 1.0, 0.0, 0.0};
        return false;
    }
    const double s = std::sin(theta), edge = theta / lens_.theta_max(), edge2 = edge * edge;
    ray = {s * std::cos(phi), s * std::sin(phi), std::cos(theta), lens_.pupil(theta),
           1.0 - lens_spec_.vignetting * edge2 * edge2};
    return true;
}

bool Studio::look(const Picture &picture, const double px[2], Sighting &seen, Eigen::Vector3d &point) const
{
    Ray r{};
    if (!ray(px[0], px[1], r)) {
        return false;
    }
    const Eigen::Vector3d origin(0.0, 0.0, r.pupil), direction(r.x, r.y, r.z);
    seen = picture.look(origin, direction);
    point = origin + seen.hit.t * direction;
    return true;
}

bool Studio::project(const Eigen::Vector3d &point, double px[2]) const
{
    double theta = 0.0;
    if (!lens_.theta_of_point(std::hypot(point.x(), point.y()), point.z(), theta)) {
        return false;
    }
    const Lens::Image at = lens_.image(theta, std::atan2(point.y(), point.x()));
    px[0] = lens_spec_.c_u + at.x;
    px[1] = lens_spec_.c_v + at.y;
    return true;
}

double Studio::vignetting(double u, double v) const
{
    Ray r{};
    ray(u, v, r);
    return r.light;
}

void Studio::make_rays(int threads) const
{
    const int width = lens_spec_.width + 2, height = lens_spec_.height + 2;
    rays_.resize(static_cast<size_t>(width) * static_cast<size_t>(height));
    parallel_for(height, threads, [&](int y) {
        for (int x = 0; x < width; x++) {
            ray(x - 1, y - 1, rays_[static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x)]);
        }
    });
}

namespace
{

constexpr double RASTER_SAMPLES = 16.0; // 4 x 4 a pixel

// The lattice of n points with the generator g (n, g neighbouring Fibonacci numbers: the most even one there is, and
// every point has an abscissa and an ordinate of its own), shifted by (shift_x, shift_y); within -1/2 and 1/2.
void lattice_point(int k, int n, int g, double shift_x, double shift_y, double &x, double &y)
{
    x = (k + 0.5) / n + shift_x;
    y = ((k * g) % n + 0.5) / n + shift_y;
    x -= std::floor(x) + 0.5;
    y -= std::floor(y) + 0.5;
}

} // namespace

// Mean of many rays, each from a second-order expansion of the neighbouring pixels' rays (1e-6 px) or, at the field's
// edge, from the lens itself.
double Studio::shade_edges(const Draft &draft, int x, int y) const
{
    const size_t width = static_cast<size_t>(lens_spec_.width) + 2;
    const Ray *const at = rays_.data() + static_cast<size_t>(y + 1) * width + static_cast<size_t>(x + 1);
    const Ray *const stencil[9] = {at - width - 1, at - width,     at - width + 1, at - 1,        at,
                                   at + 1,         at + width - 1, at + width,     at + width + 1};
    const bool smooth = std::all_of(stencil, stencil + 9, [](const Ray *r) { return r->light > 0.0; });
    const uint64_t pixel = static_cast<uint64_t>(y) * width + static_cast<uint64_t>(x);
    const double shift_x = uniform_of(hash64(1, STREAM_STUDIO, pixel, 0)),
                 shift_y = uniform_of(hash64(1, STREAM_STUDIO, pixel, 1));
    const PictureSpec &spec = draft.picture.spec();
    double sum = 0.0;
    for (int k = 0; k < draft.samples; k++) {
        double p = 0.0, q = 0.0;
        lattice_point(k, draft.samples, draft.step, shift_x, shift_y, p, q);
        Ray r{};
        if (smooth) {
            const auto expand = [&](auto part) {
                const double f[9] = {part(*stencil[0]), part(*stencil[1]), part(*stencil[2]),
                                     part(*stencil[3]), part(*stencil[4]), part(*stencil[5]),
                                     part(*stencil[6]), part(*stencil[7]), part(*stencil[8])};
                return f[4] + 0.5 * p * (f[5] - f[3]) + 0.5 * q * (f[7] - f[1]) +
                       0.5 * p * p * (f[5] - 2.0 * f[4] + f[3]) + 0.5 * q * q * (f[7] - 2.0 * f[4] + f[1]) +
                       0.25 * p * q * (f[8] - f[6] - f[2] + f[0]);
            };
            r = {expand([](const Ray &s) { return s.x; }), expand([](const Ray &s) { return s.y; }),
                 expand([](const Ray &s) { return s.z; }), expand([](const Ray &s) { return s.pupil; }), at->light};
        } else if (!ray(x + p, y + q, r)) {
            continue;
        }
        const Sighting seen = draft.picture.look({0.0, 0.0, r.pupil}, {r.x, r.y, r.z});
        if (seen.sheet < 0) {
            sum += r.light * spec.nothing;
            continue;
        }
        const SheetSpec &sheet = draft.picture.sheets()[static_cast<size_t>(seen.sheet)].spec();
        double albedo = sheet.back;
        if (!seen.hit.back) {
            const Texture &texture = draft.picture.texture(seen.sheet);
            const Raster *const raster = std::get_if<Raster>(&texture);
            albedo = raster ? raster->albedo(2.0 * seen.hit.a / sheet.width, 2.0 * seen.hit.b / sheet.height, 1.0)
                            : std::get<Print>(texture).albedo(seen.hit.a, seen.hit.b);
        }
        sum += r.light * draft.picture.light(seen) * albedo;
    }
    return sum / draft.samples;
}

double Studio::shade(const Draft &draft, int x, int y) const
{
    const int width = lens_spec_.width, height = lens_spec_.height;
    const Ray &ray = rays_[static_cast<size_t>(y + 1) * static_cast<size_t>(width + 2) + static_cast<size_t>(x + 1)];
    const auto centre = [&](int i, int j) -> const Sighting & {
        return draft.centres[static_cast<size_t>(std::clamp(j, 0, height - 1) * width + std::clamp(i, 0, width - 1))];
    };
    const auto lit = [&](int i, int j) {
        return rays_[static_cast<size_t>(j + 1) * static_cast<size_t>(width + 2) + static_cast<size_t>(i + 1)].light >
               0.0;
    };
    const Sighting &own = centre(x, y);
    for (int j = y - 1; j <= y + 1; j++) {
        for (int i = x - 1; i <= x + 1; i++) {
            const Sighting &other = centre(i, j);
            if (lit(i, j) != lit(x, y) || other.sheet != own.sheet || other.hit.back != own.hit.back ||
                std::abs(other.hit.t - own.hit.t) > 0.1 * own.hit.t) {
                return shade_edges(draft, x, y);
            }
        }
    }
    const PictureSpec &spec = draft.picture.spec();
    if (own.sheet < 0) {
        return ray.light * spec.nothing;
    }
    const SheetSpec &sheet = draft.picture.sheets()[static_cast<size_t>(own.sheet)].spec();
    const double white = draft.picture.light(own);
    if (own.hit.back) {
        return ray.light * white * sheet.back;
    }
    // How the texture coordinates change from pixel to pixel.
    const SheetHit &left = centre(x - 1, y).hit, &right = centre(x + 1, y).hit;
    const SheetHit &above = centre(x, y - 1).hit, &below = centre(x, y + 1).hit;
    const double wide = x > 0 && x + 1 < width ? 0.5 : 1.0, tall = y > 0 && y + 1 < height ? 0.5 : 1.0;
    const double ax = wide * (right.a - left.a), bx = wide * (right.b - left.b);
    const double ay = tall * (below.a - above.a), by = tall * (below.b - above.b);
    const Texture &texture = draft.picture.texture(own.sheet);
    if (const Print *const print = std::get_if<Print>(&texture)) {
        const double half_a = 0.7 * (std::abs(ax) + std::abs(ay)), half_b = 0.7 * (std::abs(bx) + std::abs(by));
        if (!print->plain(own.hit.a - half_a, own.hit.a + half_a, own.hit.b - half_b, own.hit.b + half_b)) {
            return shade_edges(draft, x, y);
        }
        return ray.light * white * print->albedo(own.hit.a, own.hit.b);
    }
    const Raster &raster = std::get<Raster>(texture);
    const double ku = 2.0 / sheet.width, kv = 2.0 / sheet.height;
    const double texels_x = std::hypot(0.5 * ku * ax * raster.columns(), 0.5 * kv * bx * raster.rows());
    const double texels_y = std::hypot(0.5 * ku * ay * raster.columns(), 0.5 * kv * by * raster.rows());
    const double step = std::max(texels_x, texels_y) / std::sqrt(RASTER_SAMPLES);
    double sum = 0.0;
    for (int k = 0; k < static_cast<int>(RASTER_SAMPLES); k++) {
        const double p = ((k & 3) - 1.5) / 4.0, q = ((k >> 2) - 1.5) / 4.0;
        sum += raster.albedo(ku * (own.hit.a + p * ax + q * ay), kv * (own.hit.b + p * bx + q * by), step);
    }
    return ray.light * white * sum / RASTER_SAMPLES;
}

void Studio::render(const Picture &picture, int samples, int threads, void *out) const
{
    int step = 21, next = 34;
    while (next < samples) {
        next += step;
        step = next - step;
    }
    if (next != samples || samples > 987) {
        throw std::invalid_argument("samples: must be 34, 55, 89, 144, 233, 377, 610 or 987");
    }
    std::call_once(rays_made_, [&] { make_rays(threads); });
    const int width = lens_spec_.width, height = lens_spec_.height;
    const size_t pixels = static_cast<size_t>(width) * static_cast<size_t>(height);
    Draft draft{
        picture, samples, step, std::vector<Sighting>(pixels), std::vector<float>(pixels), std::vector<float>(pixels)};
    parallel_for(height, threads, [&](int y) {
        for (int x = 0; x < width; x++) {
            const Ray &r =
                rays_[static_cast<size_t>(y + 1) * static_cast<size_t>(width + 2) + static_cast<size_t>(x + 1)];
            if (r.light > 0.0) {
                draft.centres[static_cast<size_t>(y * width + x)] = picture.look({0.0, 0.0, r.pupil}, {r.x, r.y, r.z});
            }
        }
    });
    parallel_for(height, threads, [&](int y) {
        for (int x = 0; x < width; x++) {
            draft.image[static_cast<size_t>(y * width + x)] = static_cast<float>(shade(draft, x, y));
        }
    });
    film_.blur(draft.image, draft.spare, threads);
    const double gamma = picture.spec().gamma, bias = picture.spec().bias;
    if (gamma != 1.0 || bias != 0.0) {
        for (float &grey : draft.image) {
            grey = static_cast<float>(255.0 * std::pow(std::max(grey + bias, 0.0) / 255.0, gamma));
        }
    }
    film_.develop(picture.spec().frame, draft.image, threads, out);
}

} // namespace pipefish::sim
