/* How far out in the picture new tracks begin. A point of the reconstruction needs three views, so what will be gone
 * before the third keyframe from now only takes the place of better ones. */
#include "tracker_private.h"

/* With a circle nothing begins in its outer eighth: what comes up there first is the lamp's mirror image on wet and
 * smooth walls, which is always beside the camera; the wall itself was seen before. On clay and in wide plastic pipes
 * it made 43 to 69 % of the losses and a quarter to a half of the wrong places. */
#define OUTER   8
#define QUARTER (DIRECTIONS / 4u)
#define FEW     12u /* tracks: with fewer the camera's motion is not known, and any that shows it will do */
#define ONE     ((int64_t)1 << 24) /* the tube's radius */
#define RAY     ((int64_t)1 << 30)
#define STEEP   ((int64_t)1 << 26) /* sine of a polar angle, Q30: less says nothing */

/* In which of the DIRECTIONS, from x to y, (dx, dy) lies; |.| < 2^40. */
static uint32_t direction_of(int64_t dx, int64_t dy)
{
    static const int32_t tangent[QUARTER - 1u] = {176,  364,  577,  839,
                                                  1192, 1732, 2747, 5671}; /* of 10, 20 .. degrees */
    const uint32_t quadrant = dy < 0 ? (dx < 0 ? 2u : 3u) : dx < 0 ? 1u : 0u;
    const int64_t ax = dx < 0 ? -dx : dx, ay = dy < 0 ? -dy : dy;
    const int64_t along = quadrant % 2u ? ay : ax, across = quadrant % 2u ? ax : ay;
    uint32_t k = 0;
    while (k < QUARTER - 1u && 1000 * across >= tangent[k] * along)
        k++;
    return quadrant * QUARTER + k;
}

/* The unit vector, Q15, in the middle of a direction. */
static void middle_of(uint32_t direction, int32_t way[2])
{
    static const int32_t cosine[QUARTER] = {32643, 31651, 29698, 26842, 23170, 18795, 13848, 8481, 2856};
    const int32_t c = cosine[direction % QUARTER], s = cosine[QUARTER - 1u - direction % QUARTER];
    const int32_t turned[4][2] = {{c, s}, {-s, c}, {-c, -s}, {s, -c}};
    way[0] = turned[direction / QUARTER][0];
    way[1] = turned[direction / QUARTER][1];
}

/* How far from the circle's centre a window still fits into circle and image in that direction, Q16 px. */
static int64_t fits_within(const pf_tracker *t, const int32_t way[2])
{
    const pf_point_q16 centre = t->config.circle;
    const int64_t at[2] = {centre.x, centre.y}, size[2] = {t->config.width, t->config.height};
    int64_t r = t->config.circle_radius_q16;
    for (uint32_t k = 0; k < 2u; k++) {
        const int64_t room = way[k] > 0 ? ((size[k] - 1) << 16) - at[k] : at[k], part = way[k] > 0 ? way[k] : -way[k];
        if (room * 32768 < r * part)
            r = room * 32768 / part;
    }
    return r - ((int64_t)(t->klt.half * 3 / 2 + 1) << 16);
}

/* How far from the circle's centre the wall is seen, in a direction, that leaves the picture when the camera has
 * driven the way foreseen. Q8 px; 0: not known. */
static int64_t late_in(const pf_tracker *t, uint32_t direction)
{
    const pf_track_lens *lens = &t->config.lens;
    const pf_point_q16 centre = t->config.circle;
    int32_t way[2];
    middle_of(direction, way);
    const int64_t r = fits_within(t, way);
    if (r <= 0)
        return 0;
    pf_point_q16 at = {(int32_t)(centre.x + r * way[0] / 32768), (int32_t)(centre.y + r * way[1] / 32768)};
    const pf_ray_q30 leaves = lens->ray(lens->rays, at);
    const int64_t sine = pf_ray_sine(&leaves);
    if (sine < STEEP)
        return 0;
    const int64_t c = leaves.x * ONE / sine, s = leaves.y * ONE / sine;
    int64_t z;
    (void)pf_tube_wall(c, s, leaves.z * ONE / sine, t->axis, &z);
    const int64_t cot = (z + t->way_q24) * ONE / pf_tube_reach(c, s, z + t->way_q24, t->axis);
    const int64_t norm = pf_isqrt64((uint64_t)(cot * cot + ONE * ONE));
    const pf_ray_q30 late = {(int32_t)(c * RAY / norm), (int32_t)(s * RAY / norm), (int32_t)(cot * RAY / norm)};
    if (!lens->project(lens->camera, &late, &at))
        return 0;
    const int64_t x = ((int64_t)at.x - centre.x) >> 8, y = ((int64_t)at.y - centre.y) >> 8;
    return pf_isqrt64((uint64_t)(x * x + y * y));
}

void pf_tracker_foresee(pf_tracker *tracker, int64_t way_q24, const int64_t axis[4])
{
    tracker->way_q24 = way_q24 < 0 ? 0 : way_q24 < PF_WAY_MOST ? way_q24 : PF_WAY_MOST;
    for (uint32_t i = 0; i < 4u; i++)
        tracker->axis[i] = axis ? pf_clamp_i64(axis[i], PF_TUBE_FARTHEST) : 0;
}

void pf_rim_set(pf_tracker *t)
{
    const pf_scene_measures *m = &t->stats.scene;
    const bool comes_out = 5u * m->outward > 3u * m->moved; /* the share that must go in for it to be reversing */
    const bool foresees = t->config.lens.ray && t->config.circle_radius_q16 && comes_out && t->stats.tracked >= FEW;
    const int64_t rim = (int64_t)(t->config.circle_radius_q16 >> 8) * (OUTER - 1) / OUTER;
    t->rim_most_q8 = 0;
    for (uint32_t i = 0; i < DIRECTIONS; i++) {
        const int64_t late = foresees ? late_in(t, i) : 0;
        t->rim_q8[i] = late > 0 && late < rim ? late : rim;
        t->rim_most_q8 = t->rim_q8[i] > t->rim_most_q8 ? t->rim_q8[i] : t->rim_most_q8;
    }
}

bool pf_rim_allows(const pf_tracker *t, pf_point_q16 at)
{
    const int64_t x = ((int64_t)at.x - t->config.circle.x) >> 8, y = ((int64_t)at.y - t->config.circle.y) >> 8;
    const int64_t rim = t->rim_q8[direction_of(x, y)];
    return rim == 0 || x * x + y * y <= rim * rim;
}
