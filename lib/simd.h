/* What the vector rooms share: NEON intrinsics (SIMDe maps them on x86) and the few operations for which NEON and x86
 * have one instruction each but not the same intrinsic. Not for users.
 *
 * Sums are exact integers, so the lanes in which products are gathered do not matter. */
#ifndef PIPEFISH_SIMD_H
#define PIPEFISH_SIMD_H

#include <stddef.h>
#include <stdint.h>

#if defined(__aarch64__)
#include <arm_neon.h>
#else
#define SIMDE_ENABLE_NATIVE_ALIASES
#include <simde/arm/neon.h>
#include <simde/x86/sse4.1.h>
#define PF_M(type, v)    simde_##type##_to_m128i(v)
#define PF_FROM(type, m) simde_##type##_from_m128i(m)
#endif

/* Eight pixels as 16-bit numbers. */
static inline int16x8_t pf_load8(const uint8_t *p)
{
#if defined(__aarch64__)
    return vreinterpretq_s16_u16(vmovl_u8(vld1_u8(p)));
#else
    return PF_FROM(int16x8, simde_mm_cvtepu8_epi16(simde_mm_loadl_epi64((const simde__m128i *)(const void *)p)));
#endif
}

/* Stores the low bytes of eight numbers 0..255. */
static inline void pf_store8(uint8_t *p, uint16x8_t v)
{
#if defined(__aarch64__)
    vst1_u8(p, vmovn_u16(v));
#else
    const simde__m128i m = PF_M(uint16x8, v);
    simde_mm_storel_epi64((simde__m128i *)(void *)p, simde_mm_packus_epi16(m, m));
#endif
}

/* Lanes 0 2 4 6 of a, then of b; and 1 3 5 7. */
static inline uint16x8_t pf_even(uint16x8_t a, uint16x8_t b)
{
#if defined(__aarch64__)
    return vuzp1q_u16(a, b);
#else
    const simde__m128i low = simde_mm_set1_epi32(0xFFFF);
    return PF_FROM(uint16x8, simde_mm_packus_epi32(simde_mm_and_si128(PF_M(uint16x8, a), low),
                                                   simde_mm_and_si128(PF_M(uint16x8, b), low)));
#endif
}

static inline uint16x8_t pf_odd(uint16x8_t a, uint16x8_t b)
{
#if defined(__aarch64__)
    return vuzp2q_u16(a, b);
#else
    return PF_FROM(uint16x8, simde_mm_packus_epi32(simde_mm_srli_epi32(PF_M(uint16x8, a), 16),
                                                   simde_mm_srli_epi32(PF_M(uint16x8, b), 16)));
#endif
}

/* sum + the products of all lanes of a and b, gathered in four lanes, two products a lane. */
static inline int32x4_t pf_dot(int32x4_t sum, int16x8_t a, int16x8_t b)
{
#if defined(__aarch64__)
    return vmlal_high_s16(vmlal_s16(sum, vget_low_s16(a), vget_low_s16(b)), a, b);
#else
    return vaddq_s32(sum, PF_FROM(int32x4, simde_mm_madd_epi16(PF_M(int16x8, a), PF_M(int16x8, b))));
#endif
}

/* Lane i: a[2i] b[2i] + a[2i + 1] b[2i + 1]. */
static inline int32x4_t pf_pairs(int16x8_t a, int16x8_t b)
{
#if defined(__aarch64__)
    return vpaddq_s32(vmull_s16(vget_low_s16(a), vget_low_s16(b)), vmull_high_s16(a, b));
#else
    return PF_FROM(int32x4, simde_mm_madd_epi16(PF_M(int16x8, a), PF_M(int16x8, b)));
#endif
}

/* a b >> 16. */
static inline int16x8_t pf_mul_high(int16x8_t a, int16x8_t b)
{
#if defined(__aarch64__)
    return vuzp2q_s16(vreinterpretq_s16_s32(vmull_s16(vget_low_s16(a), vget_low_s16(b))),
                      vreinterpretq_s16_s32(vmull_high_s16(a, b)));
#else
    return PF_FROM(int16x8, simde_mm_mulhi_epi16(PF_M(int16x8, a), PF_M(int16x8, b)));
#endif
}

/* All lanes by the same number of bits, 0..31, known at run time. */
static inline int32x4_t pf_shift_right(int32x4_t v, int bits)
{
#if defined(__aarch64__)
    return vshlq_s32(v, vdupq_n_s32(-bits));
#else
    return PF_FROM(int32x4, simde_mm_sra_epi32(PF_M(int32x4, v), simde_mm_cvtsi32_si128(bits)));
#endif
}

static inline uint32x4_t pf_shift_right_u(uint32x4_t v, int bits)
{
#if defined(__aarch64__)
    return vshlq_u32(v, vdupq_n_s32(-bits));
#else
    return PF_FROM(uint32x4, simde_mm_srl_epi32(PF_M(uint32x4, v), simde_mm_cvtsi32_si128(bits)));
#endif
}

/* Whether all lanes of a comparison hold. */
static inline int pf_all(uint16x8_t mask)
{
#if defined(__aarch64__)
    return vminvq_u16(mask) != 0;
#else
    return simde_mm_movemask_epi8(PF_M(uint16x8, mask)) == 0xFFFF;
#endif
}

/* v[0] = x x + y y, v[1] = x x - y y, v[2] = 2 x y, lanes 0..3 and 4..7. Below 2^14. */
static inline void pf_squares(int16x8_t x, int16x8_t y, int32x4_t v[3][2])
{
#if defined(__aarch64__)
    const int16x4_t lx = vget_low_s16(x), ly = vget_low_s16(y);
    const int32x4_t xx = vmull_s16(lx, lx), hh = vmull_high_s16(x, x);
    v[0][0] = vmlal_s16(xx, ly, ly), v[0][1] = vmlal_high_s16(hh, y, y);
    v[1][0] = vmlsl_s16(xx, ly, ly), v[1][1] = vmlsl_high_s16(hh, y, y);
    const int16x8_t two = vaddq_s16(x, x);
    v[2][0] = vmull_s16(vget_low_s16(two), ly), v[2][1] = vmull_high_s16(two, y);
#else
    const simde__m128i a = PF_M(int16x8, x), b = PF_M(int16x8, y), c = PF_M(int16x8, vnegq_s16(y));
    const simde__m128i low = simde_mm_unpacklo_epi16(a, b), high = simde_mm_unpackhi_epi16(a, b);
    v[0][0] = PF_FROM(int32x4, simde_mm_madd_epi16(low, low));
    v[0][1] = PF_FROM(int32x4, simde_mm_madd_epi16(high, high));
    v[1][0] = PF_FROM(int32x4, simde_mm_madd_epi16(low, simde_mm_unpacklo_epi16(a, c)));
    v[1][1] = PF_FROM(int32x4, simde_mm_madd_epi16(high, simde_mm_unpackhi_epi16(a, c)));
    v[2][0] = PF_FROM(int32x4, simde_mm_madd_epi16(low, simde_mm_unpacklo_epi16(b, a)));
    v[2][1] = PF_FROM(int32x4, simde_mm_madd_epi16(high, simde_mm_unpackhi_epi16(b, a)));
#endif
}

/* (a b + 2^14) >> 15. Never both -32768. */
static inline int16x8_t pf_mul_q15(int16x8_t a, int16x8_t b)
{
#if defined(__aarch64__)
    return vqrdmulhq_s16(a, b);
#else
    return PF_FROM(int16x8, simde_mm_mulhrs_epi16(PF_M(int16x8, a), PF_M(int16x8, b)));
#endif
}

/* Sum of the four lanes. */
static inline int64_t pf_total(int32x4_t v)
{
#if defined(__aarch64__)
    return vaddlvq_s32(v);
#else
    const simde__m128i m = PF_M(int32x4, v), low = simde_mm_cvtepi32_epi64(m);
    const simde__m128i high = simde_mm_cvtepi32_epi64(simde_mm_unpackhi_epi64(m, m));
    const simde__m128i sum = simde_mm_add_epi64(low, high);
    return simde_mm_cvtsi128_si64(simde_mm_add_epi64(sum, simde_mm_unpackhi_epi64(sum, sum)));
#endif
}

/* Lanes of `yes` where `mask` is all ones, of `no` where it is zero. */
static inline uint8x16_t pf_select(uint16x8_t mask, uint8x16_t yes, uint8x16_t no)
{
#if defined(__aarch64__)
    return vbslq_u8(vreinterpretq_u8_u16(mask), yes, no);
#else
    return PF_FROM(uint8x16, simde_mm_blendv_epi8(PF_M(uint8x16, no), PF_M(uint8x16, yes), PF_M(uint16x8, mask)));
#endif
}

/* Bytes of a table of 16, by indices 0..15. */
static inline uint8x16_t pf_lookup(uint8x16_t table, uint8x16_t index)
{
#if defined(__aarch64__)
    return vqtbl1q_u8(table, index);
#else
    return PF_FROM(uint8x16, simde_mm_shuffle_epi8(PF_M(uint8x16, table), PF_M(uint8x16, index)));
#endif
}

#endif
