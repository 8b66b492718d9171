/* Messages with a value of its own in every field, for the tests of the codec. */
#ifndef PIPEFISH_TESTS_MESSAGE_SAMPLES_H
#define PIPEFISH_TESTS_MESSAGE_SAMPLES_H

#include "pipefish/messages.h"
#include "unity.h"
#include "wire.h"

#include <string.h>

static const uint8_t survey_id[16] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};

static inline pf_msg_telemetry sample_telemetry(void)
{
    return (pf_msg_telemetry){.time = {0xFEDCBA9876543210u, 123456789012u},
                              .has_encoder = true,
                              .has_attitude = true,
                              .has_exposure = true,
                              .has_gain = true,
                              .has_lamp = true,
                              .encoder_count = -987654321,
                              .encoder_missed = 3,
                              .roll_rad = 0.25f,
                              .pitch_rad = -0.5f,
                              .attitude_sigma_rad = 0.0625f,
                              .exposure_us = 8000,
                              .gain = 2.5f,
                              .lamp = 0.75f,
                              .emergency_stop = true};
}

static inline pf_msg_tracking sample_tracking(void)
{
    pf_msg_tracking t = {.scene = PF_SCENE_REVERSING | PF_SCENE_OVEREXPOSED,
                         .frames = 7,
                         .tracked = 8,
                         .detected = 9,
                         .age_median = 20,
                         .quality_median = 21,
                         .static_blocks = 22};
    for (uint32_t i = 1; i < PF_TRACK_REASONS; i++)
        t.lost_by[i] = 9 + i;
    t.state_frames[1] = 3;
    t.state_frames[6] = 5;
    return t;
}

static inline pf_msg_status sample_status(void)
{
    pf_msg_status s = {.time = {7, 8},
                       .state = "surveying",
                       .frames = 1000,
                       .frames_dropped = 2,
                       .tracks_live = 400,
                       .tracks_new = 5,
                       .tracks_lost = 6,
                       .keyframes = 70,
                       .keyframes_dropped = 8,
                       .fps = 29.5,
                       .stage = {1, 2, 3, 4, 5, 6, 7},
                       .spool = {11, 12, 13, 14, 16, 17, true},
                       .link_up = true,
                       .telemetry = sample_telemetry(),
                       .uptime_ns = 99,
                       .has_clock = true,
                       .clock = {7, -123456789, 1000},
                       .has_network = true,
                       .network = {"Anna", "viewer", 3, 4, 5, 6, 7, 8, 9},
                       .tracking = sample_tracking()};
    s.link.bytes_out = 21;
    s.link.bytes_in = 22;
    s.link.frames_out = 23;
    s.link.frames_in = 24;
    s.link.crc_errors = 25;
    s.link.fragments_sent = 26;
    s.link.fragments_resent = 27;
    s.link.objects_sent = 28;
    s.link.sessions = 29;
    s.link.rtt_us = 30;
    s.link.malformed = 31;
    memcpy(s.survey_id, survey_id, 16);
    return s;
}

#define TRACKS 6

static inline void sample_tracks(pf_track tracks[TRACKS])
{
    for (int i = 0; i < TRACKS; i++)
        tracks[i] = (pf_track){.id = 10 + 3 * (uint64_t)i,
                               .pos = {i * 65536 - 70000, 1000 * i},
                               .cov_xx_q20 = 256u + (uint32_t)i,
                               .cov_yy_q20 = 4294967295u - (uint32_t)i,
                               .cov_xy_q20 = -i,
                               .age = (uint32_t)(TRACKS - i),
                               .status = i == TRACKS - 1 ? PF_TRACK_NEW : PF_TRACK_TRACKED,
                               .quality = (uint16_t)(32767 - i)};
    tracks[2].status = PF_TRACK_LOST;
}

static const uint8_t jpeg[] = {0xFF, 0xD8, 0, 1, 2, 0xFF, 0xD9};

static inline pf_msg_keyframe sample_keyframe(const pf_track *tracks)
{
    pf_msg_keyframe k = {.index = 12,
                         .time = {7, 8000},
                         .frame_sequence = 300,
                         .recorded_ns = 3600000000000u,
                         .width = 1280,
                         .height = 800,
                         .jpeg = jpeg,
                         .jpeg_size = sizeof jpeg,
                         .jpeg_quality = 90,
                         .cause = PF_KEYFRAME_PARALLAX,
                         .telemetry = sample_telemetry(),
                         .tracks = tracks,
                         .n_tracks = TRACKS,
                         .common_tracks = 44,
                         .tracking = sample_tracking()};
    memcpy(k.survey_id, survey_id, 16);
    memset(k.frame_sha256, 0xAB, 32);
    return k;
}

static const char *const config[] = {"tracker.levels = 4", "link.port = 7447", "survey.name = \xC3\x96l"};
static const uint8_t profile[] = {9, 8, 7, 0, 6};

static inline pf_msg_survey_start sample_start(void)
{
    pf_msg_survey_start s = {.time = {7, 9},
                             .name = "\xC3\x96l",
                             .software = "pipefishd 0.1.0",
                             .source = "replay x.y4m",
                             .profile = profile,
                             .profile_size = sizeof profile,
                             .metres_per_count = 0.0001,
                             .metres_per_count_sigma = 1e-6,
                             .noise_m_per_sqrt_m = 0.005,
                             .width = 640,
                             .height = 480,
                             .frame_rate = 29.97,
                             .nominal_diameter_m = 0.3,
                             .config = config,
                             .config_count = 3};
    memcpy(s.survey_id, survey_id, 16);
    memset(s.tracker_config_sha256, 0xCD, 32);
    return s;
}

static const uint32_t lost_first[] = {3, 300, 4294967295u}, lost_count[] = {290, 1, 1};

static inline pf_msg_survey_end sample_end(const pf_msg_status *status)
{
    pf_msg_survey_end e = {.time = {7, 10},
                           .keyframes = 99,
                           .boots = 2,
                           .frames = 1234567890123u,
                           .reason = "terminated",
                           .last_status = status,
                           .lost_first = lost_first,
                           .lost_count = lost_count,
                           .lost_ranges = 3};
    memcpy(e.survey_id, survey_id, 16);
    return e;
}

#endif
