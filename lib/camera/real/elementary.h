/* Angle, sine and cosine from IEEE basic operations alone: the same bits on every target, whatever its libm, and loops
 * over them vectorise (no calls, no branches, selects only). Polynomials: Chebyshev fits of this project to 50 digits,
 * rounded to double; with exact arithmetic the relative errors are atan 8e-18, sin 2e-17, cos 1.3e-18. */
#ifndef PIPEFISH_CAMERA_ELEMENTARY_H
#define PIPEFISH_CAMERA_ELEMENTARY_H

#include <math.h>

#define PI_4     0.7853981633974483
#define PI_4_LOW 3.061616997868383e-17
#define PI_2     1.5707963267948966
#define PI_2_LOW 6.123233995736766e-17
#define PI_ALL   3.141592653589793
#define TAN_PI_8 0.41421356237309503

/* atan2(rho, z) in [0, pi] for rho >= 0, not both 0; within 2 units in the last place. Three ranges of half-width pi /
 * 8 around 0, pi / 4 and pi / 2. */
static inline double angle_of(double rho, double z)
{
    double a = fabs(z);
    int near = rho <= TAN_PI_8 * a, far = a <= TAN_PI_8 * rho;
    double n = near ? rho : far ? -a : rho - a;
    double d = near ? a : far ? rho : rho + a;
    double u = n / d, s = u * u;
    double p = -0.019175404711104935;
    p = p * s + 0.03923044778479309;
    p = p * s - 0.050854078345894844;
    p = p * s + 0.05858140904866328;
    p = p * s - 0.06664510525508936;
    p = p * s + 0.07692183125376892;
    p = p * s - 0.0909090457530649;
    p = p * s + 0.11111111015187018;
    p = p * s - 0.14285714284665682;
    p = p * s + 0.19999999999995516;
    p = p * s - 0.3333333333333333;
    double base = near ? 0 : far ? PI_2 : PI_4;
    double low = near ? 0 : far ? PI_2_LOW : PI_4_LOW;
    double angle = base + (u + (u * (s * p) + low));
    return z < 0 ? PI_ALL - angle + 2 * PI_2_LOW : angle;
}

/* Sine and cosine of an angle in [0, pi], each within 1.3e-16; the sine of a small angle relative to it. */
static inline void sine_cosine(double angle, double *sine, double *cosine)
{
    int first = angle <= PI_4, second = angle <= PI_4 + PI_2;
    double quarter = first ? 0 : second ? 1 : 2;
    double x = angle - quarter * PI_2 - quarter * PI_2_LOW;
    double s = x * x;
    double p = 1.5918115263265974e-10;
    p = p * s - 2.505113165023518e-08;
    p = p * s + 2.7557316101617874e-06;
    p = p * s - 0.00019841269836756774;
    p = p * s + 0.008333333333330948;
    p = p * s - 0.16666666666666666;
    double sx = x + x * (s * p);
    double q = -1.1382623647474604e-11;
    q = q * s + 2.087614614655861e-09;
    q = q * s - 2.7557317271145144e-07;
    q = q * s + 2.480158729876456e-05;
    q = q * s - 0.0013888888888887398;
    q = q * s + 0.041666666666666664;
    double half = 0.5 * s, w = 1 - half;
    double cx = w + ((1 - w - half) + s * s * q);
    *sine = first ? sx : second ? cx : -sx;
    *cosine = first ? cx : second ? -sx : -cx;
}

#endif
