#include "objects.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/sha256.h"

#define START_MAX (PF_PROFILE_BINARY_MAX + PF_CONFIG_KEYS_MAX * PF_CONFIG_LINE_MAX + 4096u)

/* What libjpeg-turbo's own bound allows, two bytes a pixel in whole blocks; the pages that a JPEG does not reach are
 * never touched, so they cost no memory. */
static size_t jpeg_max(const pf_camera_info *info)
{
    return 2 * (((size_t)info->width + 15) & ~(size_t)15) * (((size_t)info->height + 15) & ~(size_t)15) + 2048;
}

size_t pf_object_max(const pf_daemon *d)
{
    size_t keyframe = PF_MSG_KEYFRAME_MAX(d->config.tracker.max_tracks, jpeg_max(d->camera.ops->info(d->camera.self)));
    return keyframe > START_MAX ? keyframe : START_MAX;
}

bool pf_object_start(pf_daemon *d, char *error, size_t n)
{
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

bool pf_object_interrupted(pf_daemon *d, const pf_survey *before, char *error, size_t n)
{
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

bool pf_object_keyframe(pf_daemon *d, pf_jpeg *jpeg, const pf_shot *shot, uint32_t index, const char *break_reason)
{
    const pf_frame *frame = &shot->frame;
    pf_status status;
    pf_msg_keyframe k = {.index = index,
                         .time = {d->boot_id, frame->time_ns},
                         .frame_sequence = frame->sequence,
                         .recorded_ns = frame->recorded_ns,
                         .width = frame->image.width,
                         .height = frame->image.height,
                         .jpeg_quality = d->config.keyframe.jpeg_quality,
                         .cause = shot->cause,
                         .telemetry = shot->telemetry,
                         .tracks = shot->tracks,
                         .n_tracks = shot->n_tracks,
                         .common_tracks = shot->common,
                         .tracking = shot->tracking};
    pf_job *job = pf_store_take(d->store);
    if (job == NULL) {
        pf_log(PF_LOG_WARNING, "the disk is too slow: keyframe %u is dropped", k.index);
        return false;
    }
    memcpy(k.survey_id, d->survey_id, sizeof k.survey_id);
    status = pf_jpeg_encode(jpeg, &frame->image, &k.jpeg, &k.jpeg_size);
    if (status != PF_OK)
        pf_log(PF_LOG_ERROR, "keyframe %u: %s", k.index, pf_jpeg_error(jpeg));
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
    job->is_event = k.cause == PF_KEYFRAME_FIRST || k.cause == PF_KEYFRAME_STATE;
    memcpy(job->break_reason, break_reason, sizeof job->break_reason);
    pf_store_give(d->store, job);
    return true;
}

void pf_object_end(pf_daemon *d, uint32_t keyframes, uint32_t boots, const char *reason)
{
    pf_msg_status status;
    char peer[PF_PEER_NAME_MAX];
    pf_survey survey;
    pf_job *job;
    pf_msg_survey_end end = {.time = {d->boot_id, pf_now()},
                             .keyframes = keyframes,
                             .boots = boots,
                             .reason = reason,
                             .last_status = &status,
                             .lost_first = survey.lost_first,
                             .lost_count = survey.lost_count};
    pf_store_settle(d->store);
    pf_daemon_status(d, &status, peer);
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
