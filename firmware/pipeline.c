#include "pipeline.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "clock.h"
#include "log.h"
#include "pipefish/drivers/jpeg.h"
#include "pipefish/drivers/sha256.h"
#include "utf8.h"

#define PREVIEW_OVERHEAD 128u /* most bytes of a preview message without its JPEG: six numbers and their tags */
#define NEXT_TIMEOUT_MS  100u /* how long a stop may go unnoticed while the camera is silent */
#define START_MAX        (PF_PROFILE_BINARY_MAX + PF_CONFIG_KEYS_MAX * PF_CONFIG_LINE_MAX + 4096u)

struct pf_pipeline {
    pf_daemon *daemon;
    pf_courier *courier;
    pthread_t thread;
    bool is_started;
    _Atomic bool is_done;
    pf_tracker *tracker;
    void *workspace;
    void *camera_workspace, *bearing_workspace;
    const pf_camera_rays *bearings; /* NULL = no profile */
    pf_ray_q30 *rays;               /* of the whole table: live and just lost tracks */
    pf_keyframe_config choice;
    pf_keyframe_state choice_state;
    pf_jpeg *jpeg;
    uint8_t preview[PF_PREVIEW_MAX];
    uint64_t preview_due;
    uint32_t preview_quality, preview_shrink; /* of the last preview */
    uint32_t next_index;
    uint32_t boots;
    char break_reason[PF_BREAK_REASON_MAX]; /* "" = tracks go on */
    pf_frame previous;                      /* the tracker's reference */
    bool has_previous;
    bool has_failed;
};

static double circle_radius(const pf_daemon *d, double *u, double *v)
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

/* What libjpeg-turbo's own bound allows, two bytes a pixel in whole blocks; the pages that a JPEG does not reach are
 * never touched, so they cost no memory. */
static size_t jpeg_max(const pf_camera_info *info)
{
    return 2 * (((size_t)info->width + 15) & ~(size_t)15) * (((size_t)info->height + 15) & ~(size_t)15) + 2048;
}

size_t pf_pipeline_object_max(const pf_daemon *d)
{
    size_t keyframe = PF_MSG_KEYFRAME_MAX(d->config.tracker.max_tracks, jpeg_max(d->camera.ops->info(d->camera.self)));
    return keyframe > START_MAX ? keyframe : START_MAX;
}

static bool open_tracker(pf_pipeline *p, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const pf_config *c = &d->config;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    double u, v, radius = circle_radius(d, &u, &v);
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
                           .circle_radius_q16 = (uint32_t)lround(radius * 65536.0)};
    size_t size = pf_tracker_workspace_size(&t);
    if (size == 0) {
        (void)snprintf(error, n, "the tracker cannot work with frames of %u x %u and these settings of [tracker]",
                       info->width, info->height);
        return false;
    }
    p->workspace = aligned_alloc(16, (size + 15) / 16 * 16);
    p->rays = calloc(2 * (size_t)t.max_tracks, sizeof *p->rays);
    if (p->workspace == NULL || p->rays == NULL || pf_tracker_init(&p->tracker, &t, p->workspace, size) != PF_OK) {
        (void)snprintf(error, n, "no memory for the tracker");
        return false;
    }
    return true;
}

/* The camera's table of rays, for bearings. */
static bool open_bearings(pf_pipeline *p, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const pf_camera_fixed *fixed;
    if (!d->has_profile)
        return true;
    size_t size = pf_camera_fixed_workspace_size(&d->profile.camera);
    if (size == 0) {
        (void)snprintf(error, n, "%s: a lens beyond the range of fixed point", d->config.camera.profile);
        return false;
    }
    p->camera_workspace = aligned_alloc(16, (size + 15) / 16 * 16);
    if (p->camera_workspace != NULL &&
        pf_camera_fixed_init(&fixed, &d->profile.camera, p->camera_workspace, size) == PF_OK) {
        uint32_t step = pf_camera_rays_step(fixed);
        size = pf_camera_rays_workspace_size(fixed, step);
        p->bearing_workspace = aligned_alloc(16, (size + 15) / 16 * 16);
        if (p->bearing_workspace != NULL &&
            pf_camera_rays_init(&p->bearings, fixed, step, p->bearing_workspace, size) == PF_OK)
            return true;
    }
    (void)snprintf(error, n, "no memory for the camera's tables");
    return false;
}

static void open_choice(pf_pipeline *p)
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
    } else if (p->daemon->has_profile) {
        pf_log(PF_LOG_INFO, "a keyframe every %.3g degrees of parallax", c->keyframe.parallax_deg);
    } else {
        pf_log(PF_LOG_WARNING, "neither encoder nor profile: keyframes by common tracks only");
    }
}

static bool open_jpeg(pf_pipeline *p, char *error, size_t n)
{
    const pf_daemon *d = p->daemon;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    pf_jpeg_config j = {.width = info->width,
                        .height = info->height,
                        .quality = d->config.keyframe.jpeg_quality,
                        .preview_quality = d->config.status.preview_quality};
    j.circle_radius = circle_radius(d, &j.circle_u, &j.circle_v);
    return pf_jpeg_open(&p->jpeg, &j, error, n) == PF_OK;
}

/* The survey's start: every boot has one. */
static bool store_start(pf_pipeline *p, char *error, size_t n)
{
    pf_daemon *d = p->daemon;
    const pf_config *c = &d->config;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    uint32_t count = pf_config_keys();
    char(*text)[PF_CONFIG_LINE_MAX] = calloc(count, sizeof *text);
    const char **lines = calloc(count, sizeof *lines);
    char *tracker = calloc(count, PF_CONFIG_LINE_MAX);
    size_t tracker_n = 0;
    pf_job *job = pf_store_take(d->store);
    bool ok = false;
    pf_msg_survey_start start = {.time = {d->boot_id, pf_now()},
                                 .name = c->survey.name,
                                 .software = PF_SOFTWARE,
                                 .source = d->source,
                                 .profile = d->has_profile ? d->profile_bytes : NULL,
                                 .profile_size = d->profile_size,
                                 .metres_per_count = c->encoder.metres_per_count,
                                 .metres_per_count_sigma = c->encoder.sigma,
                                 .noise_m_per_sqrt_m = c->encoder.noise,
                                 .width = info->width,
                                 .height = info->height,
                                 .frame_rate = info->frame_rate,
                                 .nominal_diameter_m = c->survey.nominal_diameter_mm / 1e3,
                                 .config = lines,
                                 .config_count = count};
    memcpy(start.survey_id, d->survey_id, sizeof start.survey_id);
    for (uint32_t i = 0; text && lines && tracker && i < count; i++) {
        lines[i] = text[i];
        (void)pf_config_line(c, i, text[i], sizeof text[i]);
        if (strncmp(text[i], "tracker.", 8) == 0)
            tracker_n += (size_t)sprintf(tracker + tracker_n, "%s\n", text[i]);
    }
    if (text && lines && tracker && job && pf_sha256(tracker, tracker_n, start.tracker_config_sha256) == PF_OK &&
        pf_msg_encode_survey_start(&start, job->bytes, pf_store_capacity(d->store), &job->n) == PF_OK) {
        job->kind = PF_OBJECT_SURVEY_START;
        pf_store_give(d->store, job);
        ok = true;
    } else {
        (void)snprintf(error, n, "cannot make the survey's start message");
    }
    free(text);
    free(lines);
    free(tracker);
    return ok;
}

/* The end of a survey that had none when another began. */
static bool store_end_of(pf_pipeline *p, const pf_survey *before, char *error, size_t n)
{
    pf_daemon *d = p->daemon;
    pf_job *job = pf_store_take(d->store);
    pf_msg_survey_end end = {.time = {d->boot_id, pf_now()},
                             .keyframes = before->next_index,
                             .boots = before->boots,
                             .reason = "interrupted; another survey began",
                             .lost_first = before->lost_first,
                             .lost_count = before->lost_count,
                             .lost_ranges = before->lost_ranges};
    memcpy(end.survey_id, before->id, sizeof end.survey_id);
    if (job == NULL || pf_msg_encode_survey_end(&end, job->bytes, pf_store_capacity(d->store), &job->n) != PF_OK) {
        (void)snprintf(error, n, "cannot make the end of the survey before");
        return false;
    }
    pf_log(PF_LOG_WARNING,
           "survey %02x%02x%02x%02x was interrupted with %u keyframes, and its setup has changed: it ends",
           before->id[0], before->id[1], before->id[2], before->id[3], before->next_index);
    job->kind = PF_OBJECT_SURVEY_END;
    pf_store_give(d->store, job);
    return true;
}

static void release(pf_pipeline *p)
{
    pf_jpeg_close(p->jpeg);
    free(p->rays);
    free(p->bearing_workspace);
    free(p->camera_workspace);
    free(p->workspace);
    free(p);
}

static bool open_parts(pf_pipeline *p, char *error, size_t n)
{
    return open_tracker(p, error, n) && open_bearings(p, error, n) && open_jpeg(p, error, n);
}

bool pf_pipeline_can_open(pf_daemon *daemon, char *error, size_t n)
{
    pf_pipeline *p = calloc(1, sizeof *p);
    if (p == NULL) {
        (void)snprintf(error, n, "no memory");
        return false;
    }
    p->daemon = daemon;
    bool can = open_parts(p, error, n);
    release(p);
    return can;
}

bool pf_pipeline_open(pf_pipeline **pipeline, pf_daemon *daemon, pf_courier *courier, const pf_survey *survey,
                      const pf_survey *before, char *error, size_t n)
{
    pf_pipeline *p = calloc(1, sizeof *p);
    if (p == NULL) {
        (void)snprintf(error, n, "no memory");
        return false;
    }
    p->daemon = daemon;
    p->courier = courier;
    p->preview_quality = daemon->config.status.preview_quality;
    p->preview_shrink = PF_JPEG_PREVIEW_SHRINK;
    p->next_index = survey->next_index;
    p->boots = survey->boots;
    if (survey->next_index > 0) /* else no boot before came to make a keyframe */
        (void)snprintf(p->break_reason, sizeof p->break_reason, "restart");
    if (!open_parts(p, error, n) || (before->boots > 0 && !store_end_of(p, before, error, n)) ||
        !store_start(p, error, n)) {
        release(p);
        return false;
    }
    open_choice(p);
    *pipeline = p;
    return true;
}

/* ---- one frame */

static pf_msg_telemetry read_telemetry(pf_pipeline *p, const pf_frame *frame)
{
    pf_daemon *d = p->daemon;
    const pf_telemetry *t = &frame->telemetry;
    pf_msg_telemetry m = {.time = {d->boot_id, frame->time_ns},
                          .has_encoder = t->has_encoder,
                          .has_attitude = t->has_attitude,
                          .has_exposure = t->has_exposure,
                          .has_gain = t->has_gain,
                          .has_lamp = t->has_lamp,
                          .encoder_count = t->encoder_count,
                          .roll_rad = (float)t->roll_rad,
                          .pitch_rad = (float)t->pitch_rad,
                          .attitude_sigma_rad = (float)t->attitude_sigma_rad,
                          .exposure_us = t->exposure_us,
                          .gain = (float)t->gain,
                          .lamp = (float)t->lamp};
    double lamp;
    if (!m.has_encoder)
        m.has_encoder = d->gpio.ops->encoder(d->gpio.self, &m.encoder_count, &m.encoder_missed) == PF_OK;
    if (!m.has_lamp && d->gpio.ops->lamp(d->gpio.self, &lamp) == PF_OK) {
        m.has_lamp = true;
        m.lamp = (float)lamp;
    }
    if (d->gpio.ops->stopped(d->gpio.self, &m.emergency_stop) != PF_OK)
        m.emergency_stop = false;
    return m;
}

/* Makes and queues a keyframe; false if it is lost. */
static bool make_keyframe(pf_pipeline *p, const pf_frame *frame, const pf_msg_telemetry *telemetry,
                          pf_keyframe_cause cause, uint32_t common)
{
    pf_daemon *d = p->daemon;
    pf_status status;
    pf_msg_keyframe k = {.index = p->next_index,
                         .time = {d->boot_id, frame->time_ns},
                         .frame_sequence = frame->sequence,
                         .recorded_ns = frame->recorded_ns,
                         .width = frame->image.width,
                         .height = frame->image.height,
                         .jpeg_quality = d->config.keyframe.jpeg_quality,
                         .cause = cause,
                         .telemetry = *telemetry,
                         .common_tracks = common};
    pf_job *job = pf_store_take(d->store);
    if (job == NULL) {
        pf_log(PF_LOG_WARNING, "the disk is too slow: keyframe %u is dropped", k.index);
        return false;
    }
    memcpy(k.survey_id, d->survey_id, sizeof k.survey_id);
    k.tracks = pf_tracker_tracks(p->tracker, &k.n_tracks);
    status = pf_jpeg_encode(p->jpeg, &frame->image, &k.jpeg, &k.jpeg_size);
    if (status != PF_OK)
        pf_log(PF_LOG_ERROR, "keyframe %u: %s", k.index, pf_jpeg_error(p->jpeg));
    if (status == PF_OK && frame->has_sha256)
        memcpy(k.frame_sha256, frame->sha256, sizeof k.frame_sha256);
    else if (status == PF_OK)
        status = pf_sha256_image(&frame->image, k.frame_sha256);
    if (status == PF_OK) {
        status = pf_msg_encode_keyframe(&k, job->bytes, pf_store_capacity(d->store), &job->n);
        if (status != PF_OK)
            pf_log(PF_LOG_ERROR, "keyframe %u: %s", k.index, pf_status_text(status));
    }
    if (status != PF_OK) {
        pf_store_give_back(d->store, job);
        return false;
    }
    job->kind = PF_OBJECT_KEYFRAME;
    job->index = k.index;
    memcpy(job->break_reason, p->break_reason, sizeof job->break_reason);
    pf_store_give(d->store, job);
    return true;
}

static void make_preview(pf_pipeline *p, const pf_frame *frame)
{
    pf_daemon *d = p->daemon;
    uint64_t now = pf_now();
    bool is_wanted;
    size_t n;
    pf_msg_preview preview = {.time = {d->boot_id, frame->time_ns}, .frame_sequence = frame->sequence};
    pf_jpeg_preview made;
    if (d->config.status.preview_interval_ms == 0 || now < p->preview_due)
        return;
    pthread_mutex_lock(&d->counters.mutex);
    is_wanted = d->counters.link_up;
    pthread_mutex_unlock(&d->counters.mutex);
    if (!is_wanted)
        return;
    p->preview_due = now + (uint64_t)d->config.status.preview_interval_ms * 1000000u;
    if (pf_jpeg_encode_preview(p->jpeg, &frame->image, sizeof p->preview - PREVIEW_OVERHEAD, &made) != PF_OK) {
        pf_log(PF_LOG_WARNING, "preview: %s", pf_jpeg_error(p->jpeg));
        return;
    }
    if (made.quality != p->preview_quality || made.shrink != p->preview_shrink)
        pf_log(PF_LOG_WARNING, "previews are too large: from now on 1/%u of the size, quality %u", made.shrink,
               made.quality);
    p->preview_quality = made.quality;
    p->preview_shrink = made.shrink;
    preview.width = made.width;
    preview.height = made.height;
    preview.jpeg = made.bytes;
    preview.jpeg_size = made.n;
    if (pf_msg_encode_preview(&preview, p->preview, sizeof p->preview, &n) == PF_OK)
        pf_courier_preview(p->courier, p->preview, n);
}

static void release_previous(pf_pipeline *p)
{
    if (p->has_previous)
        p->daemon->camera.ops->release(p->daemon->camera.self, &p->previous);
    p->has_previous = false;
}

/* A gap in the sequence is dropped frames; after a long one nothing can be found again. Returns the frames missing. */
static uint64_t check_gap(pf_pipeline *p, const pf_frame *frame)
{
    uint64_t missing = 0;
    if (!p->has_previous)
        return 0;
    if (frame->sequence > p->previous.sequence)
        missing = frame->sequence - p->previous.sequence - 1;
    if (missing > p->daemon->config.tracker.reset_gap || frame->sequence <= p->previous.sequence) {
        pf_tracker_reset(p->tracker);
        memset(&p->choice_state, 0, sizeof p->choice_state);
        (void)snprintf(p->break_reason, sizeof p->break_reason, "gap of %llu frames", (unsigned long long)missing);
        pf_log(PF_LOG_WARNING, "%s before frame %llu: tracks begin anew", p->break_reason,
               (unsigned long long)frame->sequence);
    }
    return missing;
}

static void count_frame(pf_pipeline *p, const pf_msg_telemetry *telemetry, const uint64_t *stage_ns, uint64_t done_ns,
                        uint64_t frame_ns)
{
    pf_counters *c = &p->daemon->counters;
    const pf_tracker_stats *s = pf_tracker_last_stats(p->tracker);
    pthread_mutex_lock(&c->mutex);
    c->frames_tracked++;
    c->tracks_live = s->live;
    c->tracks_new = s->detected;
    c->tracks_lost = s->lost;
    for (int i = 0; i < PF_STAGES; i++)
        c->stage_ns[i] += stage_ns[i];
    if (frame_ns > c->frame_max_ns)
        c->frame_max_ns = frame_ns;
    c->last_ns = done_ns;
    c->telemetry = *telemetry;
    pthread_mutex_unlock(&c->mutex);
}

/* Tracks one frame, and makes a keyframe of it if it is time. The frame before is released: nobody borrows it any more.
 */
static void take_frame(pf_pipeline *p, const pf_frame *frame)
{
    pf_daemon *d = p->daemon;
    pf_counters *c = &d->counters;
    pf_msg_telemetry telemetry = read_telemetry(p, frame);
    uint64_t stage_ns[PF_STAGES] = {0}, start = pf_now(), chosen, end;
    uint64_t missing = check_gap(p, frame);
    const pf_track *tracks;
    uint32_t n, common = 0;
    pf_keyframe_cause cause;

    (void)pf_tracker_frame(p->tracker, &frame->image, pf_now, stage_ns);
    release_previous(p);
    p->previous = *frame;
    p->has_previous = true;
    tracks = pf_tracker_tracks(p->tracker, &n);
    if (p->bearings != NULL)
        pf_track_bearings(p->bearings, tracks, n, p->rays);
    cause = pf_keyframe_decide(&p->choice_state, &p->choice, tracks, p->rays, n,
                               telemetry.has_encoder ? &telemetry.encoder_count : NULL, &common);
    chosen = end = pf_now();
    if (cause != PF_KEYFRAME_NO) {
        if (make_keyframe(p, frame, &telemetry, cause, common))
            p->break_reason[0] = '\0';
        else
            pf_store_lose(d->store, p->next_index);
        p->next_index++;
        end = pf_now();
    }
    pthread_mutex_lock(&c->mutex);
    c->frames_dropped += missing;
    if (cause != PF_KEYFRAME_NO) {
        c->keyframes++;
        c->keyframe_ns += end - chosen;
    }
    pthread_mutex_unlock(&c->mutex);
    count_frame(p, &telemetry, stage_ns, end, end - start);
    make_preview(p, frame);
}

/* ---- the survey */

static void capture(pf_pipeline *p, char *reason, size_t reason_n)
{
    pf_daemon *d = p->daemon;
    const pf_camera_info *info = d->camera.ops->info(d->camera.self);
    pf_counters *c = &d->counters;
    uint64_t waited = pf_now();
    pf_status status = d->camera.ops->start(d->camera.self);

    pthread_mutex_lock(&c->mutex);
    c->first_ns = c->last_ns = waited;
    pthread_mutex_unlock(&c->mutex);
    while (status == PF_OK || status == PF_ERR_AGAIN) {
        pf_frame frame;
        if (atomic_load(&d->stop) != PF_STOP_NO) {
            (void)snprintf(reason, reason_n, "%s",
                           atomic_load(&d->stop) == PF_STOP_TERMINATED ? "terminated" : "stopped by the operator");
            return;
        }
        status = d->camera.ops->next(d->camera.self, NEXT_TIMEOUT_MS, &frame);
        if (status != PF_OK)
            continue;
        pthread_mutex_lock(&c->mutex);
        c->frames++;
        c->capture_ns += pf_now() - waited;
        pthread_mutex_unlock(&c->mutex);
        if (frame.image.width != info->width || frame.image.height != info->height) {
            d->camera.ops->release(d->camera.self, &frame);
            (void)snprintf(reason, reason_n, "camera failed: a frame of another size");
            p->has_failed = true;
            return;
        }
        take_frame(p, &frame);
        waited = pf_now();
    }
    if (status == PF_ERR_END) {
        (void)snprintf(reason, reason_n, "end of recording");
        return;
    }
    p->has_failed = true;
    (void)snprintf(reason, reason_n, "camera failed: %s", d->camera.ops->error(d->camera.self));
}

/* The survey's end, after all its keyframes. */
static void store_end(pf_pipeline *p, const char *reason)
{
    pf_daemon *d = p->daemon;
    pf_msg_status status;
    pf_survey survey;
    pf_job *job;
    pf_msg_survey_end end = {.time = {d->boot_id, pf_now()},
                             .keyframes = p->next_index,
                             .boots = p->boots,
                             .reason = reason,
                             .last_status = &status,
                             .lost_first = survey.lost_first,
                             .lost_count = survey.lost_count};
    pf_store_settle(d->store);
    pf_daemon_status(d, &status);
    pf_store_get_survey(d->store, &survey);
    memcpy(end.survey_id, d->survey_id, sizeof end.survey_id);
    end.frames = status.frames;
    end.lost_ranges = survey.lost_ranges;
    job = pf_store_take(d->store);
    if (job == NULL || pf_msg_encode_survey_end(&end, job->bytes, pf_store_capacity(d->store), &job->n) != PF_OK) {
        pf_log(PF_LOG_ERROR, "cannot make the survey's end message");
        if (job != NULL)
            pf_store_give_back(d->store, job);
        return;
    }
    job->kind = PF_OBJECT_SURVEY_END;
    pf_store_give(d->store, job);
    pf_store_settle(d->store);
}

static void *run(void *argument)
{
    pf_pipeline *p = argument;
    pf_daemon *d = p->daemon;
    char reason[512];

    capture(p, reason, sizeof reason);
    release_previous(p);
    (void)d->camera.ops->stop(d->camera.self);
    pf_utf8_clean(reason);
    atomic_store(&d->state, PF_STATE_DRAINING);
    pf_log(p->has_failed ? PF_LOG_ERROR : PF_LOG_INFO, "survey ends: %s; %u keyframes", reason, p->next_index);
    store_end(p, reason);
    atomic_store(&p->is_done, true);
    return NULL;
}

bool pf_pipeline_start(pf_pipeline *p, char *error, size_t n)
{
    p->is_started = pthread_create(&p->thread, NULL, run, p) == 0;
    if (!p->is_started)
        (void)snprintf(error, n, "cannot start the capture thread");
    return p->is_started;
}

bool pf_pipeline_is_done(pf_pipeline *p)
{
    return atomic_load(&p->is_done);
}

bool pf_pipeline_close(pf_pipeline *p)
{
    bool has_failed;
    if (p->is_started)
        (void)pthread_join(p->thread, NULL);
    has_failed = p->has_failed;
    release(p);
    return !has_failed;
}
