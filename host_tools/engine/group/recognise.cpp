#include "group/recognise.hpp"

#include "match/seeds.hpp"

#include <Eigen/LU>
#include <opencv2/imgproc.hpp>

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace pipefish::group
{

namespace
{

constexpr int kMargin = 24;        // pixels kept around a mask, so that windows and descriptors fit
constexpr double kTexture = 0.01;  // as match::Options
constexpr double kLeastArea = 100; // pixels of a model
constexpr double kBeyond = 1.25;   // radii of the object's circle: its map is known where it was matched only

// What is outside the mask becomes a smooth continuation of what is inside: the mask's edge is no edge then, and no
// background is learned.
match::Image continued(const match::Image &image, const Mask &mask)
{
    cv::Mat1f weight, value, w, v;
    Mask inner;
    cv::erode(mask, inner, cv::getStructuringElement(cv::MORPH_RECT, {3, 3})); // pixels of the edge are mixed
    if (cv::countNonZero(inner) == 0)
        inner = mask;
    inner.convertTo(weight, CV_32F, 1 / 255.0);
    value = image.mul(weight);
    match::Image out(image.size(), static_cast<float>(cv::sum(value)[0] / cv::sum(weight)[0]));
    for (double sigma = 32; sigma >= 1; sigma /= 2) {
        cv::GaussianBlur(weight, w, {}, sigma);
        cv::GaussianBlur(value, v, {}, sigma);
        for (int y = 0; y < out.rows; y++)
            for (int x = 0; x < out.cols; x++) {
                const float share = std::min(1.0F, 4 * w(y, x));
                out(y, x) += share * (v(y, x) / std::max(w(y, x), 1e-6F) - out(y, x));
            }
    }
    image.copyTo(out, inner);
    return out;
}

std::vector<match::Match> on_mask(std::vector<match::Match> matches, const Mask &mask)
{
    std::erase_if(matches, [&](const match::Match &m) { return mask(m.y, m.x) == 0; });
    return matches;
}

// Sums for the affine map, of homogeneous points, that fits matches best.
struct Fit {
    Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
    Eigen::Matrix<double, 2, 3> right = Eigen::Matrix<double, 2, 3>::Zero();

    void add(const match::Match &m)
    {
        const Eigen::Vector3d one(m.x, m.y, 1);
        normal += one * one.transpose();
        right += m.centre.cast<double>() * one.transpose();
    }
    void add(const Fit &other)
    {
        normal += other.normal;
        right += other.right;
    }
    // A group has triangles: its points are not in one line.
    Eigen::Matrix<double, 2, 3> map() const { return right * normal.inverse(); }
};

struct Candidate {
    Segment segment;
    Mask scene;
    Fit fit;
};

double median_area_change(const std::vector<match::Match> &matches, const Groups &groups, int group)
{
    std::vector<double> det;
    for (size_t k = 0; k < matches.size(); k++)
        if (groups.label[k] == group)
            det.push_back(std::abs(static_cast<double>(matches[k].a.determinant())));
    std::nth_element(det.begin(), det.begin() + static_cast<std::ptrdiff_t>(det.size() / 2), det.end());
    return det[det.size() / 2];
}

std::vector<std::vector<cv::Point2d>> extent(const Eigen::Matrix<double, 2, 3> &map, const Prepared &model,
                                             const Prepared &scene)
{
    std::vector<std::vector<cv::Point2d>> out;
    for (const Outline &line : outlines(model.mask())) {
        std::vector<cv::Point2d> &moved = out.emplace_back();
        for (const cv::Point &p : line) {
            const Eigen::Vector2d q = map * Eigen::Vector3d(p.x, p.y, 1);
            moved.push_back(scene.in_picture({q.x(), q.y()}));
        }
    }
    return out;
}

std::vector<std::vector<cv::Point2d>> in_picture(const std::vector<Outline> &lines, const Prepared &picture)
{
    std::vector<std::vector<cv::Point2d>> out;
    for (const Outline &line : lines) {
        std::vector<cv::Point2d> &moved = out.emplace_back();
        for (const cv::Point &p : line)
            moved.push_back(picture.in_picture(p));
    }
    return out;
}

// The circle around the model's outline, carried over by a segment's map: by its larger scale, since the smaller one is
// foreshortened. A rigid object's parts are in it whichever way it is turned.
Place place_of(const Eigen::Matrix<double, 2, 3> &map, const Prepared &model, const Prepared &scene)
{
    std::vector<cv::Point2f> points;
    for (const Outline &line : outlines(model.mask()))
        points.insert(points.end(), line.begin(), line.end());
    cv::Point2f middle;
    float radius = 0;
    cv::minEnclosingCircle(points, middle, radius);
    const Eigen::Matrix2d a = map.leftCols<2>();
    const double squares = a.squaredNorm(), twice = 2 * std::abs(a.determinant());
    const double larger = 0.5 * (std::sqrt(squares + twice) + std::sqrt(std::max(0.0, squares - twice)));
    const Eigen::Vector2d at = map * Eigen::Vector3d(middle.x, middle.y, 1);
    const cv::Point2d centre(at.x(), at.y()), rim(at.x() + kBeyond * larger * radius, at.y());
    Place out{scene.in_picture(centre), 0};
    out.radius = scene.in_picture(rim).x - out.centre.x;
    return out;
}

Candidate measure(const std::vector<match::Match> &matches, const Groups &groups, int group, const Prepared &model,
                  const Prepared &scene, double reach)
{
    Candidate out;
    const double det = median_area_change(matches, groups, group), scale = std::sqrt(det);
    Mask one = support(matches, groups, group, Side::kFirst, model.mask().size(), reach * std::max(1.0, 1 / scale));
    one &= model.mask();
    out.scene = support(matches, groups, group, Side::kSecond, scene.mask().size(), reach * std::max(1.0, scale));
    out.scene &= scene.mask();
    double matched = 0, correlation = 0;
    for (size_t k = 0; k < matches.size(); k++)
        if (groups.label[k] == group) {
            matched++;
            out.fit.add(matches[k]);
            correlation += std::max(0.0, (static_cast<double>(matches[k].zncc) - 0.5) / 0.5);
        }
    Segment &s = out.segment;
    const double textured = cv::countNonZero(one & model.textured());
    s.matches = static_cast<int>(matched);
    s.area = cv::countNonZero(one) / model.area();
    s.coverage = std::min(1.0, matched / std::max(1.0, textured * std::min(1.0, det)));
    s.correlation = std::min(1.0, correlation / matched);
    s.score = s.area * s.coverage * s.correlation;
    const cv::Moments moments = cv::moments(out.scene, true);
    if (moments.m00 > 0)
        s.centre = scene.in_picture({moments.m10 / moments.m00, moments.m01 / moments.m00});
    s.model = in_picture(outlines(one), model);
    s.scene = in_picture(outlines(out.scene), scene);
    return out;
}

} // namespace

struct Prepared::Cut {
    match::Image image;
    Mask mask;
    cv::Point2d offset;
    double scale = 1;

    Cut(const match::Image &given, const Mask &given_mask, int max_pixels)
    {
        cv::Rect box(0, 0, given.cols, given.rows);
        if (given_mask.empty()) {
            image = given.clone();
            mask = Mask(given.size(), 255);
        } else {
            const cv::Rect object = cv::boundingRect(given_mask);
            if (object.empty())
                throw std::invalid_argument("the mask is empty");
            box &= cv::Rect(object.x - kMargin, object.y - kMargin, object.width + 2 * kMargin,
                            object.height + 2 * kMargin);
            mask = given_mask(box) > 0;
            image = continued(given(box), mask);
        }
        offset = {static_cast<double>(box.x), static_cast<double>(box.y)};
        if (box.area() > max_pixels) {
            scale = std::sqrt(static_cast<double>(max_pixels) / box.area());
            const cv::Size size(std::max(32, static_cast<int>(box.width * scale)),
                                std::max(32, static_cast<int>(box.height * scale)));
            cv::resize(image, image, size, 0, 0, cv::INTER_AREA);
            cv::resize(mask, mask, size, 0, 0, cv::INTER_NEAREST);
            scale = static_cast<double>(size.width) / box.width;
        }
        if (cv::countNonZero(mask) < kLeastArea)
            throw std::invalid_argument("the mask covers too little: the object must have 100 pixels at least");
    }
};

Prepared::Prepared(const match::Image &image, const Mask &mask, int max_pixels, int regions)
    : Prepared(Cut(image, mask, max_pixels), regions)
{
}

Prepared::Prepared(const Cut &cut, int regions)
    : offset_(cut.offset), scale_(cut.scale), mask_(cut.mask),
      textured_(match::textured(cut.image, kTexture) & cut.mask), area_(cv::countNonZero(cut.mask)), stack_(cut.image)
{
    match::RegionOptions options;
    options.most = regions;
    regions_ = match::describe_regions(stack_, options);
}

cv::Point2d Prepared::in_picture(cv::Point2d p) const
{
    return {(p.x + 0.5) / scale_ - 0.5 + offset_.x, (p.y + 0.5) / scale_ - 0.5 + offset_.y};
}

Recognition recognise(const Prepared &model, const Prepared &scene, const RecogniseOptions &options)
{
    Recognition out;
    if (model.regions().regions.empty() || scene.regions().regions.empty())
        return out;
    match::SeedOptions seeding;
    seeding.most = options.seeds;
    const std::vector<match::Seed> seeds = match::match_regions(model.regions(), scene.regions(), seeding);
    const match::Growth growth = match::grow(model.stack(), scene.stack(), seeds, options.growth, nullptr);
    const std::vector<match::Match> matches = on_mask(growth.matches, model.mask());
    out.seeds = static_cast<int>(seeds.size());
    out.matches = static_cast<int>(matches.size());
    const Groups groups = group_matches(matches, options.grouping);
    const std::vector<double> evident = evidence(matches, groups);
    std::vector<Candidate> found, small;
    double most = -1; // evidence
    for (int g = 0; g < groups.count; g++) {
        const double e = evident[static_cast<size_t>(g)];
        const bool large = groups.vertices[static_cast<size_t>(g)] >= options.vertices;
        if (!large && e <= most)
            continue;
        Candidate c = measure(matches, groups, g, model, scene, options.reach);
        c.segment.evidence = e;
        if (large && c.segment.matches >= options.matches * options.vertices && c.segment.score >= options.least) {
            found.push_back(std::move(c));
        } else if (e > most) {
            most = e;
            small.assign(1, std::move(c));
        }
    }
    const auto counting = [&](const Segment &s) {
        return s.score * std::exp(std::min(0.0, s.evidence - options.evidence));
    };
    const bool none =
        std::ranges::none_of(found, [&](const Candidate &c) { return c.segment.evidence >= options.evidence; });
    if (none && !small.empty() && most >= options.evidence)
        found = std::move(small);
    else if (found.empty() && !small.empty())
        out.score = std::min(options.least, counting(small.front().segment));
    std::stable_sort(found.begin(), found.end(),
                     [](const Candidate &a, const Candidate &b) { return a.segment.score > b.segment.score; });
    Mask taken(scene.mask().size(), 0);
    Fit fit;
    for (Candidate &c : found) {
        const int area = cv::countNonZero(c.scene);
        if (2 * cv::countNonZero(c.scene & taken) > area)
            continue;
        if (out.segments.empty())
            out.place = place_of(c.fit.map(), model, scene);
        else if (!out.place.has(c.segment.centre))
            continue;
        taken |= c.scene;
        out.score = std::min(1.0, out.score + counting(c.segment));
        fit.add(c.fit);
        out.segments.push_back(std::move(c.segment));
    }
    if (!out.segments.empty())
        out.extent = extent(fit.map(), model, scene);
    return out;
}

} // namespace pipefish::group
