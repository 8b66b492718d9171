#include "requests.h"

#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "keeper.h"
#include "log.h"
#include "pipefish/drivers/clock.h"

#define COMPLAIN_NS UINT64_C(1000000000)

bool pf_request_may_complain(void)
{
    static uint64_t due; /* the courier is one thread */
    const uint64_t now = pf_now();
    if (now < due)
        return false;
    due = now + COMPLAIN_NS;
    return true;
}

/* What it was let in as. */
static pf_role own_role(const pf_session *s)
{
    const pf_transport_stats *network;
    const char *name;
    return s->transport.ops->peer(s->transport.self, &name, &network);
}

pf_role pf_request_role(const pf_session *s)
{
    pf_role role = own_role(s);
    return s->is_visitor && role > PF_ROLE_VIEWER ? PF_ROLE_VIEWER : role;
}

static void set_lamp(pf_daemon *d, float level, pf_msg_reply *reply)
{
    pf_gpio *gpio = &d->gpio;
    pf_status status;
    if (!(level >= 0.0f && level <= 1.0f)) {
        reply->error = "lamp: must be 0..1";
        return;
    }
    status = gpio->ops->set_lamp(gpio->self, (double)level);
    if (status == PF_ERR_UNSUPPORTED)
        reply->error = "lamp: this crawler has none that can be set";
    else if (status == PF_ERR_CLOSED)
        reply->error = "lamp: off, for the emergency stop has been pressed";
    else if (status != PF_OK)
        reply->error = pf_status_text(status);
}

static void sync_clock(pf_daemon *d, const pf_msg_clock_sync *sync, pf_msg_reply *reply)
{
    pf_counters *k = &d->counters;
    if (sync->boot_id != d->boot_id) {
        reply->error = "clock_sync: measured in another boot";
        return;
    }
    pthread_mutex_lock(&k->mutex);
    k->has_clock = true;
    k->clock = *sync;
    pthread_mutex_unlock(&k->mutex);
    pf_log(PF_LOG_INFO, "host's clock: ours plus %" PRId64 " ns, within %" PRIu64 " ns", sync->offset_ns,
           sync->error_ns);
}

static void send_reply(pf_session *s, const pf_msg_reply *reply)
{
    uint8_t bytes[PF_CONTROL_MAX];
    size_t n;
    if (pf_msg_encode_reply(reply, bytes, sizeof bytes, &n) != PF_OK)
        return;
    pf_status sent = pf_link_send_control(s->link, bytes, n);
    if (sent != PF_OK && pf_request_may_complain())
        pf_log(PF_LOG_WARNING, "reply %u: %s", reply->id, pf_status_text(sent));
}

static void fill_status(pf_daemon *d, const pf_session *s, pf_msg_status *status, char *peer)
{
    pf_daemon_status(d, status, peer);
    if (s->is_visitor)
        status->looking_on = own_role(s) > PF_ROLE_VIEWER ? PF_LOOKING_BUSY : PF_LOOKING_VIEWER;
}

pf_status pf_request_status(pf_daemon *d, const pf_session *s, uint8_t *bytes, size_t *n)
{
    pf_msg_status status;
    char peer[PF_PEER_NAME_MAX];
    fill_status(d, s, &status, peer);
    return pf_msg_encode_status(&status, bytes, PF_CONTROL_MAX, n);
}

/* ---- profiles: the keeper does the work, and the answer follows */

void pf_request_answer_profile(pf_daemon *d, pf_session *s, uint32_t id, bool has_failed)
{
    pf_msg_reply reply = {.id = id, .error = ""};
    pf_keeper_texts texts;
    pf_msg_profile_state state;
    pf_keeper_state(d->keeper, &state, &texts);
    reply.profile = &state;
    if (has_failed)
        reply.error = state.problem;
    send_reply(s, &reply);
}

/* False: the keeper's answer follows. */
static bool ask_keeper(pf_daemon *d, pf_session *s, const pf_msg_request *request, pf_msg_reply *reply)
{
    pf_keeper *keeper = d->keeper;
    pf_keeper_job job = {.what = PF_KEEPER_REVERT, .id = request->id};
    if (keeper == NULL) {
        reply->error = d->config.camera.profile_store[0] == '\0'
                           ? "this device keeps no profiles: camera.profile_store is not set"
                           : "this device keeps no profiles: its disk was full or read-only when it started";
        return true;
    }
    if (request->what == PF_REQUEST_GET_PROFILE) {
        pf_request_answer_profile(d, s, request->id, false);
        return false;
    }
    if (request->what == PF_REQUEST_CONFIRM_PROFILE) {
        job.what = PF_KEEPER_CONFIRM;
        memcpy(job.sha256, request->profile_sha256, sizeof job.sha256);
    }
    if (pf_keeper_ask(keeper, &job, NULL, 0))
        return false;
    reply->error = "another profile is being stored: try again";
    return true;
}

static void ask_still(pf_daemon *d, pf_msg_reply *reply)
{
    const char *refusal = "still: the survey is over, the camera gives no frames";
    if (atomic_load(&d->state) == PF_STATE_SURVEYING)
        refusal = pf_still_ask(d->still);
    if (refusal != NULL)
        reply->error = refusal;
}

/* The least role that may ask for it. */
static pf_role role_for(pf_request_what what)
{
    switch (what) {
    case PF_REQUEST_GET_STATUS:
    case PF_REQUEST_GET_INFO:
    case PF_REQUEST_GET_PROFILE:
    case PF_REQUEST_UNKNOWN:
        return PF_ROLE_VIEWER;
    case PF_REQUEST_STOP_SURVEY:
    case PF_REQUEST_SET_LAMP:
    case PF_REQUEST_CLOCK_SYNC:
    case PF_REQUEST_SHUTDOWN:
    case PF_REQUEST_GET_STILL: /* an object */
        return PF_ROLE_OPERATOR;
    case PF_REQUEST_CONFIRM_PROFILE:
    case PF_REQUEST_REVERT_PROFILE:
    case PF_REQUEST_PAIR:
        break;
    }
    return PF_ROLE_CALIBRATOR;
}

/* False: the host's role is not enough, and the reply says so. */
static bool may_ask(const pf_session *s, pf_request_what what, pf_msg_reply *reply)
{
    pf_role has = pf_request_role(s), needs = role_for(what);
    if (has >= needs)
        return true;
    if (own_role(s) >= needs) {
        reply->error = "another host is connected to the device: until it has gone this one may only look on";
        if (pf_request_may_complain())
            pf_log(PF_LOG_WARNING, "request %u is refused: another host is connected", (unsigned)what);
        return false;
    }
    reply->error = needs == PF_ROLE_OPERATOR ? "this host may not: the role operator is needed"
                                             : "this host may not: the role calibrator is needed";
    if (pf_request_may_complain())
        pf_log(PF_LOG_WARNING, "request %u is refused: the host is a %s", (unsigned)what, pf_role_text(has));
    return false;
}

static void pair(pf_daemon *d, const pf_msg_pair *pair, pf_msg_reply *reply)
{
    pf_trust *trust = d->trust;
    if (trust == NULL) {
        reply->error = "this device lets no host in over a network: link.trust is not set";
        return;
    }
    pf_role role = pf_role_parse(pair->role, strlen(pair->role));
    if (pf_trust_set(trust, pair->key, role, pair->name) != PF_OK) {
        reply->error = pf_trust_error(trust);
        return;
    }
    char key[65];
    pf_key_print(pair->key, key);
    pf_log(PF_LOG_INFO, "host %s (key %.16s...) is from now on: %s", pair->name, key, pf_role_text(role));
    reply->paired_key = pf_trust_key(trust);
}

void pf_request_answer(pf_daemon *d, pf_session *s, const uint8_t *bytes, size_t size)
{
    pf_msg_request request;
    pf_msg_reply reply = {.error = ""};
    pf_msg_status status;
    char peer[PF_PEER_NAME_MAX];
    pf_msg_info info = {
        .software = PF_SOFTWARE, .source = d->source, .boot_id = d->boot_id, .schema = PF_SCHEMA_VERSION};
    bool is_answered = true;

    if (pf_msg_decode_request(bytes, size, &request) != PF_OK) {
        if (pf_request_may_complain())
            pf_log(PF_LOG_WARNING, "a request of %zu bytes is damaged", size);
        return;
    }
    reply.id = request.id;
    if (!may_ask(s, request.what, &reply)) {
        send_reply(s, &reply);
        return;
    }
    switch (request.what) {
    case PF_REQUEST_PAIR:
        pair(d, &request.pair, &reply);
        break;
    case PF_REQUEST_GET_STATUS:
        fill_status(d, s, &status, peer);
        reply.status = &status;
        break;
    case PF_REQUEST_GET_INFO:
        memcpy(info.survey_id, d->survey_id, sizeof info.survey_id);
        memcpy(info.profile_sha256, d->profile_sha256, sizeof info.profile_sha256);
        reply.info = &info;
        break;
    case PF_REQUEST_STOP_SURVEY:
        pf_log(PF_LOG_INFO, "the host stops the survey");
        pf_daemon_stop(d, PF_STOP_OPERATOR);
        break;
    case PF_REQUEST_SHUTDOWN:
        pf_log(PF_LOG_INFO, "the host shuts down");
        pf_daemon_stop(d, PF_STOP_SHUTDOWN);
        break;
    case PF_REQUEST_SET_LAMP:
        set_lamp(d, request.lamp, &reply);
        break;
    case PF_REQUEST_CLOCK_SYNC:
        sync_clock(d, &request.clock, &reply);
        break;
    case PF_REQUEST_GET_PROFILE:
    case PF_REQUEST_CONFIRM_PROFILE:
    case PF_REQUEST_REVERT_PROFILE:
        is_answered = ask_keeper(d, s, &request, &reply);
        break;
    case PF_REQUEST_GET_STILL:
        ask_still(d, &reply);
        break;
    case PF_REQUEST_UNKNOWN:
        reply.error = "unknown request";
        break;
    }
    if (is_answered)
        send_reply(s, &reply);
}
