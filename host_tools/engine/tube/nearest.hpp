// Nearest neighbours among the columns of a matrix, by a k-d tree.
#pragma once

#include <Eigen/Core>

#include <nanoflann.hpp>

#include <algorithm>
#include <vector>

namespace pipefish::tube
{

template <int Dimension> class Nearest
{
public:
    using Points = Eigen::Matrix<double, Dimension, Eigen::Dynamic>;
    using Point = Eigen::Matrix<double, Dimension, 1>;

    // Borrows the points.
    explicit Nearest(const Points &points) : points_{points}, tree_(Dimension, points_, {16}) {}

    // Of at most k nearest columns, nearest first.
    std::vector<int> nearest(const Point &x, int k) const
    {
        std::vector<size_t> index(static_cast<size_t>(k));
        std::vector<double> squared(static_cast<size_t>(k));
        const size_t found = tree_.knnSearch(x.data(), index.size(), index.data(), squared.data());
        return {index.begin(), index.begin() + static_cast<std::ptrdiff_t>(found)};
    }

    // Columns within the radius, ascending.
    std::vector<int> within(const Point &x, double radius) const
    {
        std::vector<std::pair<size_t, double>> found;
        nanoflann::SearchParams unsorted;
        unsorted.sorted = false;
        tree_.radiusSearch(x.data(), radius * radius, found, unsorted);
        std::vector<int> out;
        out.reserve(found.size());
        for (const auto &f : found) {
            out.push_back(static_cast<int>(f.first));
        }
        std::sort(out.begin(), out.end());
        return out;
    }

private:
    struct Columns {
        const Points &points;
        size_t kdtree_get_point_count() const { return static_cast<size_t>(points.cols()); }
        double kdtree_get_pt(size_t i, size_t d) const
        {
            return points(static_cast<Eigen::Index>(d), static_cast<Eigen::Index>(i));
        }
        template <class Box> bool kdtree_get_bbox(Box &) const { return false; }
    };
    Columns points_;
    nanoflann::KDTreeSingleIndexAdaptor<nanoflann::L2_Simple_Adaptor<double, Columns>, Columns, Dimension, size_t>
        tree_;
};

} // namespace pipefish::tube
