/* What the files of camera/fixed share. Not for users.
 *
 * The plane point before the sensor is the complex number W = sum over n = -3..3 of H_n(theta) e^(i n phi): H_1 is
 * r(theta) (a real number; D does not reach it), D gives H_-1, H_0, H_2 and H_3, cpoly all but H_1. A channel is the
 * real or the imaginary part of one H_n that is not zero, tabulated over theta at equally spaced knots by value and
 * slope. Between knots it is the cubic that fits them (Hermite), off by h^4 / 384 times the fourth derivative.
 *
 * Units: "position" is theta in intervals of the table, Q31; "plane" is W, int32 with plane_q fractional bits; "sensor"
 * is a pixel relative to the principal point, pixel_q fractional bits.
 */
#ifndef PIPEFISH_CAMERA_FIXED_PRIVATE_H
#define PIPEFISH_CAMERA_FIXED_PRIVATE_H

#include "pipefish/camera_fixed.h"

#define CHANNELS_MAX  13
#define INTERVALS_MAX 2048u
#define ONE_Q30       ((int64_t)1 << 30)
#define ONE_Q31       ((int64_t)1 << 31)
#define HALF_PI_Q32   ((int64_t)6746518852)
#define PI_Q32        ((int64_t)13493037705)

/* Rays in Q1.30 that were made at theta_max lie up to this far beyond it. */
#define THETA_SLACK_Q32 8u

typedef struct channel {
    int8_t harmonic;
    bool imaginary;
} channel;

typedef struct knot {
    int32_t value, slope; /* plane; slope per interval */
} knot;

/* value = (a x + b y) >> shift */
typedef struct affine_row {
    int32_t a, b;
    uint32_t shift;
} affine_row;

struct pf_camera_fixed {
    uint32_t width, height;
    uint64_t theta_max; /* Q32 */
    /* position = (theta_q32 * scale) >> scale_shift; theta = position * step >> step_shift, both of full precision */
    uint32_t scale, scale_shift, step, step_shift;
    uint32_t intervals, channels; /* channel 0 is r */
    channel channel[CHANNELS_MAX];
    uint32_t plane_q, pixel_q[2]; /* of u and v: focal lengths may differ by any factor */
    int64_t plane_max;            /* largest |W| */
    int32_t tilt[2];              /* Q30: d = 1 + tilt[0] X + tilt[1] Y */
    affine_row to_pixel[2], from_pixel[2];
    int64_t center[2];                 /* pixel_q */
    int64_t rim_slack;                 /* plane: what projection's errors leave of a pixel of the rim */
    int64_t rounding;                  /* plane: most that rounding leaves of |W - target|, as a sum */
    int32_t pupil_e1;                  /* Q30 metres */
    int64_t pupil_near;                /* Q30 metres: points must not be nearer */
    int64_t circle[2], circle_radius2; /* Q16.16; Q32, -1 = no circle */
    const knot *knots;                 /* (intervals + 1) x channels */
};

static inline int64_t round_shift(int64_t v, uint32_t bits)
{
    return bits == 0 ? v : (v + ((int64_t)1 << (bits - 1))) >> bits;
}

static inline uint64_t magnitude(int64_t v)
{
    return v < 0 ? 0 - (uint64_t)v : (uint64_t)v;
}

static inline uint32_t bit_length(uint64_t v)
{
    return v == 0 ? 0 : 64 - (uint32_t)__builtin_clzll(v);
}

/* A vector in polar form: its length root * 2^-half (root: 32 bits and 2^31 at least, or 0), and cos, sin of its angle
 * in Q30; (1, 0) for the zero vector. */
typedef struct polar {
    uint64_t root;
    uint32_t half;
    int32_t c, s;
} polar;

/* x^2 + y^2 < 2^64. The length within 1e-9 of itself, cos and sin within 1.2e-9. */
polar pf_fixed_polar(int64_t x, int64_t y);

/* The length with `bits` fractional bits, rounded. */
static inline uint64_t polar_length(polar p, uint32_t bits)
{
    return p.half <= bits ? p.root << (bits - p.half)
                          : (p.root + ((uint64_t)1 << (p.half - bits - 1))) >> (p.half - bits);
}

/* atan2(rho, z) in Q32, 0..pi; rho and z in the same unit, each below 2^56, not both 0. Within 6e-10. */
uint64_t pf_fixed_angle(uint64_t rho, int64_t z);

/* Q30, within 9e-10; theta_q32 in 0..pi. */
void pf_fixed_sine_cosine(uint64_t theta_q32, int32_t *sine, int32_t *cosine);

/* W, and where asked for its derivatives by position: along theta, and along phi over position. */
typedef struct plane_point {
    int64_t x, y, theta_x, theta_y, phi_x, phi_y;
} plane_point;

plane_point pf_fixed_lens(const pf_camera_fixed *fixed, uint64_t theta_q32, int32_t c, int32_t s, bool slopes);

#endif
