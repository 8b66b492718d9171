#include "pipefish/messages.h"

#include <string.h>

#include "pb_decode.h"
#include "pb_encode.h"
#include "pipefish.pb.h"

/* The library stores texts as char *, but an encoder only reads them. */
static char *text(const char *s)
{
    return (char *)(uintptr_t)s;
}

typedef struct bytes_view {
    const uint8_t *data;
    size_t size;
} bytes_view;

static bool write_bytes(pb_ostream_t *stream, const pb_field_t *field, void *const *arg)
{
    const bytes_view *view = *arg;
    if (view->size == 0)
        return true;
    return pb_encode_tag_for_field(stream, field) && pb_encode_string(stream, view->data, view->size);
}

static pb_callback_t bytes_field(bytes_view *view, const uint8_t *data, size_t size)
{
    pb_callback_t field;
    view->data = data;
    view->size = size;
    field.funcs.encode = write_bytes;
    field.arg = view;
    return field;
}

/* ---- observations: nine packed arrays, each streamed from the one table of tracks */

typedef struct observation_column {
    const pf_track *tracks;
    uint32_t n;
    bool (*write)(pb_ostream_t *stream, const pf_track *track, uint64_t id_before);
} observation_column;

static bool write_id(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    return pb_encode_varint(s, t->id - before);
}

static bool write_x(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_svarint(s, t->pos.x);
}

static bool write_y(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_svarint(s, t->pos.y);
}

static bool write_cov_xx(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_varint(s, t->cov_xx_q20);
}

static bool write_cov_xy(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_svarint(s, t->cov_xy_q20);
}

static bool write_cov_yy(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_varint(s, t->cov_yy_q20);
}

static bool write_age(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_varint(s, t->age);
}

static bool write_quality(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_varint(s, t->quality);
}

/* pf_track_status and the schema's TrackStatus have the same numbers. */
static bool write_status(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_varint(s, t->status);
}

static bool write_settled_x(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_svarint(s, t->settled_x_q8);
}

static bool write_settled_y(pb_ostream_t *s, const pf_track *t, uint64_t before)
{
    (void)before;
    return pb_encode_svarint(s, t->settled_y_q8);
}

_Static_assert((int)PF_TRACK_NEW == (int)pipefish_v1_TrackStatus_TRACK_STATUS_NEW &&
                   (int)PF_TRACK_TRACKED == (int)pipefish_v1_TrackStatus_TRACK_STATUS_TRACKED,
               "write_status copies the number");
_Static_assert((int)PF_KEYFRAME_FIRST == (int)pipefish_v1_KeyframeCause_KEYFRAME_CAUSE_FIRST &&
                   (int)PF_KEYFRAME_ENCODER == (int)pipefish_v1_KeyframeCause_KEYFRAME_CAUSE_ENCODER &&
                   (int)PF_KEYFRAME_PARALLAX == (int)pipefish_v1_KeyframeCause_KEYFRAME_CAUSE_PARALLAX &&
                   (int)PF_KEYFRAME_FEW_COMMON == (int)pipefish_v1_KeyframeCause_KEYFRAME_CAUSE_FEW_COMMON &&
                   (int)PF_KEYFRAME_STATE == (int)pipefish_v1_KeyframeCause_KEYFRAME_CAUSE_STATE,
               "the keyframe's cause is copied as a number");

static bool write_column_items(pb_ostream_t *stream, const observation_column *column)
{
    uint64_t before = 0;
    for (uint32_t i = 0; i < column->n; i++) {
        const pf_track *t = &column->tracks[i];
        if (t->status == PF_TRACK_LOST)
            continue;
        if (!column->write(stream, t, before))
            return false;
        before = t->id;
    }
    return true;
}

static bool write_column(pb_ostream_t *stream, const pb_field_t *field, void *const *arg)
{
    pb_ostream_t sizing = PB_OSTREAM_SIZING;
    if (!write_column_items(&sizing, *arg))
        return false;
    if (sizing.bytes_written == 0)
        return true;
    return pb_encode_tag(stream, PB_WT_STRING, field->tag) && pb_encode_varint(stream, sizing.bytes_written) &&
           write_column_items(stream, *arg);
}

#define OBSERVATION_COLUMNS 11

static void set_observations(pipefish_v1_Observations *o, observation_column columns[OBSERVATION_COLUMNS],
                             const pf_track *tracks, uint32_t n)
{
    static bool (*const write[OBSERVATION_COLUMNS])(pb_ostream_t *, const pf_track *, uint64_t) = {
        write_id,  write_x,       write_y,      write_cov_xx,    write_cov_xy,   write_cov_yy,
        write_age, write_quality, write_status, write_settled_x, write_settled_y};
    pb_callback_t *const field[OBSERVATION_COLUMNS] = {
        &o->id_delta, &o->x_q16,   &o->y_q16,  &o->cov_xx_q20,   &o->cov_xy_q20,  &o->cov_yy_q20,
        &o->age,      &o->quality, &o->status, &o->settled_x_q8, &o->settled_y_q8};
    for (int i = 0; i < OBSERVATION_COLUMNS; i++) {
        columns[i] = (observation_column){tracks, n, write[i]};
        field[i]->funcs.encode = write_column;
        field[i]->arg = &columns[i];
    }
}

/* ---- parts that several messages share */

static pipefish_v1_DeviceTime device_time(const pf_msg_time *time)
{
    return (pipefish_v1_DeviceTime){.boot_id = time->boot_id, .monotonic_ns = time->monotonic_ns};
}

static void set_telemetry(pipefish_v1_Telemetry *out, const pf_msg_telemetry *in)
{
    out->has_time = true;
    out->time = device_time(&in->time);
    out->has_encoder_count = in->has_encoder;
    out->encoder_count = in->encoder_count;
    out->encoder_missed = in->encoder_missed;
    out->has_roll_rad = out->has_pitch_rad = in->has_attitude;
    out->has_attitude_sigma_rad = in->has_attitude && in->attitude_sigma_rad > 0.0f;
    out->roll_rad = in->roll_rad;
    out->pitch_rad = in->pitch_rad;
    out->attitude_sigma_rad = in->attitude_sigma_rad;
    out->has_exposure_us = in->has_exposure;
    out->exposure_us = in->exposure_us;
    out->has_gain = in->has_gain;
    out->gain = in->gain;
    out->has_lamp = in->has_lamp;
    out->lamp = in->lamp;
    out->emergency_stop = in->emergency_stop;
    out->limit_front = in->limit_front;
    out->limit_rear = in->limit_rear;
}

static pipefish_v1_Profile profile_message(const pf_msg_profile *in)
{
    pipefish_v1_Profile out = {.name = text(in->name),
                               .serial = text(in->serial),
                               .crc32c = in->crc32c,
                               .trial = in->is_trial,
                               .starts_left = in->starts_left};
    memcpy(out.sha256, in->sha256, sizeof out.sha256);
    return out;
}

static void set_tracking(pipefish_v1_Tracking *out, const pf_msg_tracking *in)
{
    *out = (pipefish_v1_Tracking){.standing = (in->scene & PF_SCENE_STANDING) != 0,
                                  .reversing = (in->scene & PF_SCENE_REVERSING) != 0,
                                  .dark = (in->scene & PF_SCENE_DARK) != 0,
                                  .covered = (in->scene & PF_SCENE_COVERED) != 0,
                                  .over_exposed = (in->scene & PF_SCENE_OVEREXPOSED) != 0,
                                  .weak_texture = (in->scene & PF_SCENE_WEAK_TEXTURE) != 0,
                                  .frames = in->frames,
                                  .tracked = in->tracked,
                                  .detected = in->detected,
                                  .lost_left = in->lost_by[PF_TRACK_LEFT],
                                  .lost_flat = in->lost_by[PF_TRACK_FLAT],
                                  .lost_diverged = in->lost_by[PF_TRACK_DIVERGED],
                                  .lost_residual = in->lost_by[PF_TRACK_RESIDUAL],
                                  .lost_backward = in->lost_by[PF_TRACK_BACKWARD],
                                  .lost_crowded = in->lost_by[PF_TRACK_CROWDED],
                                  .lost_drift = in->lost_by[PF_TRACK_DRIFT],
                                  .lost_masked = in->lost_by[PF_TRACK_MASKED],
                                  .lost_static = in->lost_by[PF_TRACK_STATIC],
                                  .lost_saturated = in->lost_by[PF_TRACK_SATURATED],
                                  .age_median = in->age_median,
                                  .quality_median = in->quality_median,
                                  .static_blocks = in->static_blocks,
                                  .encoder_contrary = (in->scene & PF_SCENE_ENCODER) != 0};
    _Static_assert(sizeof out->state_frames == sizeof in->state_frames, "max_count of the schema is PF_SCENE_FLAGS");
    memcpy(out->state_frames, in->state_frames, sizeof in->state_frames);
    for (uint32_t i = 0; i < PF_SCENE_FLAGS; i++)
        if (in->state_frames[i])
            out->state_frames_count = PF_SCENE_FLAGS;
}

static void set_status(pipefish_v1_Status *out, const pf_msg_status *in)
{
    out->has_time = out->has_stage = out->has_spool = out->has_link = out->has_telemetry = out->has_tracking = true;
    out->time = device_time(&in->time);
    memcpy(out->survey_id, in->survey_id, sizeof out->survey_id);
    out->state = text(in->state);
    out->frames = in->frames;
    out->frames_dropped = in->frames_dropped;
    out->tracks_live = in->tracks_live;
    out->tracks_new = in->tracks_new;
    out->tracks_lost = in->tracks_lost;
    out->keyframes = in->keyframes;
    out->keyframes_dropped = in->keyframes_dropped;
    out->fps = in->fps;
    out->stage =
        (pipefish_v1_Status_StageTimes){in->stage.capture,  in->stage.pyramid, in->stage.track,    in->stage.detect,
                                        in->stage.keyframe, in->stage.store,   in->stage.frame_max};
    out->spool =
        (pipefish_v1_Status_Spool){in->spool.objects, in->spool.bytes,   in->spool.stored,    in->spool.acknowledged,
                                   in->spool.errors,  in->spool.evicted, in->spool.is_failing};
    out->link = (pipefish_v1_Status_Link){.up = in->link_up,
                                          .bytes_out = in->link.bytes_out,
                                          .bytes_in = in->link.bytes_in,
                                          .frames_out = in->link.frames_out,
                                          .frames_in = in->link.frames_in,
                                          .crc_errors = in->link.crc_errors,
                                          .fragments_sent = in->link.fragments_sent,
                                          .fragments_resent = in->link.fragments_resent,
                                          .objects_sent = in->link.objects_sent,
                                          .sessions = in->link.sessions,
                                          .rtt_us = in->link.rtt_us,
                                          .malformed = in->link.malformed};
    set_telemetry(&out->telemetry, &in->telemetry);
    out->uptime_ns = in->uptime_ns;
    out->has_clock = in->has_clock;
    out->clock = (pipefish_v1_ClockSync){in->clock.boot_id, in->clock.offset_ns, in->clock.error_ns};
    out->has_profile = in->has_profile;
    if (in->has_profile)
        out->profile = profile_message(&in->profile);
    set_tracking(&out->tracking, &in->tracking);
    out->visitors = in->visitors;
    out->looking_on = in->looking_on;
    out->has_network = in->has_network;
    if (in->has_network)
        out->network = (pipefish_v1_Status_Network){.peer = text(in->network.peer),
                                                    .role = text(in->network.role),
                                                    .sessions = in->network.sessions,
                                                    .refused_unknown = in->network.refused_unknown,
                                                    .refused_revoked = in->network.refused_revoked,
                                                    .refused_handshake = in->network.refused_handshake,
                                                    .refused_late = in->network.refused_late,
                                                    .refused_often = in->network.refused_often,
                                                    .refused_busy = in->network.refused_busy};
}

/* The library fails on a full buffer only: the callbacks here never do, and texts are not checked. */
static pf_status encode(const pb_msgdesc_t *fields, const void *message, uint8_t *out, size_t capacity, size_t *n)
{
    pb_ostream_t stream = pb_ostream_from_buffer(out, capacity);
    if (!pb_encode(&stream, fields, message))
        return PF_ERR_SPACE;
    *n = stream.bytes_written;
    return PF_OK;
}

/* ---- messages */

pf_status pf_msg_encode_keyframe(const pf_msg_keyframe *k, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_Keyframe m = pipefish_v1_Keyframe_init_zero;
    observation_column columns[OBSERVATION_COLUMNS];
    bytes_view jpeg;

    if (k->n_tracks > 2 * PF_TRACKS_MAX)
        return PF_ERR_ARGUMENT;
    for (uint32_t i = 1; i < k->n_tracks; i++)
        if (k->tracks[i].id <= k->tracks[i - 1].id)
            return PF_ERR_ARGUMENT;
    memcpy(m.survey_id, k->survey_id, sizeof m.survey_id);
    m.index = k->index;
    m.has_time = true;
    m.time = device_time(&k->time);
    m.frame_sequence = k->frame_sequence;
    m.recorded_ns = k->recorded_ns;
    memcpy(m.frame_sha256, k->frame_sha256, sizeof m.frame_sha256);
    m.width = k->width;
    m.height = k->height;
    m.jpeg = bytes_field(&jpeg, k->jpeg, k->jpeg_size);
    m.jpeg_quality = k->jpeg_quality;
    m.cause = (pipefish_v1_KeyframeCause)k->cause;
    m.has_telemetry = true;
    set_telemetry(&m.telemetry, &k->telemetry);
    m.has_observations = true;
    set_observations(&m.observations, columns, k->tracks, k->n_tracks);
    m.common_tracks = k->common_tracks;
    m.has_tracking = true;
    set_tracking(&m.tracking, &k->tracking);
    return encode(pipefish_v1_Keyframe_fields, &m, out, capacity, n);
}

/* A message of Protocol Buffers followed by fields is that message with these fields. */
pf_status pf_msg_append_break(const char *reason, uint8_t *out, size_t capacity, size_t *n)
{
    pb_ostream_t stream = pb_ostream_from_buffer(out + *n, capacity - *n);
    if (!pb_encode_tag(&stream, PB_WT_VARINT, pipefish_v1_Keyframe_after_break_tag) || !pb_encode_varint(&stream, 1) ||
        !pb_encode_tag(&stream, PB_WT_STRING, pipefish_v1_Keyframe_break_reason_tag) ||
        !pb_encode_string(&stream, (const uint8_t *)reason, strlen(reason)))
        return PF_ERR_SPACE;
    *n += stream.bytes_written;
    return PF_OK;
}

pf_status pf_msg_append_lost(uint32_t index, uint8_t *out, size_t capacity, size_t *n)
{
    pb_ostream_t stream = pb_ostream_from_buffer(out + *n, capacity - *n);
    if (!pb_encode_tag(&stream, PB_WT_VARINT, pipefish_v1_SurveyEnd_lost_first_tag) ||
        !pb_encode_varint(&stream, index) ||
        !pb_encode_tag(&stream, PB_WT_VARINT, pipefish_v1_SurveyEnd_lost_count_tag) || !pb_encode_varint(&stream, 1))
        return PF_ERR_SPACE;
    *n += stream.bytes_written;
    return PF_OK;
}

typedef struct lines_view {
    const char *const *line;
    uint32_t n;
} lines_view;

static bool write_lines(pb_ostream_t *stream, const pb_field_t *field, void *const *arg)
{
    const lines_view *view = *arg;
    for (uint32_t i = 0; i < view->n; i++) {
        if (!pb_encode_tag_for_field(stream, field) ||
            !pb_encode_string(stream, (const uint8_t *)view->line[i], strlen(view->line[i])))
            return false;
    }
    return true;
}

pf_status pf_msg_encode_survey_start(const pf_msg_survey_start *s, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_SurveyStart m = pipefish_v1_SurveyStart_init_zero;
    lines_view lines = {s->config, s->config_count};
    bytes_view profile;

    memcpy(m.survey_id, s->survey_id, sizeof m.survey_id);
    m.has_time = true;
    m.time = device_time(&s->time);
    m.name = text(s->name);
    m.software = text(s->software);
    m.source = text(s->source);
    m.profile = bytes_field(&profile, s->profile, s->profile ? s->profile_size : 0);
    m.has_encoder = true;
    m.encoder.metres_per_count = s->metres_per_count;
    m.encoder.metres_per_count_sigma = s->metres_per_count_sigma;
    m.encoder.noise_m_per_sqrt_m = s->noise_m_per_sqrt_m;
    m.width = s->width;
    m.height = s->height;
    m.frame_rate = s->frame_rate;
    m.nominal_diameter_m = s->nominal_diameter_m;
    m.config.funcs.encode = write_lines;
    m.config.arg = &lines;
    memcpy(m.tracker_config_sha256, s->tracker_config_sha256, sizeof m.tracker_config_sha256);
    return encode(pipefish_v1_SurveyStart_fields, &m, out, capacity, n);
}

typedef struct numbers_view {
    const uint32_t *number;
    uint32_t n;
} numbers_view;

static bool write_numbers(pb_ostream_t *stream, const pb_field_t *field, void *const *arg)
{
    const numbers_view *view = *arg;
    pb_ostream_t sizing = PB_OSTREAM_SIZING;
    if (view->n == 0)
        return true;
    for (uint32_t i = 0; i < view->n; i++)
        if (!pb_encode_varint(&sizing, view->number[i]))
            return false;
    if (!pb_encode_tag(stream, PB_WT_STRING, field->tag) || !pb_encode_varint(stream, sizing.bytes_written))
        return false;
    for (uint32_t i = 0; i < view->n; i++)
        if (!pb_encode_varint(stream, view->number[i]))
            return false;
    return true;
}

pf_status pf_msg_encode_survey_end(const pf_msg_survey_end *e, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_SurveyEnd m = pipefish_v1_SurveyEnd_init_zero;
    numbers_view lost_first = {e->lost_first, e->lost_ranges}, lost_count = {e->lost_count, e->lost_ranges};

    memcpy(m.survey_id, e->survey_id, sizeof m.survey_id);
    m.has_time = true;
    m.time = device_time(&e->time);
    m.keyframes = e->keyframes;
    m.frames = e->frames;
    m.boots = e->boots;
    m.reason = text(e->reason);
    m.has_last_status = e->last_status != NULL;
    if (e->last_status)
        set_status(&m.last_status, e->last_status);
    m.lost_first.funcs.encode = m.lost_count.funcs.encode = write_numbers;
    m.lost_first.arg = &lost_first;
    m.lost_count.arg = &lost_count;
    return encode(pipefish_v1_SurveyEnd_fields, &m, out, capacity, n);
}

pf_status pf_msg_encode_status(const pf_msg_status *s, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_Status m = pipefish_v1_Status_init_zero;
    set_status(&m, s);
    return encode(pipefish_v1_Status_fields, &m, out, capacity, n);
}

pf_status pf_msg_encode_preview(const pf_msg_preview *p, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_Preview m = pipefish_v1_Preview_init_zero;
    bytes_view jpeg;
    m.has_time = true;
    m.time = device_time(&p->time);
    m.frame_sequence = p->frame_sequence;
    m.width = p->width;
    m.height = p->height;
    m.jpeg = bytes_field(&jpeg, p->jpeg, p->jpeg_size);
    return encode(pipefish_v1_Preview_fields, &m, out, capacity, n);
}

/* "mono8": the rows without what the stride puts between them. */
static bool write_pixels(pb_ostream_t *stream, const pb_field_t *field, void *const *arg)
{
    const pf_image *image = *arg;
    if (!pb_encode_tag_for_field(stream, field) || !pb_encode_varint(stream, (uint64_t)image->width * image->height))
        return false;
    for (uint32_t y = 0; y < image->height; y++)
        if (!pb_write(stream, image->data + (size_t)y * image->stride, image->width))
            return false;
    return true;
}

pf_status pf_msg_encode_raw_frame(const pf_msg_raw_frame *f, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_RawFrame m = pipefish_v1_RawFrame_init_zero;
    pf_image image = f->image;
    m.has_time = true;
    m.time = device_time(&f->time);
    m.frame_sequence = f->frame_sequence;
    m.width = image.width;
    m.height = image.height;
    m.encoding = text("mono8");
    m.pixels.funcs.encode = write_pixels;
    m.pixels.arg = &image;
    m.has_telemetry = true;
    set_telemetry(&m.telemetry, &f->telemetry);
    return encode(pipefish_v1_RawFrame_fields, &m, out, capacity, n);
}

pf_status pf_msg_encode_reply(const pf_msg_reply *r, uint8_t *out, size_t capacity, size_t *n)
{
    pipefish_v1_Reply m = pipefish_v1_Reply_init_zero;
    if ((r->status != NULL) + (r->info != NULL) + (r->profile != NULL) + (r->paired_key != NULL) > 1)
        return PF_ERR_ARGUMENT;
    m.id = r->id;
    m.error = text(r->error);
    if (r->status) {
        m.which_what = pipefish_v1_Reply_status_tag;
        set_status(&m.what.status, r->status);
    } else if (r->info) {
        pipefish_v1_Info *info = &m.what.info;
        m.which_what = pipefish_v1_Reply_info_tag;
        *info = (pipefish_v1_Info){.software = text(r->info->software),
                                   .boot_id = r->info->boot_id,
                                   .schema = r->info->schema,
                                   .source = text(r->info->source)};
        memcpy(info->survey_id, r->info->survey_id, sizeof info->survey_id);
        memcpy(info->profile_sha256, r->info->profile_sha256, sizeof info->profile_sha256);
    } else if (r->profile) {
        pipefish_v1_ProfileState *state = &m.what.profile;
        m.which_what = pipefish_v1_Reply_profile_tag;
        *state = (pipefish_v1_ProfileState){.has_in_use = r->profile->has_in_use,
                                            .has_stored = r->profile->has_stored,
                                            .problem = text(r->profile->problem),
                                            .slot_erases_a = r->profile->slot_erases[0],
                                            .slot_erases_b = r->profile->slot_erases[1]};
        if (state->has_in_use)
            state->in_use = profile_message(&r->profile->in_use);
        if (state->has_stored)
            state->stored = profile_message(&r->profile->stored);
    } else if (r->paired_key) {
        m.which_what = pipefish_v1_Reply_paired_tag;
        memcpy(m.what.paired.key, r->paired_key, sizeof m.what.paired.key);
    }
    return encode(pipefish_v1_Reply_fields, &m, out, capacity, n);
}

/* pf_request_what has the field numbers of Request.what. */
_Static_assert((int)PF_REQUEST_GET_STATUS == pipefish_v1_Request_get_status_tag &&
                   (int)PF_REQUEST_GET_INFO == pipefish_v1_Request_get_info_tag &&
                   (int)PF_REQUEST_STOP_SURVEY == pipefish_v1_Request_stop_survey_tag &&
                   (int)PF_REQUEST_SET_LAMP == pipefish_v1_Request_set_lamp_tag &&
                   (int)PF_REQUEST_CLOCK_SYNC == pipefish_v1_Request_clock_sync_tag &&
                   (int)PF_REQUEST_SHUTDOWN == pipefish_v1_Request_shutdown_tag &&
                   (int)PF_REQUEST_GET_PROFILE == pipefish_v1_Request_get_profile_tag &&
                   (int)PF_REQUEST_CONFIRM_PROFILE == pipefish_v1_Request_confirm_profile_tag &&
                   (int)PF_REQUEST_REVERT_PROFILE == pipefish_v1_Request_revert_profile_tag &&
                   (int)PF_REQUEST_GET_STILL == pipefish_v1_Request_get_still_tag &&
                   (int)PF_REQUEST_PAIR == pipefish_v1_Request_pair_tag,
               "pf_msg_decode_request copies the number");

/* The first field of either message; a field that is 0 is left out. */
static bool read_survey_id(pb_istream_t *stream, uint8_t survey_id[16])
{
    pb_wire_type_t type;
    uint32_t tag = 0, size = 0;
    bool is_end = false;
    return pb_decode_tag(stream, &type, &tag, &is_end) && tag == pipefish_v1_Keyframe_survey_id_tag &&
           type == PB_WT_STRING && pb_decode_varint32(stream, &size) && size == 16 && pb_read(stream, survey_id, 16);
}

_Static_assert((int)pipefish_v1_Keyframe_survey_id_tag == (int)pipefish_v1_SurveyEnd_survey_id_tag, "read_survey_id");

pf_status pf_msg_peek_keyframe(const uint8_t *bytes, size_t n, uint8_t survey_id[16], uint32_t *index)
{
    pb_istream_t stream = pb_istream_from_buffer(bytes, n);
    pb_wire_type_t type;
    uint32_t tag = 0;
    bool is_end = false;
    *index = 0;
    if (!read_survey_id(&stream, survey_id) || !pb_decode_tag(&stream, &type, &tag, &is_end))
        return PF_ERR_FORMAT;
    if (tag == pipefish_v1_Keyframe_time_tag && type == PB_WT_STRING)
        return PF_OK;
    return tag == pipefish_v1_Keyframe_index_tag && type == PB_WT_VARINT && pb_decode_varint32(&stream, index)
               ? PF_OK
               : PF_ERR_FORMAT;
}

pf_status pf_msg_peek_survey_end(const uint8_t *bytes, size_t n, uint8_t survey_id[16])
{
    pb_istream_t stream = pb_istream_from_buffer(bytes, n);
    return read_survey_id(&stream, survey_id) ? PF_OK : PF_ERR_FORMAT;
}

pf_status pf_msg_decode_request(const uint8_t *bytes, size_t n, pf_msg_request *request)
{
    pipefish_v1_Request m = pipefish_v1_Request_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(bytes, n);
    if (!pb_decode(&stream, pipefish_v1_Request_fields, &m))
        return PF_ERR_FORMAT;
    *request = (pf_msg_request){.id = m.id, .what = (pf_request_what)m.which_what};
    if (request->what == PF_REQUEST_SET_LAMP)
        request->lamp = m.what.set_lamp;
    if (request->what == PF_REQUEST_CONFIRM_PROFILE)
        memcpy(request->profile_sha256, m.what.confirm_profile, sizeof request->profile_sha256);
    if (request->what == PF_REQUEST_PAIR) {
        memcpy(request->pair.key, m.what.pair.key, sizeof request->pair.key);
        memcpy(request->pair.role, m.what.pair.role, sizeof request->pair.role);
        memcpy(request->pair.name, m.what.pair.name, sizeof request->pair.name);
    }
    if (request->what == PF_REQUEST_CLOCK_SYNC)
        request->clock =
            (pf_msg_clock_sync){m.what.clock_sync.boot_id, m.what.clock_sync.offset_ns, m.what.clock_sync.error_ns};
    return PF_OK;
}
