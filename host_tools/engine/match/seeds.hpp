// Seeds without help: affine-covariant regions of both images matched by their descriptors.
#pragma once

#include "match/grow.hpp"
#include "match/region.hpp"

namespace pipefish::match
{

struct SeedOptions {
    RegionOptions regions;
    double ratio = 0.85; // the best match's distance against the next best that is elsewhere
    int most = 2000;     // best first
};

// Regions that choose each other, with the map between them, best first. Many are wrong: growth sorts that out.
std::vector<Seed> match_regions(const Described &one, const Described &two, const SeedOptions &options);

// The same from the images.
std::vector<Seed> find_seeds(const ScaleStack &first, const ScaleStack &second, const SeedOptions &options);

} // namespace pipefish::match
