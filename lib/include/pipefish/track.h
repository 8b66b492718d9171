/* The feature tracker: corners spread over the image, pyramidal KLT with forward-backward check, a table of tracks with
 * stable ids, bearings, prediction, masks, states of the scene, keyframe choice. Integers only: the same bits on all
 * targets.
 */
#ifndef PIPEFISH_TRACK_H
#define PIPEFISH_TRACK_H

#include "pipefish/camera_fixed.h"
#include "pipefish/image.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_TRACKS_MAX 2048u

/* Added to both variances of a position: (1/256 px)^2, for what interpolation and rounding leave. */
#define PF_TRACK_COV_FLOOR_Q20 16

typedef enum pf_track_status {
    PF_TRACK_NEW = 1,     /* detected in this frame */
    PF_TRACK_TRACKED = 2, /* found again in this frame: .pos and .cov are valid */
    PF_TRACK_LOST = 3,    /* not found; .reason says why; gone from the table at the next frame */
} pf_track_status;

typedef enum pf_track_reason {
    PF_TRACK_OK = 0,
    PF_TRACK_LEFT = 1,     /* its window left the image or the image circle */
    PF_TRACK_FLAT = 2,     /* too little texture to locate it */
    PF_TRACK_DIVERGED = 3, /* the iteration did not settle */
    PF_TRACK_RESIDUAL = 4, /* the patch no longer looks the same */
    PF_TRACK_BACKWARD = 5, /* forward-backward check failed */
    PF_TRACK_CROWDED = 6,  /* ran into an older track */
    PF_TRACK_DRIFT = 7,    /* no longer looks like its template (first sight, renewed as its shape changes), lies
                            * elsewhere than the template says, or has walked off the wall */
    PF_TRACK_MASKED = 8,   /* ran into a masked part of the picture */
    PF_TRACK_STATIC = 9,   /* stands still, or nearly, while all around it moves: a reflection of the lamp, dirt on the
                            * lens, the camera's own shadow */
    PF_TRACK_SATURATED = 10, /* over a quarter of its window is clipped, white (250 and above) or black (2 and below),
                              * or a twentieth more or less than of its template */
    PF_TRACK_REASONS = 11,
} pf_track_reason;

typedef struct pf_track {
    uint64_t id;      /* unique in one boot, never reused, > 0 */
    pf_point_q16 pos; /* in the current frame; last known where lost */
    /* Q12.20 px^2, saturating, positive definite: covariance of the position against where the track was first seen.
     * With noise sigma in both patches and light gain g it is sigma^2 (1 + 1/g^2) times the position's block of
     * (sum J J^T)^-1, J the derivatives of the template by position and affine warp with gain and bias eliminated;
     * plus the first term of each template before it; turned by the warp into the picture's axes; plus the floor. New
     * tracks: g = 1. */
    uint32_t cov_xx_q20, cov_yy_q20;
    int32_t cov_xy_q20;
    uint32_t age;     /* frames since detection; 0 = new */
    uint8_t status;   /* pf_track_status */
    uint8_t reason;   /* pf_track_reason */
    uint16_t quality; /* similarity with the previous frame's patch, Q0.15 ZNCC (32767 = identical); 0 when new */
    int16_t settled_x_q8, settled_y_q8; /* by so much pf_wall_settle moved pos, Q8 px; the patch was found without it */
} pf_track;

/* Projects a ray of the camera frame; false where it cannot be seen. pf_track_project is one. */
typedef bool (*pf_ray_project)(const void *camera, const pf_ray_q30 *ray, pf_point_q16 *at);

/* The lens, as the tracker sees it: pf_track_lens. All must outlive the tracker. */
typedef struct pf_track_lens {
    pf_ray_q30 (*ray)(const void *rays, pf_point_q16 pixel); /* (0, 0, 0) where there is none; NULL: no lens is known */
    pf_ray_project project;
    const void *rays, *camera;
} pf_track_lens;

/* Zero means the default in brackets; width and height have none. Bounds are checked by pf_tracker_init. */
typedef struct pf_tracker_config {
    uint32_t width, height;     /* frame size, 64..16384 */
    uint32_t max_tracks;        /* 8..2048 [400] */
    uint32_t levels;            /* pyramid levels, 1..6 [4] */
    uint32_t window;            /* KLT window side in pixels, odd, 7..31 [21] */
    uint32_t iterations;        /* most iterations a level, 1..30 [10] */
    uint32_t cell;              /* detection: side of a grid cell in pixels, 16..256 [chosen from max_tracks] */
    uint32_t min_eigen;         /* detection: least smaller eigenvalue of the mean structure tensor (3 x 3 at half
                                 * resolution), grey^2, up to 16384 [8; noise of sigma 2 alone gives up to 1] */
    uint32_t fb_q16;            /* most forward-backward distance, Q16.16 px, up to 16 [0.5] */
    uint32_t min_zncc_q15;      /* least similarity to the previous patch, Q0.15, up to 32767 [0.8]; to the template
                                 * it is 0.1 less */
    uint32_t noise_q8;          /* image noise sigma, grey levels Q8.8, up to 64, for covariances [2.0] */
    pf_point_q16 circle;        /* centre of the image circle, Q16.16 px, each within +-16384 */
    uint32_t circle_radius_q16; /* its radius, from `window` px (less holds no window) up to 16384; 0 =
                                 * the whole image is used */
    const pf_image *mask;       /* of the frame's size, 0 = nothing may be tracked here, in blocks of 8 x 8: one such
                                 * pixel rules out its block. NULL = none. Read by pf_tracker_init only */
    bool no_static_mask;        /* true: the tracker does not look for parts that stand still while the picture moves */
    pf_track_lens lens; /* with one, patches bend as those on the wall of a tube along the optical axis do: an affine
                         * warp alone leaves 0.02 px a fifth of growth, the same way for all; no track begins at the
                         * edge of the glare, nor where pf_tracker_foresee says that it is too late [none] */
    bool has_wall; /* the caller gives up what walks off the wall, with pf_wall_check: what is left need look less alike
                    * (0.2 less than min_zncc, twice fb, twice the variance at which a track is lost) */
    bool polar; /* new corners are spread over 12 sectors and 6 rings of the image circle, at most 1.5 x max_tracks / 72
                 * in each, none in its inner eighth (no parallax there); needs a circle */
} pf_tracker_config;

/* What the last frame tells of the scene, of the pixels inside the circle and the mask. */
typedef struct pf_scene_measures {
    uint32_t pixels;            /* looked at: every second row of a small level of the pyramid */
    uint32_t mean_q8;           /* grey */
    uint32_t low, median, high; /* grey: 5th, 50th, 95th percentile */
    uint32_t saturated_q15;     /* share of pixels at 250 and above */
    uint32_t texture_q8;        /* mean difference of the two neighbours in a row, grey */
    uint32_t tracked;           /* tracks found again */
    uint32_t enough;            /* so many are enough: 60, less where max_tracks is below 240 */
    uint32_t sextants;          /* sixths of the picture around the circle's centre with such a track */
    uint32_t motion_q16;        /* their median displacement, px; 0 with fewer than 8 of them */
    uint32_t drift_q16;         /* median displacement over the last whole window of PF_SCENE_WINDOW frames; UINT32_MAX
                                 * = not known: fewer than 8 tracks lived through it */
    uint32_t outward, inward, moved; /* tracks that moved along the radius, and at all */
    uint32_t static_blocks;          /* blocks of 8 x 8 px found to stand still */
} pf_scene_measures;

#define PF_SCENE_WINDOW 8u

typedef struct pf_tracker_stats { /* of the last frame */
    uint32_t live;                /* tracks now alive, new ones included */
    uint32_t tracked, lost, detected;
    uint32_t lost_by[PF_TRACK_REASONS];  /* by pf_track_reason */
    uint32_t age_median, quality_median; /* of the tracks found again; 0 when there are none */
    pf_scene_measures scene;
} pf_tracker_stats;

/* Opaque; lives in the caller's workspace. */
typedef struct pf_tracker pf_tracker;

/* Bytes of workspace for this configuration; 0 if it is out of range. 1280x800 with the defaults: 1.2 MB. */
size_t pf_tracker_workspace_size(const pf_tracker_config *config);

/* Returns PF_OK and *tracker (inside `workspace`); PF_ERR_ARGUMENT (a bound is violated; nothing written);
 * PF_ERR_SPACE (size < pf_tracker_workspace_size). */
pf_status pf_tracker_init(pf_tracker **tracker, const pf_tracker_config *config, void *workspace, size_t size);

/* The stages of one frame, in the order in which pf_tracker_frame runs them; for stage timers. */
typedef enum pf_tracker_stage {
    PF_STAGE_PYRAMID = 0,
    PF_STAGE_TRACK = 1,
    PF_STAGE_DETECT = 2,
    PF_STAGES = 3,
} pf_tracker_stage;

/* Tracks from the previous frame into `frame`, then fills empty cells with new corners.
 * `frame` has the configured size and must stay valid and unchanged until the next call of pf_tracker_frame or
 * pf_tracker_reset returns (it is the next frame's reference; nothing is copied).
 * `clock` (may be NULL) is read between stages, nanoseconds; stage_ns[PF_STAGES] (may be NULL) gets the times.
 * A track that is not found where it was sought first is sought once more from the top of the pyramid; beyond that
 * there are max_tracks / 2 further attempts a frame, the oldest tracks' first: at worst 2.5 attempts a track, usually
 * one. Returns PF_OK or PF_ERR_ARGUMENT (nothing changed). */
pf_status pf_tracker_frame(pf_tracker *tracker, const pf_image *frame, uint64_t (*clock)(void), uint64_t *stage_ns);

/* What is expected of a track in the next frame. */
typedef struct pf_expected {
    pf_point_q16 at;     /* x = PF_NO_GUESS: nothing */
    int32_t warp_q16[4]; /* how its surroundings are distorted from this frame to the next, row-major; identity = not */
} pf_expected;
#define PF_NO_GUESS INT32_MIN

/* Says what is expected of the tracks of the table: expected[n] in the order of pf_tracker_tracks. A hint: each track
 * starts from whichever of this, its own last move and its old place looks most like it at a coarse level, and is tried
 * from another if that fails. With a warp, a track that does not look like the last frame's patch any more may still be
 * found by its template, warped so: at high speed in a narrow pipe a patch grows by a sixth from frame to frame.
 * PF_ERR_ARGUMENT: n is not the table's. */
pf_status pf_tracker_expect(pf_tracker *tracker, const pf_expected *expected, uint32_t n);

#define PF_WAY_USUAL ((int64_t)1 << 23) /* half a radius: two steps of keyframes a quarter of it apart */
#define PF_WAY_MOST  ((int64_t)1 << 25) /* two radii */

/* Says what is foreseen from the next frame on: what of a tube's wall will have left the picture when the camera has
 * driven on by `way_q24` radii, PF_WAY_MOST at most, is too late for new tracks to begin on, as long as the wall comes
 * out towards the rim and 12 tracks at least were found again. The tube's axis as of pf_wall_axis_of, each number
 * 0.6 at most; NULL: the optical axis. It holds until it is called again, or pf_tracker_reset; before: PF_WAY_USUAL,
 * NULL. Needs a lens and a circle. */
void pf_tracker_foresee(pf_tracker *tracker, int64_t way_q24, const int64_t axis[4]);

/* The table after the last frame: live tracks (max_tracks at most) and those lost in it (as many again at most), by
 * ascending id. Valid until the next call. */
const pf_track *pf_tracker_tracks(const pf_tracker *tracker, uint32_t *n);
const pf_tracker_stats *pf_tracker_last_stats(const pf_tracker *tracker);

/* Gives up the live tracks in these rows of the table, each named once: they are lost in this frame, for
 * PF_TRACK_DRIFT. Rows beyond the table and tracks already lost are left as they are. */
void pf_tracker_give_up(pf_tracker *tracker, const uint16_t *rows, uint32_t n);

/* Forgets all tracks, and what was foreseen (a break in the video). Ids go on; none is reused. The parts found to stand
 * still stay masked: dirt on the lens outlives a break; what is gone is released as the picture moves on. */
void pf_tracker_reset(pf_tracker *tracker);

/* Bearings: unit rays of track positions, from the table of rays. Items outside the image or the camera's domain get
 * (0, 0, 0). Integers only. */
void pf_track_bearings(const pf_camera_rays *camera, const pf_track *tracks, uint32_t n, pf_ray_q30 *rays);

/* Projects a ray by the camera in integers, a pf_camera_fixed; false beyond its domain. A pf_ray_project. */
bool pf_track_project(const void *fixed, const pf_ray_q30 *ray, pf_point_q16 *at);

/* The lens for pf_tracker_config: both are borrowed. */
pf_track_lens pf_track_lens_of(const pf_camera_rays *rays, const pf_camera_fixed *fixed);

/* --- Prediction ---------------------------------------------------------------------------------------------------
 * Where the tracks will be in the next frame, from the last motion, the encoder and the roll: rotation, then a drive
 * along a tube, each track with its own distance from the camera's path. For pf_tracker_expect. */
typedef struct pf_motion_hints { /* with a frame; a reading counts only if its has_ flag is set */
    bool has_encoder, has_roll;
    int64_t encoder;
    int32_t roll_urad; /* about the optical axis, 0 = image y axis down; rises as the picture turns from y to x */
    uint32_t frames;   /* since the frame before it: dropped ones + 1; 0 counts as 1 */
} pf_motion_hints;

#define PF_FALL_UNKNOWN INT32_MIN

typedef struct pf_predictor { /* private */
    uint32_t max_tracks, n;
    pf_motion_hints last;
    bool is_known, has_per_count;
    int32_t turn[9];       /* rotation in one frame, Q30 */
    int32_t forward;       /* median fall of the cotangents in one frame, Q16 */
    int64_t per_count_q30; /* the same for each encoder count */
    uint64_t *id;
    pf_ray_q30 *ray;
    int32_t *fall;                  /* of each row of the table, in one frame */
    pf_ray_q30 *from, *to, *driven; /* scratch */
    uint32_t *value;
    uint16_t *pair;
} pf_predictor;

/* Bytes of workspace for a tracker of so many tracks. */
#define PF_PREDICTOR_BYTES(max_tracks) (70u * (size_t)(max_tracks))

/* The workspace is aligned to 8 and stays the caller's. PF_ERR_ARGUMENT: max_tracks is not 1..2048; PF_ERR_SPACE. Call
 * it again after pf_tracker_reset. */
pf_status pf_predictor_init(pf_predictor *predictor, uint32_t max_tracks, void *workspace, size_t size);

/* Before the first frame: one encoder count moves the camera on by so much of the pipe's radius, Q5.27. */
void pf_predictor_assume(pf_predictor *predictor, int32_t radii_per_count_q27);

/* Learns from a frame just tracked: tracks[n], rays[n] are its table and bearings. */
void pf_predictor_learn(pf_predictor *predictor, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                        const pf_motion_hints *now);

/* Fills expected[n] for pf_tracker_expect, for the same table; `next` comes with the frame that follows. */
void pf_predictor_guess(const pf_predictor *predictor, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                        const pf_motion_hints *next, pf_ray_project project, const void *camera, pf_expected *expected);

/* The way, Q24 radii, of so many encoder counts that are foreseen as of the frame that comes with `next`; 0: it is not
 * known what a count means, or there is no reading to foresee by: none, or a leap of over four radii a frame. */
int64_t pf_predictor_way(const pf_predictor *predictor, const pf_motion_hints *next, uint64_t counts);

/* --- The wall -----------------------------------------------------------------------------------------------------
 * Tracks that walk off it. In a light that goes with the camera, relief that shines along with the paint moves like a
 * wall a little nearer; one track alone cannot tell. All of them tell how the camera moved in its round tube. */
typedef struct pf_wall_axis { /* private: of the tube, as seen where a stride began */
    int64_t at[4];
    int64_t known[4][4]; /* of it, as information, in units of ... */
    int64_t variance;    /* ... this; 0: nothing is known */
} pf_wall_axis;

typedef struct pf_wall_list { /* private: tracks of a frame */
    uint32_t n;
    uint64_t *id; /* ascending */
    pf_ray_q30 *ray;
    int32_t *off; /* how far each has walked since its first sight, three numbers: its cotangent, its azimuth; and what
                   * its cotangent fell, Q24 */
} pf_wall_list;

typedef struct pf_wall { /* private */
    uint32_t max_tracks;
    uint32_t frames;     /* of the stride so far */
    bool ends;           /* it ends with the last of them */
    int64_t motion[10];  /* in it; the last four are the tube's axis */
    pf_wall_axis before; /* as was known when it began, */
    pf_wall_axis axis;   /* and now */
    pf_wall_list from;   /* the frame with which it began, */
    pf_wall_list now;    /* and the last */
    uint32_t light_q16;  /* the part of what tracks walk off alone that is the light's doing */
    int64_t *scratch;
    uint32_t *value;
    uint16_t *pair;
} pf_wall;

/* How far a track may walk off, less what pf_wall_settle takes back: 1 px, Q16. */
#define PF_WALL_MOST_Q16 65536u

/* Bytes of workspace for a tracker of so many tracks. */
#define PF_WALL_BYTES(max_tracks) (72u * (size_t)(max_tracks) + 9216u)

/* The workspace is aligned to 8 and stays the caller's. PF_ERR_ARGUMENT: max_tracks is not 1..2048; PF_ERR_SPACE. Call
 * it again after pf_tracker_reset. */
pf_status pf_wall_init(pf_wall *wall, uint32_t max_tracks, void *workspace, size_t size);

/* Learns from a frame just tracked: tracks[n], rays[n] are its table and bearings. Puts into astray[] (max_tracks) the
 * rows of tracks that have walked off the wall by `most_q16` px and by three times the median of all, less what
 * pf_wall_settle takes back, unless their neighbours do alike: then that is where the wall is. Returns how many. For
 * pf_tracker_give_up. */
uint32_t pf_wall_check(pf_wall *wall, const pf_track *tracks, const pf_ray_q30 *rays, uint32_t n,
                       pf_ray_project project, const void *camera, uint32_t most_q16, uint16_t *astray);

/* The places of a keyframe: of what each of tracks[n], a copy of the table last checked, has walked off and its seven
 * nearest neighbours have not, takes back the part that is the light's doing by the median of all, at most half, and
 * from 63 degrees off the axis on up to five sixths: there the light comes to stand square on the wall. What they walk
 * off alike is the wall's own shape and stays. The tracker goes on from where it found them. Cost: 20 n^2
 * instructions. */
void pf_wall_settle(const pf_wall *wall, pf_track *tracks, uint32_t n, pf_ray_project project, const void *camera);

/* Where the tube's axis is, Q24 radii: through (axis[0], axis[1]) + z (axis[2], axis[3]) in the camera's frame as that
 * was where the last stride began that could be fitted, a twelfth of a radius or one frame ago; longer where the tracks
 * have been too few since. False, and nothing written, where the offsets, the first two, were not known to a 32nd then;
 * of the slopes nothing is claimed. */
bool pf_wall_axis_of(const pf_wall *wall, int64_t axis[4]);

/* --- States of the scene --------------------------------------------------------------------------------------------
 * Flags with hysteresis, from a frame's measures. What the picture cannot tell (dark, covered) the encoder does. */
typedef enum pf_scene_flag {
    PF_SCENE_STANDING = 1,      /* median motion below 0.5 px over PF_SCENE_WINDOW frames */
    PF_SCENE_REVERSING = 2,     /* what is seen moves towards the centre: the camera, looking ahead, goes back */
    PF_SCENE_DARK = 4,          /* nothing is lit, and no lamp is known to be on */
    PF_SCENE_COVERED = 8,       /* nothing to see though there is light: no contrast; or dark with the lamp on */
    PF_SCENE_OVEREXPOSED = 16,  /* over a quarter of the picture is saturated */
    PF_SCENE_WEAK_TEXTURE = 32, /* too few tracks, or in fewer than 4 of 6 sextants, and none of the three above */
    PF_SCENE_ENCODER = 64,      /* the encoder contradicts the picture, seen ahead: it counts the other way, or stands
                                 * while the picture moves along the radius. Wheels that slip are not told */
} pf_scene_flag;
#define PF_SCENE_FLAGS 7u

typedef struct pf_scene_hints { /* what else is known of the frame */
    bool has_lamp, lamp_on;
    bool has_encoder;
    int64_t encoder; /* forward is positive */
} pf_scene_hints;

typedef struct pf_scene { /* private; zero-initialise */
    uint32_t flags;
    uint8_t count[PF_SCENE_FLAGS]; /* frames that have spoken for a change */
    bool have_encoder;
    int64_t encoder;
    uint32_t still; /* frames in which the encoder has not moved */
} pf_scene;

/* Takes one frame's measures; returns the flags now in force. */
uint32_t pf_scene_update(pf_scene *scene, const pf_scene_measures *measures, const pf_scene_hints *hints);

/* --- Keyframe choice (RECONSTRUCTION section 6) --------------------------------------------------------------------
 * A frame becomes a keyframe when the encoder has moved `step_counts` since the last one; without an encoder, when the
 * rotation-compensated median angle between bearings of common tracks reaches `parallax` (so too while an encoder
 * stands for PF_SCENE_WINDOW frames: it may be stuck); when fewer than `min_common` tracks are shared with the last
 * keyframe, unless the scene is dark, covered or without texture; and when the states of the scene have for 30 frames
 * not been those of the last keyframe. */
typedef enum pf_keyframe_cause {
    PF_KEYFRAME_NO = 0,
    PF_KEYFRAME_FIRST = 1,
    PF_KEYFRAME_ENCODER = 2,
    PF_KEYFRAME_PARALLAX = 3,
    PF_KEYFRAME_FEW_COMMON = 4,
    PF_KEYFRAME_STATE = 5,
} pf_keyframe_cause;

typedef struct pf_keyframe_config { /* zero = default in brackets */
    uint32_t step_counts;           /* encoder counts between keyframes; 0 = do not use the encoder */
    uint32_t parallax_urad;         /* micro-radians [174533 = 10 degrees] */
    uint32_t min_common;   /* forced below so many common tracks [100], or below half of what the last keyframe had
                            * where that is less: weak texture alone must not force one at every frame. Forced as well
                            * when there are over twice as many tracks as the last keyframe had, and 16. Tracks that
                            * have not lived 2 frames count in neither. After a keyframe with fewer tracks than this
                            * the next one so forced waits, each time twice as long, up to 64 frames, and until the
                            * encoder moves */
    uint32_t min_interval; /* frames, at least so many between keyframes [2] */
} pf_keyframe_config;

typedef struct pf_keyframe_state { /* private */
    uint32_t max_tracks;
    uint32_t n, young; /* live tracks of the last keyframe, ids ascending; the last `young` of them may be noise */
    uint32_t frames_since, wait, still, differs;
    uint32_t scene; /* of the last keyframe */
    bool have_encoder, had_encoder, started;
    int64_t encoder, encoder_before; /* of the last keyframe, of the last frame */
    uint64_t *id;
    pf_ray_q30 *ray;
    pf_ray_q30 *from, *to; /* scratch: common bearings */
    uint32_t *chord;       /* scratch: squared chords for the median */
} pf_keyframe_state;

/* Bytes of workspace for a tracker of so many tracks. */
#define PF_KEYFRAME_BYTES(max_tracks) (48u * (size_t)(max_tracks))

/* The workspace is aligned to 8 and stays the caller's. PF_ERR_ARGUMENT: max_tracks is not 1..2048; PF_ERR_SPACE. */
pf_status pf_keyframe_init(pf_keyframe_state *state, uint32_t max_tracks, void *workspace, size_t size);

/* After pf_tracker_reset: the next frame is the first. */
void pf_keyframe_reset(pf_keyframe_state *state);

/* Decides for the current frame and, when it becomes a keyframe, makes it the new reference.
 * tracks[n], rays[n]: the table and its bearings, ids ascending. encoder: NULL when there is none. scene: the states in
 * force, pf_scene_flag.
 * *common (may be NULL) gets the number of tracks shared with the last keyframe. */
pf_keyframe_cause pf_keyframe_decide(pf_keyframe_state *state, const pf_keyframe_config *config, const pf_track *tracks,
                                     const pf_ray_q30 *rays, uint32_t n, const int64_t *encoder, uint32_t scene,
                                     uint32_t *common);

/* Encoder counts from the frame that comes, of that reading, until the third keyframe from then on, itself included;
 * as it drives now, and where the encoder alone decides. 0: there are none to decide by, or more than 2^24 a frame. */
uint64_t pf_keyframe_third(const pf_keyframe_state *state, const pf_keyframe_config *config, int64_t encoder);

#ifdef __cplusplus
}
#endif
#endif
