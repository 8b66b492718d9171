#include "daemon.h"

#include <errno.h>
#include <inttypes.h>
#include <string.h>
#include <unistd.h>

#include "keeper.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/profile_integers.h"
#include "utf8.h"

void pf_daemon_stop(pf_daemon *d, pf_stop stop)
{
    int expected = PF_STOP_NO;
    if (!atomic_compare_exchange_strong(&d->stop, &expected, stop) && stop == PF_STOP_SHUTDOWN) {
        expected = PF_STOP_OPERATOR;
        (void)atomic_compare_exchange_strong(&d->stop, &expected, stop);
    }
    pf_store_hurry(d->store);
}

/* Mean microseconds. */
static float mean_us(uint64_t sum_ns, uint64_t n)
{
    return n ? (float)((double)sum_ns / (double)n / 1e3) : 0.0f;
}

bool pf_daemon_read_profile(const uint8_t *bytes, size_t n, pf_profile *profile, void *workspace, size_t size,
                            const char **why)
{
    const pf_camera_fixed *fixed;
    if (pf_profile_decode(bytes, n, profile, why) != PF_OK)
        return false;
    if (pf_camera_fixed_init(&fixed, &profile->camera, workspace, size) != PF_OK) {
        *why = "camera: this device cannot build it in fixed point";
        return false;
    }
    return pf_profile_integers_check(profile, workspace, size, why) == PF_OK;
}

pf_msg_profile pf_daemon_profile(pf_daemon *d)
{
    pf_msg_profile profile = {.name = d->profile.name, .serial = d->profile.serial};
    memcpy(profile.sha256, d->profile_sha256, sizeof profile.sha256);
    for (size_t i = 0; i < 4; i++)
        profile.crc32c |= (uint32_t)d->profile_bytes[d->profile_size - 4 + i] << (8 * i);
    if (d->keeper != NULL)
        profile.is_trial = pf_keeper_trial(d->keeper, profile.sha256, &profile.starts_left);
    return profile;
}

void pf_daemon_status(pf_daemon *d, pf_msg_status *status, char *peer)
{
    static const char *const states[] = {"surveying", "draining", "idle"};
    pf_counters *c = &d->counters;
    uint64_t now = pf_now();
    pf_store_stats store;

    pf_store_get_stats(d->store, &store);
    pthread_mutex_lock(&c->mutex);
    *status = (pf_msg_status){
        .time = {d->boot_id, now},
        .state = states[atomic_load(&d->state)],
        .frames = c->frames,
        .frames_dropped = c->frames_dropped,
        .tracks_live = c->tracks_live,
        .tracks_new = c->tracks_new,
        .tracks_lost = c->tracks_lost,
        .keyframes = c->keyframes,
        .keyframes_dropped = store.keyframes_dropped,
        .stage = {.capture = mean_us(c->capture_ns, c->frames),
                  .pyramid = mean_us(c->stage_ns[PF_STAGE_PYRAMID], c->frames_tracked),
                  .track = mean_us(c->stage_ns[PF_STAGE_TRACK], c->frames_tracked),
                  .detect = mean_us(c->stage_ns[PF_STAGE_DETECT], c->frames_tracked),
                  .keyframe = mean_us(c->keyframe_ns, c->keyframes),
                  .store = mean_us(store.store_ns, store.stored),
                  .frame_max = (float)((double)c->frame_max_ns / 1e3)},
        .spool = {store.spool.objects, store.spool.bytes, store.spool.stored, store.spool.acknowledged,
                  store.spool.errors, (uint32_t)store.spool.evicted, store.trouble[0] != '\0'},
        .link_up = c->link_up,
        .link = c->link,
        .telemetry = c->telemetry,
        .uptime_ns = now - d->started_ns,
        .has_clock = c->has_clock,
        .clock = c->clock,
        .tracking = c->tracking,
        .visitors = c->visitors,
        .has_network = c->has_network,
        .network = {.peer = peer,
                    .role = c->peer_role >= PF_ROLE_VIEWER ? pf_role_text(c->peer_role) : "",
                    .sessions = c->network.sessions,
                    .refused_unknown = c->network.refused_unknown,
                    .refused_revoked = c->network.refused_revoked,
                    .refused_handshake = c->network.refused_handshake,
                    .refused_late = c->network.refused_late,
                    .refused_often = c->network.refused_often,
                    .refused_busy = c->network.refused_busy},
    };
    memcpy(peer, c->peer_name, sizeof c->peer_name);
    if (c->last_ns > c->first_ns)
        status->fps = (double)c->frames_tracked * 1e9 / (double)(c->last_ns - c->first_ns);
    pthread_mutex_unlock(&c->mutex);
    memcpy(status->survey_id, d->survey_id, sizeof status->survey_id);
    status->has_profile = d->has_profile;
    if (d->has_profile)
        status->profile = pf_daemon_profile(d);
}

static void print_tracking(FILE *out, const pf_msg_tracking *t)
{
    static const char *const states[PF_SCENE_FLAGS] = {
        "standing", "reversing", "dark", "covered", "over_exposed", "weak_texture", "encoder_contrary"};
    static const char *const reasons[PF_TRACK_REASONS] = {
        "", "left", "flat", "diverged", "residual", "backward", "crowded", "drift", "masked", "static", "saturated"};
    (void)fputs("  \"tracking\": {", out);
    for (uint32_t i = 0; i < PF_SCENE_FLAGS; i++)
        (void)fprintf(out, "\"%s\": %s, ", states[i], t->scene >> i & 1u ? "true" : "false");
    (void)fprintf(out, "\"frames\": %" PRIu64 ", \"tracked\": %" PRIu64 ", \"detected\": %" PRIu64, t->frames,
                  t->tracked, t->detected);
    for (uint32_t i = 0; i < PF_SCENE_FLAGS; i++)
        (void)fprintf(out, ", \"frames_%s\": %" PRIu64, states[i], t->state_frames[i]);
    for (uint32_t i = 1; i < PF_TRACK_REASONS; i++)
        (void)fprintf(out, ", \"lost_%s\": %" PRIu64, reasons[i], t->lost_by[i]);
    (void)fprintf(out, ", \"age_median\": %u, \"quality_median\": %u, \"static_blocks\": %u},\n", t->age_median,
                  t->quality_median, t->static_blocks);
}

static void print_gpio(FILE *out, const pf_gpio_state *g)
{
    (void)fprintf(out,
                  "  \"gpio\": {\"encoder\": \"%s\", \"missed\": %u, \"repeated\": %u, \"illegal\": %u, \"stop\": %s, "
                  "\"limit_front\": %s, \"limit_rear\": %s, \"broken\": %s},\n",
                  g->encoder, g->missed, g->repeated, g->illegal, g->is_stopped ? "true" : "false",
                  g->limits & PF_LIMIT_FRONT ? "true" : "false", g->limits & PF_LIMIT_REAR ? "true" : "false",
                  g->is_broken ? "true" : "false");
}

static void print_camera(FILE *out, const pf_camera_stats *c)
{
    (void)fprintf(out,
                  "  \"camera\": {\"there\": %s, \"damaged\": %" PRIu64 ", \"restarts\": %" PRIu64
                  ", \"reopens\": %" PRIu64 ", \"bad_stamps\": %" PRIu64 "},\n",
                  c->is_there ? "true" : "false", c->damaged, c->restarts, c->reopens, c->bad_stamps);
}

static void print_text(FILE *out, const char *key, const char *text)
{
    (void)fprintf(out, ",\n  \"%s\": \"", key);
    for (; *text != '\0'; text++)
        (void)fputc(*text == '"' || *text == '\\' || (unsigned char)*text < 0x20 ? '?' : *text, out);
    (void)fputc('"', out);
}

static void print_network(FILE *out, const pf_msg_network *w)
{
    print_text(out, "peer", w->peer);
    (void)fprintf(out,
                  ",\n  \"network\": {\"role\": \"%s\", \"sessions\": %u, \"refused_unknown\": %u"
                  ", \"refused_revoked\": %u, \"refused_handshake\": %u, \"refused_late\": %u"
                  ", \"refused_often\": %u, \"refused_busy\": %u}",
                  w->role, w->sessions, w->refused_unknown, w->refused_revoked, w->refused_handshake, w->refused_late,
                  w->refused_often, w->refused_busy);
}

static void print_status(FILE *out, const pf_msg_status *s, const pf_store_stats *store, const pf_camera_stats *camera,
                         const pf_gpio_state *gpio, uint32_t overruns, const char *problem)
{
    (void)fprintf(out, "{\n  \"software\": \"%s\",\n  \"boot_id\": \"%016" PRIx64 "\",\n  \"survey_id\": \"",
                  PF_SOFTWARE, s->time.boot_id);
    for (size_t i = 0; i < sizeof s->survey_id; i++)
        (void)fprintf(out, "%02x", s->survey_id[i]);
    (void)fprintf(out, "\",\n  \"state\": \"%s\",\n  \"uptime_ns\": %" PRIu64 ",\n", s->state, s->uptime_ns);
    (void)fprintf(out,
                  "  \"frames\": %" PRIu64 ",\n  \"frames_dropped\": %" PRIu64
                  ",\n  \"tracks_live\": %u,\n  \"tracks_new\": %u,\n  \"tracks_lost\": %u,\n",
                  s->frames, s->frames_dropped, s->tracks_live, s->tracks_new, s->tracks_lost);
    (void)fprintf(out, "  \"keyframes\": %" PRIu64 ",\n  \"keyframes_dropped\": %" PRIu64 ",\n  \"fps\": %.3f,\n",
                  s->keyframes, s->keyframes_dropped, s->fps);
    (void)fprintf(out,
                  "  \"stage\": {\"capture\": %.1f, \"pyramid\": %.1f, \"track\": %.1f, \"detect\": %.1f, "
                  "\"keyframe\": %.1f, \"store\": %.1f, \"frame_max\": %.1f},\n",
                  (double)s->stage.capture, (double)s->stage.pyramid, (double)s->stage.track, (double)s->stage.detect,
                  (double)s->stage.keyframe, (double)s->stage.store, (double)s->stage.frame_max);
    (void)fprintf(out,
                  "  \"spool\": {\"objects\": %" PRIu64 ", \"bytes\": %" PRIu64 ", \"stored\": %" PRIu64
                  ", \"acknowledged\": %" PRIu64 ", \"evicted\": %u, \"errors\": %" PRIu64 ", \"refused\": %" PRIu64
                  "},\n",
                  s->spool.objects, s->spool.bytes, s->spool.stored, s->spool.acknowledged, s->spool.evicted,
                  s->spool.errors, store->refused);
    print_camera(out, camera);
    print_gpio(out, gpio);
    print_tracking(out, &s->tracking);
    (void)fprintf(
        out,
        "  \"link\": {\"up\": %s, \"bytes_out\": %" PRIu64 ", \"bytes_in\": %" PRIu64 ", \"frames_out\": %" PRIu64
        ", \"frames_in\": %" PRIu64 ", \"crc_errors\": %" PRIu64 ", \"malformed\": %" PRIu64
        ", \"fragments_sent\": %" PRIu64 ", \"fragments_resent\": %" PRIu64 ", \"objects_sent\": %" PRIu64
        ", \"sessions\": %" PRIu64 ", \"rtt_us\": %u, \"visitors\": %u, \"overruns\": %u}",
        s->link_up ? "true" : "false", s->link.bytes_out, s->link.bytes_in, s->link.frames_out, s->link.frames_in,
        s->link.crc_errors, s->link.malformed, s->link.fragments_sent, s->link.fragments_resent, s->link.objects_sent,
        s->link.sessions, s->link.rtt_us, s->visitors, overruns);
    print_text(out, "spool_trouble", store->trouble);
    if (s->telemetry.has_encoder)
        (void)fprintf(out, ",\n  \"encoder_count\": %" PRId64, s->telemetry.encoder_count);
    if (s->has_profile) {
        (void)fprintf(out, ",\n  \"profile\": {\"sha256\": \"");
        for (size_t i = 0; i < sizeof s->profile.sha256; i++)
            (void)fprintf(out, "%02x", s->profile.sha256[i]);
        (void)fprintf(out, "\", \"crc32c\": \"%08" PRIx32 "\", \"trial\": %s}", s->profile.crc32c,
                      s->profile.is_trial ? "true" : "false");
    }
    if (s->has_network)
        print_network(out, &s->network);
    if (problem[0] != '\0')
        print_text(out, "profile_problem", problem);
    if (s->has_clock)
        (void)fprintf(out, ",\n  \"clock\": {\"offset_ns\": %" PRId64 ", \"error_ns\": %" PRIu64 "}",
                      s->clock.offset_ns, s->clock.error_ns);
    (void)fputs("\n}\n", out);
}

bool pf_daemon_write_status(pf_daemon *d, const char *path, char *error, size_t n)
{
    char draft[PF_CONFIG_TEXT_MAX + 8];
    pf_msg_status status;
    char peer[PF_PEER_NAME_MAX];
    pf_store_stats store;
    pf_msg_profile_state profile;
    pf_keeper_texts texts = {.problem = ""};
    pf_camera_stats camera;
    pf_gpio_state gpio;
    uint32_t overruns;
    FILE *out;
    bool ok;
    (void)snprintf(draft, sizeof draft, "%s.new", path);
    out = fopen(draft, "w");
    if (out != NULL) {
        pf_daemon_status(d, &status, peer);
        pf_store_get_stats(d->store, &store);
        if (d->keeper != NULL)
            pf_keeper_state(d->keeper, &profile, &texts);
        pthread_mutex_lock(&d->counters.mutex);
        camera = d->counters.camera;
        overruns = d->counters.overruns;
        pthread_mutex_unlock(&d->counters.mutex);
        d->gpio.ops->state(d->gpio.self, &gpio);
        pf_utf8_clean(gpio.encoder);
        print_status(out, &status, &store, &camera, &gpio, overruns, texts.problem);
        ok = ferror(out) == 0;
        ok = fclose(out) == 0 && ok;
        if (ok && rename(draft, path) == 0)
            return true;
    }
    (void)snprintf(error, n, "%s: %s", path, strerror(errno));
    return false;
}
