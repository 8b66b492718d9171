// What both ways of looking for a match's neighbours share: where a match may be, windows of image 1, and the best of
// 3 x 3 places.
#pragma once

#include "match/image.hpp"
#include "match/vec.hpp"

#include <Eigen/Core>

#include <algorithm>
#include <cstdint>
#include <cstring>

namespace pipefish::match
{

constexpr int kReach = 2;      // new matches within 5 x 5 pixels of their parent
constexpr int kRadiusMost = 7; // of the correlation window

struct Candidate {
    int order; // of the neighbour: breaks ties
    int x, y;
    Eigen::Vector2f centre;
    float zncc;
    bool at_border;
};

// Where a match may be: textured, and without one yet. Bytes: they are all over the cache.
struct Free {
    cv::Mat1b first, second;

    // Which of the 5 pixels from x - 2 on are free, a byte each: most rows around a match are not, at one look. Matches
    // are never nearer to the rim than that.
    uint64_t row(int x, int y) const
    {
        uint64_t bytes = 0;
        std::memcpy(&bytes, first[y] + x - kReach, 2 * kReach + 1);
        return bytes;
    }
};

// A window of image 1, mean removed, rows in whole Float4s that end in zeros: a product with any other window then is
// the sum over the window only.
struct Window {
    int side = 0, vectors = 0;
    alignas(16) float v[(2 * kRadiusMost + 1) * (2 * kRadiusMost + 2)];
    float inverse_sigma = 0;

    // Sum of products with the window at `from` (values next to each other).
    float dot(const float *from, size_t stride) const
    {
        switch (side) {
        case 5:
            return dot_of<5>(from, stride);
        case 7:
            return dot_of<7>(from, stride);
        case 9:
            return dot_of<9>(from, stride);
        case 11:
            return dot_of<11>(from, stride);
        case 13:
            return dot_of<13>(from, stride);
        default:
            return dot_of<15>(from, stride);
        }
    }

    // The same for a side known beforehand: no loops left, and the window stays in registers from one place to the
    // next.
    template <int kSide> float dot_of(const float *from, size_t stride) const
    {
        constexpr int kVectors = (kSide + 3) / 4;
        Float4 sum = {};
        for (int j = 0; j < kSide; j++)
            for (int k = 0; k < kVectors; k++)
                sum += load(v + 4 * (j * kVectors + k)) * load(from + static_cast<size_t>(j) * stride + 4 * k);
        return total(sum);
    }
};

// Correlations at the 3 x 3 places around a prediction: the best, and the maximum near it.
struct Peak {
    float zncc = -1;
    Eigen::Vector2f at = Eigen::Vector2f::Zero();
    bool at_border = false;

    explicit Peak(const float (&z)[3][3])
    {
        int bi = 1, bj = 1;
        zncc = z[1][1];
        for (int j = 0; j < 3; j++)
            for (int i = 0; i < 3; i++)
                if (z[j][i] > zncc)
                    zncc = z[j][i], bi = i, bj = j;
        at_border = bi != 1 || bj != 1;
        at = {static_cast<float>(bi - 1), static_cast<float>(bj - 1)};
        if (bi == 1 && z[bj][0] > -1 && z[bj][2] > -1)
            at.x() = std::clamp(vertex(z[bj][0], z[bj][1], z[bj][2]), -0.5F, 0.5F);
        if (bj == 1 && z[0][bi] > -1 && z[2][bi] > -1)
            at.y() = std::clamp(vertex(z[0][bi], z[1][bi], z[2][bi]), -0.5F, 0.5F);
    }
};

} // namespace pipefish::match
