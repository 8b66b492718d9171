/* The tracker's own state, for the files that share it: tracker.c (memory, the frame), follow.c (live tracks), detect.c
 * (new ones), rim.c (how far out those begin), mask.c (where nothing may be), measure.c (what the picture tells of the
 * scene). */
#ifndef PIPEFISH_TRACKER_PRIVATE_H
#define PIPEFISH_TRACKER_PRIVATE_H

#include "track_private.h"

#define BLOCK      8u  /* px: side of a block of the masks */
#define SECTORS    12u /* detection in polar cells: sectors of 30 degrees */
#define RINGS      6u
#define DIRECTIONS 36u /* in which it is asked how far out tracks begin */
#define CANDIDATES 4u  /* for corners, times the tracks there may be: most stand too near a stronger one */
#define CLIPPED    4u  /* at most this fraction of a window may be clipped */

typedef struct pf_slot {  /* the hidden part of a live track */
    pf_point_q16 move;    /* its last displacement */
    bool sure;            /* which its start met within CERTAIN */
    pf_point_q16 miss;    /* how far it was from where the caller expected it; 0, 0 where it did not */
    pf_point_q16 own;     /* its moves summed with forgetting; */
    int32_t radial, flow; /* what of them is radial, and the same of those around: see follow.c */
    pf_expected expected; /* by the caller, of the next frame */
    pf_point_q16 from;    /* where it was when the current window of PF_SCENE_WINDOW frames began */
    uint32_t clipped;     /* pixels of its template's window */
    uint64_t first_cov;   /* the sum of its variances at first sight */
    pf_anchor anchor;
} pf_slot;

typedef struct pf_block {           /* 8 x 8 px; of the masks */
    uint16_t mean_q6, deviation_q6; /* of one pixel over time, while the rest moves */
    uint8_t is_masked;              /* by the user */
    uint8_t is_outside;             /* no window fits there */
    uint8_t sentence;               /* lessons for which it stays static */
    uint8_t is_closed;              /* to new tracks */
    uint8_t is_static;              /* by what was seen */
} pf_block;

struct pf_tracker {
    pf_tracker_config config; /* defaults filled in; .mask NULL */
    pf_tracker_stats stats;
    pf_pyramid pyramid[2];
    uint32_t now; /* index of the current frame's pyramid */
    bool started;
    uint64_t last_id;
    pf_track *table;
    uint16_t *slot_of; /* of each live row of the table */
    uint32_t *cell_of; /* scratch: polar cell (ring * SECTORS + sector) and radial move of each row */
    int32_t *radial;
    uint32_t n;
    pf_slot *slots;
    int64_t way_q24, axis[4];   /* pf_tracker_foresee */
    int64_t rim_q8[DIRECTIONS]; /* how far from the circle's centre new tracks begin, px; 0 = no circle */
    int64_t rim_most_q8;
    uint8_t *pixels; /* templates, patch_bytes each */
    uint32_t patch_bytes;
    uint16_t *spare; /* free slots */
    uint32_t spare_n;
    uint32_t extra; /* attempts that may still be made in this frame beyond two a track */
    int32_t *head;  /* grid: first table row of each cell, -1 = none */
    int32_t *next;  /* grid: next table row in the same cell, by table row */
    uint32_t grid_w, grid_h;
    pf_corner *found; /* heap of candidates, weakest on top */
    uint32_t found_n;
    uint32_t *value; /* scratch for medians, a number a track */
    pf_block *block;
    uint32_t block_w, block_h, static_blocks;
    uint32_t usable_blocks;        /* not outside */
    bool is_mask_stale;            /* blocks have become static, or ceased to be, since is_closed was worked out */
    uint32_t slice;                /* every SLICES-th row of blocks learns at a time: which ones next */
    uint32_t travel_q16;           /* median motion since the last lesson */
    uint32_t frame;                /* of the current window of PF_SCENE_WINDOW */
    uint32_t drift_q16;            /* of the last one */
    uint32_t bin[SECTORS * RINGS]; /* live tracks of each polar cell */
    pf_klt klt;
    pf_corner_scratch corners;
};

/* --- the grid (tracker.c) */

void pf_grid_insert(pf_tracker *t, uint32_t row);

/* Whether a track in the grid lies within `reach` (Q16.16 px, at most a cell) of `at`. */
bool pf_grid_near(const pf_tracker *t, pf_point_q16 at, int64_t reach);

/* --- live tracks (follow.c) */

/* Finds every live track in the new frame, or loses it. */
void pf_tracks_follow(pf_tracker *t);

/* A coordinate of a start, brought within 64 px of a picture of `size`: differences and their squares then fit. */
int32_t pf_guess_clamp(int64_t v, uint32_t size);

/* The centre of the flow: the circle's, or the picture's. */
pf_point_q16 pf_flow_centre(const pf_tracker *t);

/* --- new tracks (detect.c) */

void pf_tracks_detect(pf_tracker *t);

/* --- how far out they begin (rim.c) */

/* After pf_scene_measure: sets rim_q8. */
void pf_rim_set(pf_tracker *t);

/* Whether a new track may begin there. */
bool pf_rim_allows(const pf_tracker *t, pf_point_q16 at);

/* The sector of 30 degrees, 0 .. SECTORS - 1 from x to y, that (dx, dy), |.| < 2^40, lies in. */
uint32_t pf_sector_of(int64_t dx, int64_t dy);

/* --- masks (mask.c) */

/* Takes the user's mask; NULL = none. Forgets what was learned. */
void pf_mask_init(pf_tracker *t, const pf_image *mask);

/* Whether a live track may be at `at`; whether a new one may be at pixel (x, y): clear of static blocks by one more. */
bool pf_mask_allows(const pf_tracker *t, pf_point_q16 at);
bool pf_mask_allows_new(const pf_tracker *t, int32_t x, int32_t y);

/* After tracking: looks which blocks stand still in the picture while it moves. */
void pf_mask_learn(pf_tracker *t);

/* What is at `at` has been seen to stand still. */
void pf_mask_condemn(pf_tracker *t, pf_point_q16 at);

/* Pixels of the window around `at` that are clipped, at either end. */
uint32_t pf_mask_clipped(const pf_tracker *t, const pf_image *image, pf_point_q16 at);

/* --- the scene (measure.c) */

/* Fills the medians of stats and stats.scene. */
void pf_scene_measure(pf_tracker *t);

#endif
