#include "courier.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#include "clock.h"
#include "keeper.h"
#include "log.h"
#include "pipefish/drivers/sha256.h"
#include "pulse.h"

#define MS          UINT64_C(1000000) /* ns */
#define PUBLISH_NS  (50 * MS)         /* the link's counters go to the status at most so often */
#define LINGER_NS   (300 * MS)        /* time for the host to take in the last status and ask its last question */
#define READ_MAX    65536u            /* bytes taken in one round, lest output waits for ever */
#define CONTROL_MAX 1000u             /* bytes: a status at its largest has about 500 */

struct pf_courier {
    pf_daemon *daemon;
    pthread_t thread;
    _Atomic bool is_quitting;
    pf_link *link;
    void *workspace;
    bool has_stream;    /* the transport is connected */
    char failure[256];  /* of the transport, as it was last logged; "" since it is connected */
    uint8_t out[16384]; /* frames that the transport has not taken yet: out[out_at .. out_n) */
    size_t out_at, out_n;
    uint64_t status_due, publish_due;
    pf_link_event profile;              /* one that the host has sent; its bytes are the link's until it is answered */
    bool has_profile, is_profile_asked; /* it waits for the keeper; the keeper has it */
    const uint8_t *still;               /* name of the one that the link sends; NULL = none */
    uint8_t message[CONTROL_MAX];       /* status and replies */
    pthread_mutex_t preview_mutex;
    uint8_t preview[PF_PREVIEW_MAX];
    size_t preview_n; /* 0 = none waits */
};

static void publish(pf_courier *c, uint64_t now)
{
    pf_counters *k = &c->daemon->counters;
    const pf_transport *t = &c->daemon->transport;
    const pf_transport_stats *network;
    const char *name;
    pf_role role = t->ops->peer(t->self, &name, &network);
    pthread_mutex_lock(&k->mutex);
    k->has_network = network != NULL;
    if (network != NULL) {
        k->network = *network;
        k->peer_role = role;
        (void)snprintf(k->peer_name, sizeof k->peer_name, "%s", name);
    }
    k->link_up = pf_link_is_up(c->link);
    k->link = *pf_link_get_stats(c->link);
    pthread_mutex_unlock(&k->mutex);
    c->publish_due = now + PUBLISH_NS;
}

/* ---- control */

static pf_role peer_role(const pf_courier *c)
{
    const pf_transport *t = &c->daemon->transport;
    const pf_transport_stats *network;
    const char *name;
    return t->ops->peer(t->self, &name, &network);
}

static void set_lamp(pf_courier *c, float level, pf_msg_reply *reply)
{
    pf_gpio *gpio = &c->daemon->gpio;
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

static void sync_clock(pf_courier *c, const pf_msg_clock_sync *sync, pf_msg_reply *reply)
{
    pf_counters *k = &c->daemon->counters;
    if (sync->boot_id != c->daemon->boot_id) {
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

static void send_reply(pf_courier *c, const pf_msg_reply *reply)
{
    size_t n;
    pf_status sent;
    if (pf_msg_encode_reply(reply, c->message, sizeof c->message, &n) != PF_OK)
        return;
    sent = pf_link_send_control(c->link, c->message, n);
    if (sent != PF_OK)
        pf_log(PF_LOG_WARNING, "reply %u: %s", reply->id, pf_status_text(sent));
}

/* ---- profiles: the keeper does the work, and the answer follows */

static void reply_profile(pf_courier *c, pf_msg_reply *reply, bool has_failed)
{
    pf_keeper_texts texts;
    pf_msg_profile_state state;
    pf_keeper_state(c->daemon->keeper, &state, &texts);
    reply->profile = &state;
    if (has_failed)
        reply->error = state.problem;
    send_reply(c, reply);
}

/* False: the keeper's answer follows. */
static bool ask_keeper(pf_courier *c, const pf_msg_request *request, pf_msg_reply *reply)
{
    pf_keeper *keeper = c->daemon->keeper;
    pf_keeper_job job = {.what = PF_KEEPER_REVERT, .id = request->id};
    if (keeper == NULL) {
        reply->error = "this device keeps no profiles: camera.profile_store is not set";
        return true;
    }
    if (request->what == PF_REQUEST_GET_PROFILE) {
        reply_profile(c, reply, false);
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

static bool may_send(const pf_courier *c, uint32_t kind)
{
    return kind == PF_OBJECT_PROFILE && c->daemon->keeper != NULL && peer_role(c) >= PF_ROLE_CALIBRATOR;
}

static void ask_still(pf_courier *c, pf_msg_reply *reply)
{
    const char *refusal = "still: the survey is over, the camera gives no frames";
    if (atomic_load(&c->daemon->state) == PF_STATE_SURVEYING)
        refusal = pf_still_ask(c->daemon->still);
    if (refusal != NULL)
        reply->error = refusal;
}

static void take_profile(pf_courier *c, const pf_link_event *e)
{
    uint8_t sha256[32];
    bool is_whole = pf_sha256(e->data, e->size, sha256) == PF_OK && memcmp(sha256, e->name, sizeof sha256) == 0;
    if (!is_whole) {
        (void)pf_link_answer_object(c->link, e->slot, PF_ANSWER_AGAIN);
        return;
    }
    c->profile = *e;
    c->has_profile = true;
    c->is_profile_asked = false;
}

static void serve_keeper(pf_courier *c)
{
    pf_keeper *keeper = c->daemon->keeper;
    pf_keeper_job job;
    if (keeper == NULL)
        return;
    if (pf_keeper_done(keeper, &job)) {
        if (job.what == PF_KEEPER_STORE) {
            (void)pf_link_answer_object(c->link, c->profile.slot, job.has_failed ? PF_ANSWER_REFUSE : PF_ANSWER_STORED);
            c->has_profile = false;
        } else {
            reply_profile(c, &(pf_msg_reply){.id = job.id, .error = ""}, job.has_failed);
        }
    }
    if (c->has_profile && !c->is_profile_asked) {
        job = (pf_keeper_job){.what = PF_KEEPER_STORE};
        memcpy(job.sha256, c->profile.name, sizeof job.sha256);
        c->is_profile_asked = pf_keeper_ask(keeper, &job, c->profile.data, c->profile.size);
    }
}

/* ---- requests */

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
static bool may_ask(const pf_courier *c, pf_request_what what, pf_msg_reply *reply)
{
    pf_role has = peer_role(c), needs = role_for(what);
    if (has >= needs)
        return true;
    reply->error = needs == PF_ROLE_OPERATOR ? "this host may not: the role operator is needed"
                                             : "this host may not: the role calibrator is needed";
    pf_log(PF_LOG_WARNING, "request %u is refused: the host is a %s", (unsigned)what, pf_role_text(has));
    return false;
}

static void pair(pf_courier *c, const pf_msg_pair *pair, pf_msg_reply *reply)
{
    pf_trust *trust = c->daemon->trust;
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

static void answer(pf_courier *c, const uint8_t *bytes, size_t size, uint64_t now)
{
    pf_daemon *d = c->daemon;
    pf_msg_request request;
    pf_msg_reply reply = {.error = ""};
    pf_msg_status status;
    char peer[PF_PEER_NAME_MAX];
    pf_msg_info info = {
        .software = PF_SOFTWARE, .source = d->source, .boot_id = d->boot_id, .schema = PF_SCHEMA_VERSION};
    bool is_answered = true;

    if (pf_msg_decode_request(bytes, size, &request) != PF_OK) {
        pf_log(PF_LOG_WARNING, "a request of %zu bytes is damaged", size);
        return;
    }
    reply.id = request.id;
    if (!may_ask(c, request.what, &reply)) {
        send_reply(c, &reply);
        return;
    }
    switch (request.what) {
    case PF_REQUEST_PAIR:
        pair(c, &request.pair, &reply);
        break;
    case PF_REQUEST_GET_STATUS:
        publish(c, now);
        pf_daemon_status(d, &status, peer);
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
        set_lamp(c, request.lamp, &reply);
        break;
    case PF_REQUEST_CLOCK_SYNC:
        sync_clock(c, &request.clock, &reply);
        break;
    case PF_REQUEST_GET_PROFILE:
    case PF_REQUEST_CONFIRM_PROFILE:
    case PF_REQUEST_REVERT_PROFILE:
        is_answered = ask_keeper(c, &request, &reply);
        break;
    case PF_REQUEST_GET_STILL:
        ask_still(c, &reply);
        break;
    case PF_REQUEST_UNKNOWN:
        reply.error = "unknown request";
        break;
    }
    if (is_answered)
        send_reply(c, &reply);
}

/* ---- the still */

static void drop_still(pf_courier *c)
{
    if (c->still != NULL)
        (void)pf_link_cancel_object(c->link, c->still);
    c->still = NULL;
    pf_still_drop(c->daemon->still);
}

/* Whether the object was the still, which is done. */
static bool end_still(pf_courier *c, const uint8_t name[32])
{
    if (c->still == NULL || memcmp(c->still, name, 32) != 0)
        return false;
    c->still = NULL;
    pf_still_drop(c->daemon->still);
    return true;
}

static void send_still(pf_courier *c)
{
    const uint8_t *bytes, *name;
    size_t n;
    if (!pf_still_next(c->daemon->still, &bytes, &n, &name))
        return;
    c->still = name;
    if (pf_link_send_object(c->link, name, PF_OBJECT_RAW_FRAME, bytes, n) != PF_OK) {
        pf_log(PF_LOG_ERROR, "the link does not take a still of %zu bytes", n);
        drop_still(c);
    }
}

/* ---- events */

static void take_event(pf_courier *c, const pf_link_event *e, uint64_t now)
{
    switch ((pf_link_event_type)e->type) {
    case PF_LINK_UP:
        pf_log(PF_LOG_INFO, "host is there%s", e->peer_restarted ? " (started anew)" : "");
        if (e->peer_restarted)
            drop_still(c); /* the host before asked for it */
        c->status_due = now;
        publish(c, now);
        break;
    case PF_LINK_DOWN:
        pf_log(PF_LOG_INFO, "host has gone");
        publish(c, now);
        break;
    case PF_LINK_INCOMPATIBLE:
        pf_log(PF_LOG_ERROR, "the host speaks version %u of the link, this daemon %u", e->peer_version,
               PF_LINK_VERSION);
        break;
    case PF_LINK_CONTROL:
        answer(c, e->data, e->size, now);
        break;
    case PF_LINK_LATEST: /* the host has none to send */
        break;
    case PF_LINK_OFFER:
        (void)pf_link_answer_object(c->link, e->slot, may_send(c, e->kind) ? PF_ANSWER_ACCEPT : PF_ANSWER_REFUSE);
        break;
    case PF_LINK_OBJECT:
        take_profile(c, e);
        break;
    case PF_LINK_SENT:
        if (!end_still(c, e->name))
            pf_store_release_slot(c->daemon->store, e->name, false);
        break;
    case PF_LINK_REFUSED:
        if (end_still(c, e->name)) {
            pf_log(PF_LOG_ERROR, "the host refuses a still of %u bytes", e->size);
            break;
        }
        pf_log(PF_LOG_ERROR, "the host refuses an object of %u bytes, kind %u: removed", e->size, e->kind);
        pf_store_release_slot(c->daemon->store, e->name, true);
        break;
    }
}

static void take_events(pf_courier *c, uint64_t now)
{
    pf_link_event event;
    while (pf_link_next_event(c->link, &event))
        take_event(c, &event, now);
}

/* ---- bytes */

/* Logs what is wrong with the transport, once for each change of its words: it is asked again and again. */
static void tell_failure(pf_courier *c)
{
    const pf_transport *t = &c->daemon->transport;
    char failure[sizeof c->failure];
    (void)snprintf(failure, sizeof failure, "%s", t->ops->error(t->self));
    if (strcmp(failure, c->failure) == 0)
        return;
    memcpy(c->failure, failure, sizeof c->failure);
    pf_log(PF_LOG_WARNING, "%s: %s", t->ops->name(t->self), failure);
}

static void drop_session(pf_courier *c, uint64_t now)
{
    c->has_stream = false;
    c->out_at = c->out_n = 0;
    pf_link_reset(c->link, now);
    take_events(c, now);
}

static void lose_stream(pf_courier *c, uint64_t now)
{
    tell_failure(c);
    drop_session(c, now);
}

static void service(pf_courier *c, uint64_t now)
{
    pf_transport *t = &c->daemon->transport;
    bool is_fresh = false;
    pf_status status = t->ops->service(t->self, &is_fresh);
    if (is_fresh) {
        drop_session(c, now);
        pf_link_hold_objects(c->link, peer_role(c) < PF_ROLE_OPERATOR);
        c->failure[0] = '\0';
        pf_log(PF_LOG_DEBUG, "%s: connected", t->ops->name(t->self));
    }
    c->has_stream = status == PF_OK;
    if (!c->has_stream)
        tell_failure(c);
}

static void read_stream(pf_courier *c, uint64_t now)
{
    pf_transport *t = &c->daemon->transport;
    uint8_t bytes[4096];
    size_t total = 0, n = 0;
    while (c->has_stream && total < READ_MAX) {
        size_t at = 0;
        if (t->ops->read(t->self, bytes, sizeof bytes, &n) != PF_OK) {
            lose_stream(c, now);
            return;
        }
        if (n == 0)
            return;
        while (at < n) {
            at += pf_link_input(c->link, bytes + at, n - at, now);
            take_events(c, now);
        }
        total += n;
    }
}

/* Writes what fits; true if the link may have more that the line has no room for now. */
static bool write_stream(pf_courier *c, uint64_t now)
{
    pf_transport *t = &c->daemon->transport;
    while (c->has_stream) {
        size_t done = 0;
        if (c->out_at == c->out_n) {
            size_t room = t->ops->room(t->self);
            if (room < PF_LINK_FRAME_MAX)
                return true;
            c->out_at = 0;
            c->out_n = pf_link_output(c->link, c->out, room < sizeof c->out ? room : sizeof c->out, now);
            if (c->out_n == 0)
                return false;
        }
        if (t->ops->write(t->self, c->out + c->out_at, c->out_n - c->out_at, &done) != PF_OK) {
            lose_stream(c, now);
            return false;
        }
        c->out_at += done;
        if (c->out_at < c->out_n)
            return true;
    }
    return false;
}

/* ---- what the daemon sends */

static void send_status(pf_courier *c, uint64_t now)
{
    pf_msg_status status;
    char peer[PF_PEER_NAME_MAX];
    size_t n;
    publish(c, now);
    pf_daemon_status(c->daemon, &status, peer);
    if (pf_msg_encode_status(&status, c->message, sizeof c->message, &n) == PF_OK)
        (void)pf_link_send_latest(c->link, PF_TOPIC_STATUS, c->message, n);
    c->status_due = now + c->daemon->config.status.interval_ms * MS;
}

static void send_preview(pf_courier *c)
{
    pthread_mutex_lock(&c->preview_mutex);
    if (c->preview_n > 0)
        (void)pf_link_send_latest(c->link, PF_TOPIC_PREVIEW, c->preview, c->preview_n);
    c->preview_n = 0;
    pthread_mutex_unlock(&c->preview_mutex);
}

static void send_objects(pf_courier *c)
{
    /* One slot is the still's. */
    while (pf_link_free_send_slots(c->link) > (c->still == NULL ? 1u : 0u)) {
        pf_slot *slot = pf_store_next_slot(c->daemon->store);
        if (slot == NULL)
            return;
        if (pf_link_send_object(c->link, slot->item.name, slot->item.kind, slot->bytes, slot->item.size) != PF_OK) {
            pf_log(PF_LOG_ERROR, "the link does not take an object of %u bytes: removed", slot->item.size);
            pf_store_release_slot(c->daemon->store, slot->item.name, true);
        }
    }
}

/* Waits until `deadline`, or longer if the line takes nothing, but not past `latest`. */
static void wait_for_work(pf_courier *c, uint64_t deadline, uint64_t latest, bool is_full)
{
    pf_transport *t = &c->daemon->transport;
    uint64_t now = pf_now(), count, wait;
    struct timespec timeout;
    struct pollfd fds[2] = {{.fd = c->daemon->wake_fd, .events = POLLIN},
                            {.fd = t->ops->fd(t->self), .events = POLLIN}};
    if (c->out_at < c->out_n) {
        /* Nothing can be sent before the line takes these; only silence is to be noticed, after four of such times. */
        fds[1].events |= POLLOUT;
        deadline = now + c->daemon->config.link.keepalive_ms * MS;
    } else if (is_full && deadline < now + MS) {
        deadline = now + MS; /* no descriptor tells when the line has room again */
    }
    if (deadline > latest)
        deadline = latest;
    /* A deadline that has passed although nothing could be sent must not become a busy loop. */
    wait = deadline > now + MS / 4 ? deadline - now : MS / 4;
    timeout = (struct timespec){(time_t)(wait / 1000000000u), (long)(wait % 1000000000u)};
    (void)ppoll(fds, fds[1].fd >= 0 ? 2 : 1, &timeout, NULL);
    if (fds[0].revents & POLLIN)
        if (read(c->daemon->wake_fd, &count, sizeof count) < 0)
            pf_log(PF_LOG_ERROR, "wake-up: %s", strerror(errno));
}

static void *run(void *argument)
{
    pf_courier *c = argument;
    uint64_t quit_at = UINT64_MAX;
    pf_pulse_begin(PF_PULSE_COURIER);
    for (;;) {
        pf_pulse_work();
        uint64_t now = pf_now(), deadline;
        bool is_full;
        if (quit_at == UINT64_MAX && atomic_load(&c->is_quitting)) {
            quit_at = pf_link_is_up(c->link) ? now + LINGER_NS : now;
            c->status_due = now;
            pf_log(PF_LOG_DEBUG, "the link closes");
        }
        service(c, now);
        read_stream(c, now);
        (void)pf_link_input(c->link, NULL, 0, now); /* a full line gets no output, and silence must be noticed */
        take_events(c, now);
        serve_keeper(c);
        if (pf_link_is_up(c->link)) {
            if (now >= c->status_due)
                send_status(c, now);
            send_preview(c);
        }
        if (quit_at == UINT64_MAX) {
            send_still(c);
            send_objects(c);
        }
        if (now >= c->publish_due)
            publish(c, now);
        is_full = write_stream(c, now);
        if (now >= quit_at || (quit_at != UINT64_MAX && !pf_link_is_up(c->link)))
            break;
        deadline = pf_link_deadline(c->link, now);
        if (!c->has_stream) /* the link has its hello ready all the time */
            deadline = now + PF_TRANSPORT_RETRY_MS * MS;
        if (pf_link_is_up(c->link) && c->status_due < deadline)
            deadline = c->status_due;
        pf_pulse_rest();
        wait_for_work(c, deadline, quit_at, is_full);
    }
    publish(c, pf_now());
    pf_pulse_rest();
    return NULL;
}

void pf_courier_wake(pf_courier *c)
{
    uint64_t one = 1;
    if (write(c->daemon->wake_fd, &one, sizeof one) < 0)
        pf_log(PF_LOG_ERROR, "cannot wake the courier");
}

void pf_courier_preview(pf_courier *c, const uint8_t *bytes, size_t n)
{
    pthread_mutex_lock(&c->preview_mutex);
    memcpy(c->preview, bytes, n);
    c->preview_n = n;
    pthread_mutex_unlock(&c->preview_mutex);
    pf_courier_wake(c);
}

static void release(pf_courier *c)
{
    pthread_mutex_destroy(&c->preview_mutex);
    free(c->workspace);
    free(c);
}

bool pf_courier_open(pf_courier **courier, pf_daemon *daemon, char *error, size_t n)
{
    const pf_config *config = &daemon->config;
    pf_link_config lc = {.role = PF_LINK_DEVICE,
                         .boot_id = daemon->boot_id,
                         .schema = PF_SCHEMA_VERSION,
                         .max_fragment = config->link.max_fragment,
                         .send_slots = config->link.send_slots < PF_LINK_SLOTS_MAX
                                           ? config->link.send_slots + 1
                                           : PF_LINK_SLOTS_MAX, /* the still's too */
                         .receive_slots = daemon->keeper != NULL ? 1 : 0,
                         .max_object = daemon->keeper != NULL ? PF_PROFILE_BINARY_MAX : 0,
                         .max_latest = PF_PREVIEW_MAX,
                         .max_control = CONTROL_MAX,
                         .window = config->link.window,
                         .keepalive_ms = config->link.keepalive_ms,
                         .rto_min_ms = config->link.rto_min_ms};
    pf_courier *c = calloc(1, sizeof *c);
    size_t size;
    while (lc.nonce == 0)
        if (getrandom(&lc.nonce, sizeof lc.nonce, 0) != (ssize_t)sizeof lc.nonce)
            break;
    size = pf_link_workspace_size(&lc);
    if (c == NULL || size == 0 || (c->workspace = aligned_alloc(16, (size + 15) / 16 * 16)) == NULL ||
        pf_link_init(&c->link, &lc, c->workspace, size) != PF_OK) {
        (void)snprintf(error, n, "link: %s", size == 0 ? "a setting of [link] is out of range" : "no memory");
        if (c != NULL)
            free(c->workspace);
        free(c);
        return false;
    }
    c->daemon = daemon;
    pthread_mutex_init(&c->preview_mutex, NULL);
    if (pthread_create(&c->thread, NULL, run, c) != 0) {
        (void)snprintf(error, n, "cannot start the link thread");
        release(c);
        return false;
    }
    *courier = c;
    return true;
}

void pf_courier_close(pf_courier *c)
{
    atomic_store(&c->is_quitting, true);
    pf_courier_wake(c);
    (void)pthread_join(c->thread, NULL);
    release(c);
}
