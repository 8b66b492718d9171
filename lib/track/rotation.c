/* The rotation between two bundles of bearings, in integers: iteratively re-weighted Gauss-Newton with small-angle
 * steps. Rounding in the normal matrix only slows convergence (the step is zero where the residual torque is), so 20
 * bits are enough there; the torque keeps all 30. */
#include "track_private.h"

#define STEPS     8
#define ONE       1073741824 /* Q30 */
#define SETTLED   32         /* 3e-8 rad */
#define ROBUST_C2 2684355    /* Q30 squared chord (0.05 rad) at which a pair's weight has halved */
#define STEP_MAX  (ONE / 2)  /* rad; the linear model of a larger one says nothing */
#define WELL_POSED                                                                                                     \
    ((int64_t)1 << 40) /* Q60 determinant of the matrix with trace 1: 1e-6; a cone of 2 degrees has it                 \
                        */

void pf_ray_rotate(const int32_t r[9], const pf_ray_q30 *v, pf_ray_q30 *out)
{
    int64_t w[3];
    for (int32_t i = 0; i < 3; i++)
        w[i] = ((int64_t)r[3 * i] * v->x + (int64_t)r[3 * i + 1] * v->y + (int64_t)r[3 * i + 2] * v->z + ONE / 2) >> 30;
    *out = (pf_ray_q30){pf_clamp_i64(w[0], ONE), pf_clamp_i64(w[1], ONE), pf_clamp_i64(w[2], ONE)};
}

uint32_t pf_ray_chord2(const pf_ray_q30 *a, const pf_ray_q30 *b)
{
    const int64_t x = (int64_t)a->x - b->x, y = (int64_t)a->y - b->y, z = (int64_t)a->z - b->z;
    const uint64_t sum = ((uint64_t)(x * x) >> 30) + ((uint64_t)(y * y) >> 30) + ((uint64_t)(z * z) >> 30);
    return sum > UINT32_MAX ? UINT32_MAX : (uint32_t)sum;
}

/* C(w) = (1 - [w/2])^-1 (1 + [w/2]): a rotation without a trigonometric function. */
void pf_rotation_turn(const int32_t w[3], int32_t r[9])
{
    const int64_t x = w[0] / 2, y = w[1] / 2, z = w[2] / 2;
    const int64_t xx = (x * x) >> 30, yy = (y * y) >> 30, zz = (z * z) >> 30;
    const int64_t xy = (x * y) >> 30, xz = (x * z) >> 30, yz = (y * z) >> 30, d = ONE + xx + yy + zz;
    const int64_t c[9] = {ONE + xx - yy - zz, 2 * (xy - z), 2 * (xz + y), 2 * (xy + z),      ONE - xx + yy - zz,
                          2 * (yz - x),       2 * (xz - y), 2 * (yz + x), ONE - xx - yy + zz};
    int32_t out[9];
    for (int32_t i = 0; i < 3; i++)
        for (int32_t j = 0; j < 3; j++) {
            int64_t sum = 0;
            for (int32_t k = 0; k < 3; k++)
                sum += (c[3 * i + k] * ONE / d * r[3 * k + j] + ONE / 2) >> 30;
            out[3 * i + j] = pf_clamp_i64(sum, ONE);
        }
    for (int32_t i = 0; i < 9; i++)
        r[i] = out[i];
}

/* Normal equations of w in b ~ a + w x a, Q45 sums of Cauchy weights (Q15) times Q30: 2048 pairs stay below 2^57. */
static void accumulate(const pf_ray_q30 *a, const pf_ray_q30 *b, int64_t h[6], int64_t g[3])
{
    const int64_t weight = ((int64_t)ROBUST_C2 << 15) / ((int64_t)ROBUST_C2 + pf_ray_chord2(a, b));
    const int64_t ax = a->x >> 15, ay = a->y >> 15, az = a->z >> 15;
    h[0] += weight * (ay * ay + az * az);
    h[1] -= weight * (ax * ay);
    h[2] -= weight * (ax * az);
    h[3] += weight * (ax * ax + az * az);
    h[4] -= weight * (ay * az);
    h[5] += weight * (ax * ax + ay * ay);
    g[0] += weight * (((int64_t)a->y * b->z - (int64_t)a->z * b->y) >> 30);
    g[1] += weight * (((int64_t)a->z * b->x - (int64_t)a->x * b->z) >> 30);
    g[2] += weight * (((int64_t)a->x * b->y - (int64_t)a->y * b->x) >> 30);
}

/* h w = g by the adjugate; w in Q30. False where the bearings do not determine a rotation. */
static bool solve(const int64_t h[6], const int64_t g[3], int32_t w[3])
{
    const int64_t trace = h[0] + h[3] + h[5];
    int64_t m[6], t[3];
    if (trace < (int64_t)1 << 38)
        return false;
    for (int32_t i = 0; i < 6; i++)
        m[i] = h[i] / (trace >> 20); /* Q20 */
    for (int32_t i = 0; i < 3; i++)
        t[i] = pf_clamp_i64(g[i] / (trace >> 30), ONE);
    const int64_t c00 = m[3] * m[5] - m[4] * m[4], c01 = m[2] * m[4] - m[1] * m[5], c02 = m[1] * m[4] - m[2] * m[3];
    const int64_t c11 = m[0] * m[5] - m[2] * m[2], c12 = m[1] * m[2] - m[0] * m[4], c22 = m[0] * m[3] - m[1] * m[1];
    const int64_t det = m[0] * c00 + m[1] * c01 + m[2] * c02;
    if (det < WELL_POSED)
        return false;
    const int64_t c[9] = {c00, c01, c02, c01, c11, c12, c02, c12, c22};
    for (int32_t i = 0; i < 3; i++) {
        int64_t sum = 0;
        for (int32_t j = 0; j < 3; j++)
            sum += (c[3 * i + j] >> 12) * t[j]; /* Q28 times Q30 */
        w[i] = pf_clamp_i64(sum / (det >> 32), STEP_MAX);
    }
    return true;
}

uint32_t pf_rotation_fit(const pf_ray_q30 *a, const pf_ray_q30 *b, uint32_t n, int32_t r[9])
{
    uint32_t used = 0;
    for (int32_t i = 0; i < 9; i++)
        r[i] = i % 4 ? 0 : ONE;
    for (int32_t k = 0; k < STEPS; k++) {
        int64_t h[6] = {0}, g[3] = {0};
        int32_t w[3];
        used = 0;
        for (uint32_t i = 0; i < n; i++) {
            pf_ray_q30 turned;
            if (!pf_ray_valid(&a[i]) || !pf_ray_valid(&b[i]))
                continue;
            pf_ray_rotate(r, &a[i], &turned);
            accumulate(&turned, &b[i], h, g);
            used++;
        }
        if (used < PF_ROTATION_LEAST || !solve(h, g, w))
            break;
        pf_rotation_turn(w, r);
        if (w[0] < SETTLED && w[0] > -SETTLED && w[1] < SETTLED && w[1] > -SETTLED && w[2] < SETTLED && w[2] > -SETTLED)
            break;
    }
    return used;
}
