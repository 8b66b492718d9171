// Groups of matches that move as one surface: neighbours in a Delaunay triangulation whose places in image 2 agree with
// their affine maps (Kannala, Rahtu, Brandt and Heikkila, CVPR 2008; the inequality is this project's).
#pragma once

#include "group/delaunay.hpp"
#include "match/grow.hpp"

namespace pipefish::group
{

struct Options {
    int cell = 5;          // pixels of image 1 that one vertex stands for, a side
    double edge = 4;       // longest edge, cells
    double absolute = 1;   // how far a neighbour may be from where the map has it: pixels of the coarser image
    double relative = 0.2; // ... and a share of its distance
    double scale = 0.7;    // largest |ln| of a triangle's change of area against its corners' maps
    double pruned = 0.25;  // a vertex with a smaller share of agreeing edges is taken out
    int rounds = 4;        // of taking out
    int least = 60;        // vertices of a group
};

struct Triangle {
    Corners vertex; // indices of matches
    int group = -1;
};

struct Groups {
    int count = 0;                   // largest first, by triangles
    std::vector<int> label;          // of each match: its group or -1
    std::vector<int> vertices;       // of each group, how many
    std::vector<Triangle> triangles; // of groups only; their corners are the matches that stand for their cells
};

// Depends on the matches and their order alone. O(n log n).
Groups group_matches(const std::vector<match::Match> &matches, const Options &options);

// How much better the agreement of each group's neighbours is explained by one surface than by chance: in nats, at
// least 0. What matches by chance passes the test of agreement just so. No likelihood ratio, though of its form: the
// surface's deviation is fitted on the group, and groups are chosen by agreement. From where on it counts is
// calibrated.
std::vector<double> evidence(const std::vector<match::Match> &matches, const Groups &groups);

} // namespace pipefish::group
