#include "courier.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "keeper.h"
#include "log.h"
#include "pipefish/drivers/clock.h"
#include "pipefish/drivers/sha256.h"
#include "pulse.h"
#include "requests.h"
#include "session.h"

#define MS          UINT64_C(1000000) /* ns */
#define OVERRUNS_NS (1000 * MS)       /* a flood is one line in the log */
#define PUBLISH_NS  (50 * MS)         /* the link's counters go to the status at most so often */
#define LINGER_NS   (300 * MS)        /* time for the host to take in the last status and ask its last question */
#define SILENCES    4u                /* keepalives after which a peer counts as gone */

/* One that looks on while another host has the device: it sees status and previews. */
typedef struct visitor {
    pf_session session;
    uint64_t since_ns;
} visitor;

struct pf_courier {
    pf_daemon *daemon;
    pthread_t thread;
    _Atomic bool is_quitting;
    pf_session host;
    visitor visitors[PF_VISITORS_MAX];
    uint32_t overruns; /* of the transport, as they were last logged */
    uint64_t overruns_due;
    char failure[256]; /* of the transport, as it was last logged; "" since it is connected */
    uint64_t status_due, publish_due;
    uint32_t refused;                   /* strangers and hosts, when it was last looked at */
    pf_link_event profile;              /* one that the host has sent; its bytes are the link's until it is answered */
    bool has_profile, is_profile_asked; /* it waits for the keeper; the keeper has it */
    const uint8_t *still;               /* name of the one that the link sends; NULL = none */
    pthread_mutex_t preview_mutex;
    uint8_t preview[PF_PREVIEW_MAX];
    size_t preview_n; /* 0 = none waits */
};

/* Bytes come too fast for this machine: the link sends again what they were part of, and somebody should know. */
static uint32_t tell_overruns(pf_courier *c, uint64_t now)
{
    const pf_transport *t = &c->daemon->transport;
    const uint32_t overruns = t->ops->overruns != NULL ? t->ops->overruns(t->self) : 0;
    if (overruns != c->overruns && now >= c->overruns_due) {
        pf_log(PF_LOG_WARNING, "%s: overrun: at least %u bytes dropped so far before they could be read",
               t->ops->name(t->self), overruns);
        c->overruns = overruns;
        c->overruns_due = now + OVERRUNS_NS;
    }
    return overruns;
}

static void publish(pf_courier *c, uint64_t now)
{
    pf_counters *k = &c->daemon->counters;
    const pf_transport *t = &c->daemon->transport;
    const pf_transport_stats *network;
    const char *name;
    pf_role role = t->ops->peer(t->self, &name, &network);
    const uint32_t overruns = tell_overruns(c, now); /* without the mutex: the log may wait, and frames for the mutex */
    pthread_mutex_lock(&k->mutex);
    k->has_network = network != NULL;
    if (network != NULL) {
        k->network = *network;
        k->peer_role = role;
        (void)snprintf(k->peer_name, sizeof k->peer_name, "%s", name);
    }
    k->link_up = pf_link_is_up(c->host.link);
    k->link = *pf_link_get_stats(c->host.link);
    k->overruns = overruns;
    k->visitors = 0;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        k->visitors += c->visitors[i].session.transport.ops != NULL;
    pthread_mutex_unlock(&k->mutex);
    c->publish_due = now + PUBLISH_NS;
}

/* ---- profiles: the keeper does the work, and the answer follows */

static bool may_send(const pf_courier *c, uint32_t kind)
{
    return kind == PF_OBJECT_PROFILE && c->daemon->keeper != NULL && pf_request_role(&c->host) >= PF_ROLE_CALIBRATOR;
}

static void take_profile(pf_courier *c, const pf_link_event *e)
{
    uint8_t sha256[32];
    /* Asked again: a slot that one host was granted may be filled by another that knows the name. */
    if (!may_send(c, e->kind)) {
        (void)pf_link_answer_object(c->host.link, e->slot, PF_ANSWER_REFUSE);
        return;
    }
    bool is_whole = pf_sha256(e->data, e->size, sha256) == PF_OK && memcmp(sha256, e->name, sizeof sha256) == 0;
    if (!is_whole) {
        (void)pf_link_answer_object(c->host.link, e->slot, PF_ANSWER_AGAIN);
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
            (void)pf_link_answer_object(c->host.link, c->profile.slot,
                                        job.has_failed ? PF_ANSWER_REFUSE : PF_ANSWER_STORED);
            c->has_profile = false;
        } else {
            pf_request_answer_profile(c->daemon, &c->host, job.id, job.has_failed);
        }
    }
    if (c->has_profile && !c->is_profile_asked) {
        job = (pf_keeper_job){.what = PF_KEEPER_STORE};
        memcpy(job.sha256, c->profile.name, sizeof job.sha256);
        c->is_profile_asked = pf_keeper_ask(keeper, &job, c->profile.data, c->profile.size);
    }
}

/* ---- the still */

static void drop_still(pf_courier *c)
{
    if (c->still != NULL)
        (void)pf_link_cancel_object(c->host.link, c->still);
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
    if (pf_link_send_object(c->host.link, name, PF_OBJECT_RAW_FRAME, bytes, n) != PF_OK) {
        pf_log(PF_LOG_ERROR, "the link does not take a still of %zu bytes", n);
        drop_still(c);
    }
}

/* ---- events */

/* Who it is, where that is known: whose request it was then stands in the log behind it. */
static void tell_host(const pf_session *s, const char *what)
{
    const pf_transport_stats *network;
    const char *name;
    pf_role role = s->transport.ops->peer(s->transport.self, &name, &network);
    if (network != NULL)
        pf_log(PF_LOG_INFO, "%s: %s, %s", what, name, pf_role_text(role));
    else
        pf_log(PF_LOG_INFO, "%s", what);
}

static void take_event(void *context, pf_session *s, const pf_link_event *e, uint64_t now)
{
    pf_courier *c = context;
    switch ((pf_link_event_type)e->type) {
    case PF_LINK_UP:
        tell_host(s, e->peer_restarted ? "host is there (started anew)" : "host is there");
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
        publish(c, now);
        pf_request_answer(c->daemon, s, e->data, e->size);
        break;
    case PF_LINK_LATEST: /* the host has none to send */
        break;
    case PF_LINK_OFFER:
        (void)pf_link_answer_object(c->host.link, e->slot, may_send(c, e->kind) ? PF_ANSWER_ACCEPT : PF_ANSWER_REFUSE);
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

/* A visitor's link carries no objects. */
static void take_visitor_event(void *context, pf_session *s, const pf_link_event *e, uint64_t now)
{
    pf_courier *c = context;
    if (e->type == PF_LINK_UP) {
        tell_host(s, "a host looks on");
        c->status_due = now;
    } else if (e->type == PF_LINK_DOWN) {
        s->has_stream = false;
    } else if (e->type == PF_LINK_CONTROL) {
        take_event(c, s, e, now);
    }
}

/* ---- bytes */

/* Logs what is wrong with the transport, once for each change of its words: it is asked again and again. Of one that
 * listens anybody changes them at will: a line a second, and what is still so then. */
static void tell_failure(pf_courier *c)
{
    const pf_transport *t = &c->daemon->transport;
    char failure[sizeof c->failure];
    (void)snprintf(failure, sizeof failure, "%s", t->ops->error(t->self));
    if (strcmp(failure, c->failure) == 0 || (t->ops->visitor != NULL && !pf_request_may_complain()))
        return;
    memcpy(c->failure, failure, sizeof c->failure);
    pf_log(PF_LOG_WARNING, "%s: %s", t->ops->name(t->self), failure);
}

/* Those who were turned away while a host is there; without one it is the transport's failure and told as such. */
static void tell_refused(pf_courier *c)
{
    const pf_transport *t = &c->daemon->transport;
    const pf_transport_stats *s;
    const char *name;
    (void)t->ops->peer(t->self, &name, &s);
    if (s == NULL)
        return;
    const uint32_t refused = s->refused_unknown + s->refused_revoked + s->refused_handshake + s->refused_late +
                             s->refused_often + s->refused_busy;
    if (c->host.has_stream && refused != c->refused) {
        if (!pf_request_may_complain())
            return;
        pf_log(PF_LOG_WARNING, "%s: turned away: %s", t->ops->name(t->self), t->ops->error(t->self));
    }
    c->refused = refused;
}

static void lose_stream(pf_courier *c, uint64_t now)
{
    tell_failure(c);
    pf_session_reset(&c->host, take_event, c, now);
}

static void service(pf_courier *c, uint64_t now)
{
    pf_transport *t = &c->daemon->transport;
    bool is_fresh = false;
    pf_status status = t->ops->service(t->self, &is_fresh);
    if (is_fresh) {
        pf_session_begin(&c->host, take_event, c, now);
        c->failure[0] = '\0';
        pf_log(PF_LOG_DEBUG, "%s: connected", t->ops->name(t->self));
    }
    if (status == PF_OK)
        c->host.has_stream = true;
    else if (c->host.has_stream)
        lose_stream(c, now); /* it ended here, not in a read: a revoked key */
    else
        tell_failure(c);
    tell_refused(c);
}

/* ---- those that look on */

static void end_visit(visitor *v)
{
    pf_session *s = &v->session;
    s->transport.ops->close(s->transport.self);
    s->transport.ops = NULL;
    s->has_stream = false;
    pf_log(PF_LOG_DEBUG, "a visitor has gone");
}

static void take_visitors(pf_courier *c, uint64_t now)
{
    const pf_transport *t = &c->daemon->transport;
    for (uint32_t i = 0; i < PF_VISITORS_MAX && t->ops->visitor != NULL; i++) {
        visitor *v = &c->visitors[i];
        if (v->session.transport.ops != NULL || !t->ops->visitor(t->self, &v->session.transport))
            continue;
        pf_session_begin(&v->session, take_visitor_event, c, now);
        v->session.has_stream = true;
        v->since_ns = now;
    }
}

/* Reads from the visitors, and sees those off that have gone, or never said anything. */
static void hear_visitors(pf_courier *c, uint64_t now)
{
    const uint64_t patience = SILENCES * c->daemon->config.link.keepalive_ms * MS;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        visitor *v = &c->visitors[i];
        pf_session *s = &v->session;
        if (s->transport.ops == NULL)
            continue;
        bool is_there = pf_session_read(s, take_visitor_event, c, now) && s->has_stream;
        if (!is_there || (!pf_link_is_up(s->link) && now - v->since_ns > patience))
            end_visit(v);
    }
}

/* When one of the visitors' links wants to be asked again; UINT64_MAX: never. */
static uint64_t tell_visitors(pf_courier *c, uint64_t now)
{
    uint64_t deadline = UINT64_MAX;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        visitor *v = &c->visitors[i];
        bool is_full;
        if (v->session.transport.ops == NULL)
            continue;
        if (!pf_session_write(&v->session, now, &is_full)) {
            end_visit(v);
            continue;
        }
        uint64_t due = is_full ? now + MS : pf_link_deadline(v->session.link, now);
        if (due < deadline)
            deadline = due;
    }
    return deadline;
}

static bool is_watched(const pf_courier *c)
{
    bool is_up = pf_link_is_up(c->host.link);
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        is_up = is_up || (c->visitors[i].session.transport.ops != NULL && pf_link_is_up(c->visitors[i].session.link));
    return is_up;
}

/* ---- what the daemon sends */

static void send_status(pf_courier *c, uint64_t now)
{
    uint8_t bytes[PF_CONTROL_MAX];
    size_t n;
    publish(c, now);
    /* One that looks on is told so: the messages differ. */
    if (pf_request_status(c->daemon, &c->host, bytes, &n) == PF_OK)
        (void)pf_link_send_latest(c->host.link, PF_TOPIC_STATUS, bytes, n);
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        pf_session *s = &c->visitors[i].session;
        if (s->transport.ops != NULL && pf_request_status(c->daemon, s, bytes, &n) == PF_OK)
            (void)pf_link_send_latest(s->link, PF_TOPIC_STATUS, bytes, n);
    }
    c->status_due = now + c->daemon->config.status.interval_ms * MS;
}

static void send_preview(pf_courier *c)
{
    pthread_mutex_lock(&c->preview_mutex);
    if (c->preview_n > 0)
        (void)pf_link_send_latest(c->host.link, PF_TOPIC_PREVIEW, c->preview, c->preview_n);
    for (uint32_t i = 0; i < PF_VISITORS_MAX && c->preview_n > 0; i++)
        if (c->visitors[i].session.transport.ops != NULL)
            (void)pf_link_send_latest(c->visitors[i].session.link, PF_TOPIC_PREVIEW, c->preview, c->preview_n);
    c->preview_n = 0;
    pthread_mutex_unlock(&c->preview_mutex);
}

static void send_objects(pf_courier *c)
{
    /* One slot is the still's. */
    while (pf_link_free_send_slots(c->host.link) > (c->still == NULL ? 1u : 0u)) {
        pf_slot *slot = pf_store_next_slot(c->daemon->store);
        if (slot == NULL)
            return;
        if (pf_link_send_object(c->host.link, slot->item.name, slot->item.kind, slot->bytes, slot->item.size) !=
            PF_OK) {
            pf_log(PF_LOG_ERROR, "the link does not take an object of %u bytes: removed", slot->item.size);
            pf_store_release_slot(c->daemon->store, slot->item.name, true);
        }
    }
}

/* Waits until the host's link wants something at `deadline`, or longer if its line takes nothing, but not past
 * `latest`.
 */
static void wait_for_work(pf_courier *c, uint64_t deadline, uint64_t latest, bool is_full)
{
    pf_transport *t = &c->daemon->transport;
    uint64_t now = pf_now(), count, wait;
    struct timespec timeout;
    struct pollfd fds[2] = {{.fd = c->daemon->wake_fd, .events = POLLIN},
                            {.fd = t->ops->fd(t->self), .events = POLLIN}};
    if (c->host.out_at < c->host.out_n) {
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
        uint64_t now = pf_now(), deadline, latest;
        bool is_full;
        if (quit_at == UINT64_MAX && atomic_load(&c->is_quitting)) {
            quit_at = pf_link_is_up(c->host.link) ? now + LINGER_NS : now;
            c->status_due = now;
            pf_log(PF_LOG_DEBUG, "the link closes");
        }
        /* Who has spoken is heard before another gets the line: this machine may have stood still meanwhile. */
        if (!pf_session_read(&c->host, take_event, c, now))
            lose_stream(c, now);
        service(c, now);
        take_visitors(c, now);
        hear_visitors(c, now);
        serve_keeper(c);
        if (is_watched(c)) {
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
        if (!pf_session_write(&c->host, now, &is_full))
            lose_stream(c, now);
        uint64_t visitors_due = tell_visitors(c, now);
        if (now >= quit_at || (quit_at != UINT64_MAX && !pf_link_is_up(c->host.link)))
            break;
        deadline = pf_link_deadline(c->host.link, now);
        if (!c->host.has_stream) /* the link has its hello ready all the time */
            deadline = now + PF_TRANSPORT_RETRY_MS * MS;
        latest = quit_at < visitors_due ? quit_at : visitors_due;
        if (c->daemon->transport.ops->visitor != NULL && now + PF_TRANSPORT_RETRY_MS * MS < latest)
            latest = now + PF_TRANSPORT_RETRY_MS * MS; /* handshakes that take too long, keys that were revoked */
        if (is_watched(c) && c->status_due < latest)
            latest = c->status_due;
        pf_pulse_rest();
        wait_for_work(c, deadline, latest, is_full);
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
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        if (c->visitors[i].session.transport.ops != NULL)
            end_visit(&c->visitors[i]);
        pf_session_close(&c->visitors[i].session);
    }
    pf_session_close(&c->host);
    free(c);
}

/* Everything that the link needs, for the host and for those that look on. */
static pf_status open_sessions(pf_courier *c)
{
    const pf_daemon *d = c->daemon;
    const pf_config *config = &d->config;
    pf_link_config lc = {.role = PF_LINK_DEVICE,
                         .boot_id = d->boot_id,
                         .schema = PF_SCHEMA_VERSION,
                         .max_fragment = config->link.max_fragment,
                         .send_slots = config->link.send_slots < PF_LINK_SLOTS_MAX
                                           ? config->link.send_slots + 1
                                           : PF_LINK_SLOTS_MAX, /* the still's too */
                         .receive_slots = d->keeper != NULL ? 1 : 0,
                         .max_object = d->keeper != NULL ? PF_PROFILE_BINARY_MAX : 0,
                         .max_latest = PF_PREVIEW_MAX,
                         .max_control = PF_CONTROL_MAX,
                         .window = config->link.window,
                         .keepalive_ms = config->link.keepalive_ms,
                         .rto_min_ms = config->link.rto_min_ms};
    pf_status status = pf_session_open(&c->host, &lc);
    c->host.transport = d->transport;
    lc.send_slots = 1;
    lc.receive_slots = lc.max_object = 0;
    for (uint32_t i = 0; i < PF_VISITORS_MAX && status == PF_OK && d->transport.ops->visitor != NULL; i++) {
        status = pf_session_open(&c->visitors[i].session, &lc);
        c->visitors[i].session.is_visitor = true;
    }
    return status;
}

bool pf_courier_open(pf_courier **courier, pf_daemon *daemon, char *error, size_t n)
{
    pf_courier *c = calloc(1, sizeof *c);
    if (c == NULL) {
        (void)snprintf(error, n, "link: no memory");
        return false;
    }
    c->daemon = daemon;
    pf_status status = open_sessions(c);
    if (status != PF_OK) {
        (void)snprintf(error, n, "link: %s",
                       status == PF_ERR_SPACE ? "no memory" : "a setting of [link] is out of range");
        release(c);
        return false;
    }
    pthread_mutex_init(&c->preview_mutex, NULL);
    if (pthread_create(&c->thread, NULL, run, c) != 0) {
        (void)snprintf(error, n, "cannot start the link thread");
        pthread_mutex_destroy(&c->preview_mutex);
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
    pthread_mutex_destroy(&c->preview_mutex);
    release(c);
}
