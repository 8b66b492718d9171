// The wall's surface as the renderer reads it: material.hpp's paint, made around the camera as it moves and kept in a
// ring of rows with prefiltered levels, halved along the pipe and around it independently, so that a pixel whose
// footprint is long and thin reads one texel-sized sample of each and distant wall does not alias.
//
// Four channels a texel, all of which may be averaged: albedo, the slopes of the relief along and around, and their
// second moment together with the roughness (alpha^2 + slopes^2). What averaging takes from the slopes it leaves in the
// moment, so that relief too small to be seen turns into roughness (Olano, Baker, LEAN mapping, I3D 2010).
#pragma once

#include "sim/material.hpp"

#include <cstddef>
#include <cstdint>
#include <vector>

namespace pipefish::sim
{

struct Marker { // a white disc on the surface: radius in metres of arc length, and of nominal radius times clock angle
    double s = 0.0, phi = 0.0, radius = 0.0;
};

struct Texel {
    float albedo;               // 0..1
    float alpha2;               // squared GGX roughness, of what is smaller than the footprint
    float slope_s, slope_clock; // of the relief, metres a metre: rise towards the axis along the pipe, and clockwise
};

class Surface
{
public:
    static constexpr int ALONG_LEVELS = 9; // rows halve 8 times: one chunk of rows becomes one row
    static constexpr int AROUND_LEVELS = 6;
    static constexpr int CHUNK = 1 << (ALONG_LEVELS - 1);

    // `around`: texels around the pipe, a power of two, 64..16384; square texels at the nominal radius (metres).
    // `reach`: metres of wall that must fit in the ring at once.
    Surface(const TextureSpec &spec, const std::vector<Marker> &markers, double radius, int around, double reach);

    double texel() const { return texel_; }
    int around() const { return around_; }

    // Makes the rows of [s_from, s_to] available, on `threads` threads; forgets the furthest others.
    void prepare(double s_from, double s_to, int threads);
    // Arc length of row 0 of the coordinates that sample() takes; changes with prepare().
    double base() const { return static_cast<double>(first_chunk_) * CHUNK * texel_; }

    // The surface averaged over a footprint of (width_row, width_column) texels at (row, column): row counts from
    // base(), column from clock 0, texel centres at halves. Outside the prepared rows: the plain wall.
    Texel sample(float row, float column, float width_row, float width_column) const;

private:
    struct Packed {
        uint8_t albedo, spread, slope_s, slope_clock;
    };
    static_assert(sizeof(Packed) == 4);
    size_t slot(int64_t chunk) const { return static_cast<size_t>((chunk % chunks_ + chunks_) % chunks_); }
    void generate(int64_t chunk);
    void pack(int64_t chunk, const WallPaint &paint, Packed *out) const;
    void reduce(int64_t chunk);
    const Packed *level(int around, int along) const
    {
        return levels_[static_cast<size_t>(around * ALONG_LEVELS + along)].data();
    }
    Packed *level(int around, int along) { return levels_[static_cast<size_t>(around * ALONG_LEVELS + along)].data(); }

    TextureSpec spec_;
    WallLook look_;
    std::vector<Marker> markers_;
    double radius_, texel_;
    int around_, chunks_;                       // ring: chunks_ chunks of CHUNK rows
    int64_t first_chunk_ = 0, last_chunk_ = -1; // prepared
    std::vector<std::vector<Packed>> levels_;   // [around][along]: (chunks_ CHUNK >> along) rows of (around_ >> around)
};

} // namespace pipefish::sim
