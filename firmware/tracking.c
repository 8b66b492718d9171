#include "tracking.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/picture.h"

struct pf_tracking {
    const pf_daemon *daemon;
    pf_tracker *tracker;
    void *workspace;
    void *camera_workspace, *bearing_workspace;
    const pf_camera_fixed *camera; /* NULL = no profile: no prediction, no parallax */
    const pf_camera_rays *bearings;
    pf_predictor predictor;
    pf_wall wall;
    void *motion_workspace, *wall_workspace;
    uint16_t *astray; /* rows of tracks that have walked off the wall */
    pf_ray_q30 *rays; /* of the whole table: live and just lost tracks */
    pf_expected *expected;
    pf_keyframe_config choice;
    pf_keyframe_state choice_state;
    void *choice_workspace;
    pf_scene scene;
    pf_msg_tracking since; /* the last keyframe */
    uint64_t sequence;     /* of the last frame */
    bool has_sequence;
};

double pf_tracking_circle(const pf_daemon *d, double *u, double *v)
{
    const pf_config *c = &d->config;
    if (c->tracker.circle_radius > 0) {
        *u = c->tracker.circle_u;
        *v = c->tracker.circle_v;
        return c->tracker.circle_radius;
    }
    *u = d->has_profile ? d->profile.camera.circle_u : 0.0;
    *v = d->has_profile ? d->profile.camera.circle_v : 0.0;
    return d->has_profile ? d->profile.camera.circle_radius : 0.0;
}

/* ---- opening */

/* Nothing is known of the motion but, with an encoder and a nominal diameter, what a count means. */
static void forget_motion(pf_tracking *p)
{
    const pf_config *c = &p->daemon->config;
    const double radius = c->survey.nominal_diameter_mm / 2e3;
    const uint32_t tracks = c->tracker.max_tracks;
    (void)pf_predictor_init(&p->predictor, tracks, p->motion_workspace, PF_PREDICTOR_BYTES(tracks));
    (void)pf_wall_init(&p->wall, tracks, p->wall_workspace, PF_WALL_BYTES(tracks));
    if (radius > 0 && c->encoder.metres_per_count != 0)
        pf_predictor_assume(&p->predictor, (int32_t)lround(c->encoder.metres_per_count / radius * 1073741824.0 / 8));
}

/* The camera in integers and its table of rays. Where the diameter is known, it sees the wall from its centre: a pupil
 * that moves by 3 mm would make all bearings move as on a wall that is none. */
static bool open_camera(pf_tracking *p, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const double radius = d->config.survey.nominal_diameter_mm / 2e3;
    if (!d->has_profile)
        return true;
    pf_camera camera = d->profile.camera;
    if (radius > 0 && pf_camera_in_tube(&d->profile.camera, radius, &camera) != PF_OK)
        pf_log(PF_LOG_WARNING,
               "tracking: the moving pupil of the profile's lens is too much for a pipe of %g mm: left out",
               d->config.survey.nominal_diameter_mm);
    size_t size = pf_camera_fixed_workspace_size(&camera);
    if (size == 0) {
        (void)snprintf(error, n, "the profile's lens is beyond the range of fixed point");
        return false;
    }
    p->camera_workspace = aligned_alloc(16, (size + 15) / 16 * 16);
    if (p->camera_workspace != NULL && pf_camera_fixed_init(&p->camera, &camera, p->camera_workspace, size) == PF_OK) {
        uint32_t step = pf_camera_rays_step(p->camera);
        size = pf_camera_rays_workspace_size(p->camera, step);
        p->bearing_workspace = aligned_alloc(16, (size + 15) / 16 * 16);
        if (p->bearing_workspace != NULL &&
            pf_camera_rays_init(&p->bearings, p->camera, step, p->bearing_workspace, size) == PF_OK)
            return true;
    }
    (void)snprintf(error, n, "no memory for the camera's tables");
    return false;
}

static bool open_tracker(pf_tracking *p, const pf_image *mask, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const pf_config *c = &d->config;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    double u, v, radius = pf_tracking_circle(d, &u, &v);
    /* A circle further out than this has no border in any image, and would not fit into Q16.16. */
    if (!(radius <= 2.0 * PF_IMAGE_SIZE_MAX && fabs(u) <= PF_IMAGE_SIZE_MAX && fabs(v) <= PF_IMAGE_SIZE_MAX)) {
        (void)snprintf(error, n, "image circle (%g, %g), radius %g: must be within %u px, the radius within %u", u, v,
                       radius, PF_IMAGE_SIZE_MAX, 2 * PF_IMAGE_SIZE_MAX);
        return false;
    }
    pf_tracker_config t = {.width = info->width,
                           .height = info->height,
                           .max_tracks = c->tracker.max_tracks,
                           .levels = c->tracker.levels,
                           .window = c->tracker.window,
                           .iterations = c->tracker.iterations,
                           .cell = c->tracker.cell,
                           .min_eigen = c->tracker.min_eigen,
                           .fb_q16 = (uint32_t)lround(c->tracker.fb_px * 65536.0),
                           .min_zncc_q15 = (uint32_t)lround(c->tracker.min_zncc * 32768.0),
                           .noise_q8 = (uint32_t)lround(c->tracker.noise * 256.0),
                           .circle = {(int32_t)lround(u * 65536.0), (int32_t)lround(v * 65536.0)},
                           .circle_radius_q16 = (uint32_t)lround(radius * 65536.0),
                           .no_static_mask = !c->tracker.static_mask,
                           .polar = c->tracker.cells == PF_CELLS_POLAR,
                           .has_wall = p->camera != NULL && c->tracker.prediction,
                           .lens = p->camera != NULL ? pf_track_lens_of(p->bearings, p->camera) : (pf_track_lens){0},
                           .mask = mask->data ? mask : NULL};
    size_t size = pf_tracker_workspace_size(&t);
    if (t.polar && radius <= 0) {
        (void)snprintf(error, n, "tracker.cells = polar: needs an image circle: tracker.circle_radius or a profile");
        return false;
    }
    if (size == 0) {
        (void)snprintf(error, n, "the tracker cannot work with frames of %u x %u and these settings of [tracker]",
                       info->width, info->height);
        return false;
    }
    p->workspace = aligned_alloc(16, (size + 15) / 16 * 16);
    p->choice_workspace = aligned_alloc(16, (PF_KEYFRAME_BYTES(t.max_tracks) + 15) / 16 * 16);
    p->motion_workspace = aligned_alloc(16, (PF_PREDICTOR_BYTES(t.max_tracks) + 15) / 16 * 16);
    p->wall_workspace = aligned_alloc(16, (PF_WALL_BYTES(t.max_tracks) + 15) / 16 * 16);
    p->astray = calloc(t.max_tracks, sizeof *p->astray);
    p->rays = calloc(2 * (size_t)t.max_tracks, sizeof *p->rays);
    p->expected = calloc(2 * (size_t)t.max_tracks, sizeof *p->expected);
    if (p->workspace == NULL || p->choice_workspace == NULL || p->motion_workspace == NULL || p->rays == NULL ||
        p->expected == NULL || p->wall_workspace == NULL || p->astray == NULL ||
        pf_tracker_init(&p->tracker, &t, p->workspace, size) != PF_OK ||
        pf_keyframe_init(&p->choice_state, t.max_tracks, p->choice_workspace, PF_KEYFRAME_BYTES(t.max_tracks)) !=
            PF_OK) {
        (void)snprintf(error, n, "no memory for the tracker");
        return false;
    }
    return true;
}

/* The tracker, with the user's mask. */
static bool open_tracking(pf_tracking *p, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    const char *path = d->config.tracker.mask;
    pf_image mask = {0};
    uint8_t *pixels = NULL;
    char why[512];
    bool ok = false;
    if (path[0] == '\0')
        return open_tracker(p, &mask, error, n);
    if (pf_picture_load(path, &mask.width, &mask.height, &pixels, why, sizeof why) != PF_OK) {
        (void)snprintf(error, n, "tracker.mask: %s", why);
    } else if (mask.width != info->width || mask.height != info->height) {
        (void)snprintf(error, n, "tracker.mask: %s: %u x %u pixels, but the camera gives %u x %u", path, mask.width,
                       mask.height, info->width, info->height);
    } else {
        mask.data = pixels;
        mask.stride = mask.width;
        ok = open_tracker(p, &mask, error, n);
    }
    free(pixels);
    return ok;
}

static void open_choice(pf_tracking *p)
{
    const pf_config *c = &p->daemon->config;
    double step_mm = c->keyframe.step_mm > 0 ? c->keyframe.step_mm : 0.25 * c->survey.nominal_diameter_mm / 2;
    double per_count_mm = fabs(c->encoder.metres_per_count) * 1e3;
    p->choice.parallax_urad = (uint32_t)lround(c->keyframe.parallax_deg * (3.14159265358979323846 / 180.0) * 1e6);
    p->choice.min_common = c->keyframe.min_common;
    p->choice.min_interval = c->keyframe.min_interval;
    if (per_count_mm > 0 && step_mm > 0) {
        double counts = round(step_mm / per_count_mm);
        p->choice.step_counts = counts < 1 ? 1 : counts > 4e9 ? 4000000000u : (uint32_t)counts;
        pf_log(PF_LOG_INFO, "a keyframe every %u encoder counts (%.3g mm)", p->choice.step_counts,
               p->choice.step_counts * per_count_mm);
    } else if (p->camera != NULL) {
        pf_log(PF_LOG_INFO, "a keyframe every %.3g degrees of parallax", c->keyframe.parallax_deg);
    } else {
        pf_log(PF_LOG_WARNING, "neither encoder nor profile: keyframes by common tracks only");
    }
}

bool pf_tracking_open(pf_tracking **tracking, const pf_daemon *daemon, char *error, size_t n)
{
    pf_tracking *p = calloc(1, sizeof *p);
    if (p == NULL) {
        (void)snprintf(error, n, "no memory for the tracker");
        return false;
    }
    p->daemon = daemon;
    if (!open_camera(p, error, n) || !open_tracking(p, error, n)) {
        pf_tracking_close(p);
        return false;
    }
    open_choice(p);
    forget_motion(p);
    *tracking = p;
    return true;
}

void pf_tracking_close(pf_tracking *p)
{
    if (p == NULL)
        return;
    free(p->expected);
    free(p->rays);
    free(p->astray);
    free(p->wall_workspace);
    free(p->motion_workspace);
    free(p->choice_workspace);
    free(p->workspace);
    free(p->bearing_workspace);
    free(p->camera_workspace);
    free(p);
}

/* ---- a frame */

/* A gap in the sequence is dropped frames; after a long one nothing can be found again. */
static void check_gap(pf_tracking *p, pf_shot *shot)
{
    const uint64_t sequence = shot->frame.sequence, before = p->sequence;
    const bool is_later = sequence > before;
    p->sequence = sequence;
    shot->missing = p->has_sequence && is_later ? sequence - before - 1 : 0;
    if (p->has_sequence && (!is_later || shot->missing > p->daemon->config.tracker.reset_gap)) {
        pf_tracker_reset(p->tracker);
        pf_keyframe_reset(&p->choice_state);
        forget_motion(p);
        (void)snprintf(shot->break_reason, sizeof shot->break_reason, "gap of %llu frames",
                       (unsigned long long)shot->missing);
        pf_log(PF_LOG_WARNING, "%s before frame %llu: tracks begin anew", shot->break_reason,
               (unsigned long long)sequence);
    }
    p->has_sequence = true;
}

static pf_motion_hints motion_hints(const pf_shot *shot)
{
    const pf_msg_telemetry *t = &shot->telemetry;
    const bool has_roll = t->has_attitude && fabs((double)t->roll_rad) < 1000.0; /* not NaN */
    return (pf_motion_hints){.has_encoder = t->has_encoder,
                             .has_roll = has_roll,
                             .encoder = t->encoder_count,
                             .roll_urad = has_roll ? (int32_t)lround((double)t->roll_rad * 1e6) : 0,
                             .frames = shot->missing < 1000 ? (uint32_t)shot->missing + 1 : 1000};
}

/* Tells the tracker where its tracks should be in this frame. */
static void expect(pf_tracking *p, const pf_motion_hints *hints)
{
    uint32_t n;
    const pf_track *tracks = pf_tracker_tracks(p->tracker, &n);
    pf_predictor_guess(&p->predictor, tracks, p->rays, n, hints, pf_track_project, p->camera, p->expected);
    (void)pf_tracker_expect(p->tracker, p->expected, n);
}

/* Tells the tracker what of the wall will be gone before the third keyframe. */
static void look_ahead(pf_tracking *p, const pf_motion_hints *hints)
{
    const uint64_t counts = hints->has_encoder ? pf_keyframe_third(&p->choice_state, &p->choice, hints->encoder) : 0;
    const int64_t way = pf_predictor_way(&p->predictor, hints, counts);
    int64_t axis[4];
    pf_tracker_foresee(p->tracker, way > 0 ? way : PF_WAY_USUAL, pf_wall_axis_of(&p->wall, axis) ? axis : NULL);
}

static uint32_t update_scene(pf_tracking *p, const pf_shot *shot)
{
    const pf_msg_telemetry *t = &shot->telemetry;
    const double per_count = p->daemon->config.encoder.metres_per_count;
    const pf_scene_hints hints = {.has_lamp = t->has_lamp,
                                  .lamp_on = t->lamp > 0.01f,
                                  .has_encoder = t->has_encoder && per_count != 0,
                                  .encoder =
                                      per_count < 0 ? (int64_t)(0u - (uint64_t)t->encoder_count) : t->encoder_count};
    const uint32_t before = p->scene.flags, now = pf_scene_update(&p->scene, &shot->stats.scene, &hints);
    static const char *const words[PF_SCENE_FLAGS] = {"standing still",
                                                      "reversing",
                                                      "dark",
                                                      "lens covered",
                                                      "over-exposed",
                                                      "weak texture",
                                                      "encoder contradicts the picture"};
    for (uint32_t i = 0; i < PF_SCENE_FLAGS; i++)
        if ((before ^ now) >> i & 1u)
            pf_log((now >> i & 1u) && 1u << i == PF_SCENE_ENCODER ? PF_LOG_WARNING : PF_LOG_INFO, "frame %llu: %s%s",
                   (unsigned long long)shot->frame.sequence, now >> i & 1u ? "" : "no longer ", words[i]);
    return now;
}

void pf_tracking_count(pf_msg_tracking *sum, const pf_tracker_stats *s, uint32_t scene)
{
    sum->scene = scene;
    sum->frames++;
    for (uint32_t i = 0; i < PF_SCENE_FLAGS; i++)
        sum->state_frames[i] += scene >> i & 1u;
    sum->tracked += s->tracked;
    sum->detected += s->detected;
    for (uint32_t i = 0; i < PF_TRACK_REASONS; i++)
        sum->lost_by[i] += s->lost_by[i];
    sum->age_median = s->age_median;
    sum->quality_median = s->quality_median;
    sum->static_blocks = s->scene.static_blocks;
}

void pf_tracking_shot(void *tracking, void *item)
{
    pf_tracking *p = tracking;
    pf_shot *shot = item;
    const bool predicts = p->camera != NULL && p->daemon->config.tracker.prediction;
    const uint64_t start = pf_now();
    uint32_t n;

    shot->break_reason[0] = '\0';
    check_gap(p, shot);
    const pf_motion_hints hints = motion_hints(shot);
    if (predicts) {
        expect(p, &hints);
        look_ahead(p, &hints);
    }
    (void)pf_tracker_frame(p->tracker, &shot->frame.image, pf_now, shot->stage_ns);
    const pf_track *tracks = pf_tracker_tracks(p->tracker, &n);
    if (p->camera != NULL)
        pf_track_bearings(p->bearings, tracks, n, p->rays);
    if (predicts) {
        const uint32_t astray =
            pf_wall_check(&p->wall, tracks, p->rays, n, pf_track_project, p->camera, PF_WALL_MOST_Q16, p->astray);
        pf_tracker_give_up(p->tracker, p->astray, astray);
        pf_predictor_learn(&p->predictor, tracks, p->rays, n, &hints);
    }
    shot->stats = *pf_tracker_last_stats(p->tracker);
    const uint32_t scene = update_scene(p, shot);
    shot->cause =
        pf_keyframe_decide(&p->choice_state, &p->choice, tracks, p->rays, n,
                           shot->telemetry.has_encoder ? &shot->telemetry.encoder_count : NULL, scene, &shot->common);
    pf_tracking_count(&p->since, &shot->stats, scene);
    shot->tracking = p->since;
    if (shot->cause != PF_KEYFRAME_NO) {
        memcpy(shot->tracks, tracks, n * sizeof *tracks);
        shot->n_tracks = n;
        if (predicts)
            pf_wall_settle(&p->wall, shot->tracks, n, pf_track_project, p->camera);
        memset(&p->since, 0, sizeof p->since);
    }
    shot->track_ns = pf_now() - start;
}
