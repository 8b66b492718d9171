/* The picture that the tracker's benchmarks look at: random dots, box-filtered, magnified by `zoom`, with noise of two
 * grey levels; of radius `radius` about the centre, dark outside, or everywhere if that is 0. */
#ifndef PIPEFISH_TRACK_SCENE_H
#define PIPEFISH_TRACK_SCENE_H

#include <stdint.h>

void track_scene_frame(uint8_t *out, int width, int height, int radius, double zoom, uint32_t seed);

#endif
