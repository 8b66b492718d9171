// The fields of a layer from its matches, and their refinement by what the pictures show.
#pragma once

#include "segment/layer.hpp"

namespace pipefish::segment
{

// A layer from matches (image 1, image 2): fields through them, no change of light.
Layer layer_of(const Picture (&pictures)[2], const std::vector<Tie> &ties, const Options &options);

// What the fields are refined by.
struct Given {
    const LabelImage (&labels)[2];
    int k; // the layer's label
    double ties;
};

// The part of the energy that depends on the layer's fields, labels as they are.
double layer_energy(const Layer &layer, const Given &given, const Options &options);

// Each makes the fields better, or leaves them: the energy never rises. `seen` is kept up to date.
void refine_light(Layer &layer, const Given &given, const Options &options);
void refine_warp(Layer &layer, const Given &given, const Options &options, int steps);
void refine_sigma(Layer &layer, const Given &given, const Options &options);

} // namespace pipefish::segment
