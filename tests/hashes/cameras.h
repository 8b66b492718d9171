/* Cameras for the hashes: every radial function, every kind of term. */
#ifndef PIPEFISH_TESTS_HASHES_CAMERAS_H
#define PIPEFISH_TESTS_HASHES_CAMERAS_H

#include "pipefish/camera.h"

#define SMALL .width = 160, .height = 120, .f_u = 60, .f_v = 60.25, .c_u = 80.5, .c_v = 59.75
#define D_TERMS                                                                                                        \
    .asym_radial_theta = {.015625, .0078125, -.00390625}, .asym_radial_phi = {.5, .5, -.5, .5},                        \
    .asym_tangential_theta = {.0078125, -.00390625, .001953125}, .asym_tangential_phi = {.5, -.5, .5, .5}
#define C_TERMS                                                                                                        \
    .cpoly = {-.00390625, 0, .00390625, -.001953125, .001953125, -.00390625, 0,                                        \
              .00390625,  0, .00390625, -.001953125, .001953125, -.00390625, 0}

static const pf_camera CAMERAS[] = {
    {SMALL, .k2 = -.03125, .k3 = .0078125, .k4 = -.001953125, .theta_max = 1.75, .circle_u = 80, .circle_v = 60,
     .circle_radius = 58},
    {SMALL, .k2 = -.03125, D_TERMS, C_TERMS, .skew = .5, .tilt = {.03125, -.0625}, .theta_max = 1.5},
    {SMALL, C_TERMS, .pupil_e1 = -.001953125, .theta_max = 1.75},
    {SMALL, .radial = PF_RADIAL_PERSPECTIVE, .theta_max = 1.125},
    {SMALL, .radial = PF_RADIAL_STEREOGRAPHIC, .theta_max = 2},
    {SMALL, .radial = PF_RADIAL_EQUISOLID, .theta_max = 2},
    {SMALL, .radial = PF_RADIAL_ORTHOGRAPHIC, .theta_max = 1.5},
    {SMALL, .radial = PF_RADIAL_UNIFIED, .mirror = .875, .theta_max = 1.75},
};
#define CAMERAS_COUNT (sizeof CAMERAS / sizeof CAMERAS[0])

#endif
