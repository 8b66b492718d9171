/* Square root, angle, sine and cosine in integers. The polynomials are minimax fits, found by iterated reweighting on a
 * dense grid and rounded to Q32; their own errors are below 1e-11. */
#include "fixed.h"

/* sqrt(a / 2^32) for 2^30 <= a < 2^32: 1 / sqrt in Q31 by Newton from a parabola within 2.5 %, four steps to 32 bits.
 */
static uint64_t inverse_root(uint64_t a)
{
    uint64_t y = (5735607946u - ((3527688184u * a) >> 31)) + ((3518908926u * ((a * a) >> 32)) >> 32);
    for (int i = 0; i < 3; i++) {
        uint64_t t = (a * y + ONE_Q31) >> 32;                 /* a y, Q31 */
        int64_t rest = ((int64_t)1 << 62) - (int64_t)(t * y); /* 1 - a y^2, Q62 */
        y = (uint64_t)((int64_t)y + round_shift((rest >> 31) * (int64_t)y, 32));
    }
    return y;
}

static int32_t cosine_of(int64_t x, uint64_t y, uint32_t half)
{
    uint64_t c = (((magnitude(x) << half) * y) + ((uint64_t)1 << 32)) >> 33;
    if (c > (uint64_t)ONE_Q30)
        c = (uint64_t)ONE_Q30;
    return x < 0 ? -(int32_t)c : (int32_t)c;
}

polar pf_fixed_polar(int64_t x, int64_t y)
{
    uint64_t n = magnitude(x) * magnitude(x) + magnitude(y) * magnitude(y);
    if (n == 0)
        return (polar){0, 0, (int32_t)ONE_Q30, 0};
    uint32_t half = (uint32_t)__builtin_clzll(n) / 2;
    n <<= 2 * half;
    uint64_t a = (n >> 32) + ((n >> 31) & 1u);
    a -= a >> 32;
    uint64_t inverse = inverse_root(a);
    return (polar){(a * inverse + (uint64_t)(ONE_Q31 / 2)) >> 31, half, cosine_of(x, inverse, half),
                   cosine_of(y, inverse, half)};
}

/* num / den in Q32, num <= den < 2^56, den > 0. */
static uint64_t ratio(uint64_t num, uint64_t den)
{
    uint32_t bits = bit_length(den);
    if (bits <= 32)
        return (num << 32) / den;
    uint32_t drop = bits - 32;
    return (num << (32 - drop)) / ((den + ((uint64_t)1 << (drop - 1))) >> drop);
}

/* atan of q in Q32, 0 <= q <= tan(pi / 8). */
static uint64_t small_angle(uint64_t q)
{
    static const int64_t a[7] = {4294967295, -1431655625, 858984424, -613309114, 473407071, -359573677, 195710393};
    int64_t z = (int64_t)((q * q + ((uint64_t)1 << 31)) >> 32), p = a[6];
    for (int i = 5; i >= 0; i--)
        p = a[i] + round_shift(p * z, 32);
    return ((uint64_t)p * q + ((uint64_t)1 << 31)) >> 32;
}

uint64_t pf_fixed_angle(uint64_t rho, int64_t z)
{
    const uint64_t eighth_pi_tangent = 1779033704, quarter_pi = 3373259426;
    uint64_t a = magnitude(z), low = rho < a ? rho : a, high = rho < a ? a : rho, angle;
    uint64_t q = ratio(low, high);
    if (q > eighth_pi_tangent)
        angle = quarter_pi - small_angle(ratio(high - low, high + low));
    else
        angle = small_angle(q);
    if (rho > a)
        angle = (uint64_t)HALF_PI_Q32 - angle;
    return z < 0 ? (uint64_t)PI_Q32 - angle : angle;
}

void pf_fixed_sine_cosine(uint64_t theta_q32, int32_t *sine, int32_t *cosine)
{
    static const int64_t s[5] = {4294967296, -715827879, 35791364, -852065, 11655};
    static const int64_t c[6] = {4294967296, -2147483648, 178956970, -5965229, 106511, -1167};
    int64_t x = (int64_t)theta_q32;
    bool back = x > HALF_PI_Q32;
    if (back)
        x = PI_Q32 - x;
    bool steep = x > HALF_PI_Q32 / 2;
    if (steep)
        x = HALF_PI_Q32 - x;
    int64_t z = (int64_t)(((uint64_t)x * (uint64_t)x) >> 32), p = s[4], q = c[5];
    for (int i = 3; i >= 0; i--)
        p = s[i] + round_shift(p * z, 32);
    for (int i = 4; i >= 0; i--)
        q = c[i] + round_shift(q * z, 32);
    int32_t first = (int32_t)((((uint64_t)p * (uint64_t)x) + ((uint64_t)1 << 33)) >> 34),
            second = (int32_t)round_shift(q, 2);
    *sine = steep ? second : first;
    *cosine = steep ? first : second;
    if (back)
        *cosine = -*cosine;
}
