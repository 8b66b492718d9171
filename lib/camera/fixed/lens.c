/* The lens before the sensor: theta and phi to the plane. */
#include "fixed.h"

/* The cubic between two knots (slopes and rises below 2^28), t in Q31 (beyond 1: its tangent there goes on); *slope
 * (may be NULL) by position. */
static int64_t between(const knot *low, const knot *high, int64_t t, int64_t *slope)
{
    if (t > ONE_Q31) {
        if (slope)
            *slope = high->slope;
        return high->value + round_shift(high->slope * (t - ONE_Q31), 31);
    }
    int64_t rise = (int64_t)high->value - low->value;
    int64_t c3 = (int64_t)low->slope + high->slope - 2 * rise, c2 = rise - low->slope - c3;
    if (slope)
        *slope = low->slope + round_shift((2 * c2 + round_shift(3 * c3 * t, 31)) * t, 31);
    return low->value + round_shift((low->slope + round_shift((c2 + round_shift(c3 * t, 31)) * t, 31)) * t, 31);
}

/* e^(i n phi) for n = 0..3, Q30 */
static void harmonics(int32_t c, int32_t s, int64_t cosine[4], int64_t sine[4])
{
    cosine[0] = ONE_Q30;
    sine[0] = 0;
    for (int n = 1; n < 4; n++) {
        cosine[n] = round_shift(cosine[n - 1] * c - sine[n - 1] * s, 30);
        sine[n] = round_shift(sine[n - 1] * c + cosine[n - 1] * s, 30);
    }
}

plane_point pf_fixed_lens(const pf_camera_fixed *fixed, uint64_t theta_q32, int32_t c, int32_t s, bool slopes)
{
    uint64_t position = (theta_q32 * fixed->scale) >> fixed->scale_shift;
    uint64_t index = position >> 31;
    if (index >= fixed->intervals)
        index = fixed->intervals - 1;
    int64_t t = (int64_t)(position - (index << 31));
    const knot *low = fixed->knots + index * fixed->channels, *high = low + fixed->channels;
    plane_point w = {0, 0, 0, 0, 0, 0};

    if (fixed->channels == 1) {
        int64_t r = between(low, high, t, NULL);
        w.x = round_shift(r * c, 30);
        w.y = round_shift(r * s, 30);
        return w;
    }
    int64_t cosine[4], sine[4];
    harmonics(c, s, cosine, sine);
    for (uint32_t k = 0; k < fixed->channels; k++) {
        channel part = fixed->channel[k];
        int64_t slope = 0, value = between(low + k, high + k, t, &slope);
        int n = part.harmonic, m = n < 0 ? -n : n;
        int64_t a = cosine[m], b = n < 0 ? -sine[m] : sine[m];
        int64_t re = part.imaginary ? -b : a, im = part.imaginary ? a : b; /* of the part times e^(i n phi) */
        w.x += value * re; /* the sum of all moduli fits the plane: no overflow before the one rounding */
        w.y += value * im;
        if (slopes) {
            /* Near the axis H_n / theta is the slope: what has none there is quadratic and small. */
            int64_t over = position < (1u << 25) ? slope : (value * ONE_Q31) / (int64_t)position;
            w.theta_x += round_shift(slope * re, 30);
            w.theta_y += round_shift(slope * im, 30);
            w.phi_x -= round_shift(n * over * im, 30);
            w.phi_y += round_shift(n * over * re, 30);
        }
    }
    w.x = round_shift(w.x, 30);
    w.y = round_shift(w.y, 30);
    return w;
}
