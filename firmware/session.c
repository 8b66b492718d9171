#include "session.h"

#include <stdlib.h>
#include <string.h>
#include <sys/random.h>

#define READ_MAX 65536u /* bytes taken in one round */

/* 0: the system has no random numbers. */
static uint32_t draw_nonce(void)
{
    uint32_t nonce = 0;
    while (nonce == 0)
        if (getrandom(&nonce, sizeof nonce, 0) != (ssize_t)sizeof nonce)
            return 0;
    return nonce;
}

pf_status pf_session_open(pf_session *s, const pf_link_config *config)
{
    pf_link_config own = *config;
    own.nonce = draw_nonce();
    size_t size = pf_link_workspace_size(&own);
    memset(s, 0, sizeof *s);
    if (size == 0)
        return PF_ERR_ARGUMENT;
    s->workspace = aligned_alloc(16, (size + 15) / 16 * 16);
    if (s->workspace == NULL)
        return PF_ERR_SPACE;
    return pf_link_init(&s->link, &own, s->workspace, size);
}

void pf_session_close(pf_session *s)
{
    free(s->workspace);
    s->workspace = NULL;
}

/* Whether the host that came up had the link before another, and has to come up once more. */
static bool must_renew(pf_session *s, pf_link_event *up, uint64_t now)
{
    bool is_back = false;
    up->peer_restarted = up->peer_restarted || s->has_restarted;
    s->has_restarted = false;
    if (s->peers[0] == up->peer_nonce)
        return false;
    for (uint32_t i = 1; i < PF_SESSION_PEERS; i++)
        is_back = is_back || s->peers[i] == up->peer_nonce;
    memmove(s->peers + 1, s->peers, sizeof s->peers - sizeof s->peers[0]);
    s->peers[0] = up->peer_nonce;
    const uint32_t nonce = is_back ? draw_nonce() : 0;
    if (nonce == 0)
        return false;
    memset(s->peers + 1, 0, sizeof s->peers - sizeof s->peers[0]);
    s->has_restarted = up->peer_restarted;
    pf_link_renew(s->link, nonce, now);
    return true;
}

void pf_session_events(pf_session *s, pf_session_take *take, void *context, uint64_t now)
{
    pf_link_event event;
    while (pf_link_next_event(s->link, &event)) {
        if (event.type == PF_LINK_UP && must_renew(s, &event, now))
            (void)pf_link_next_event(s->link, &event); /* its end: nobody has heard of it */
        else
            take(context, s, &event, now);
    }
}

void pf_session_begin(pf_session *s, pf_session_take *take, void *context, uint64_t now)
{
    pf_session_reset(s, take, context, now);
    const uint32_t nonce = draw_nonce();
    if (nonce != 0)
        pf_link_renew(s->link, nonce, now);
    memset(s->peers, 0, sizeof s->peers);
    s->has_restarted = false;
}

void pf_session_reset(pf_session *s, pf_session_take *take, void *context, uint64_t now)
{
    s->has_stream = false;
    s->out_at = s->out_n = 0;
    pf_link_reset(s->link, now);
    pf_session_events(s, take, context, now);
}

bool pf_session_read(pf_session *s, pf_session_take *take, void *context, uint64_t now)
{
    uint8_t bytes[4096];
    size_t total = 0, n = 0;
    const uint64_t frames = pf_link_get_stats(s->link)->frames_in;
    while (s->has_stream && total < READ_MAX) {
        size_t at = 0;
        if (s->transport.ops->read(s->transport.self, bytes, sizeof bytes, &n) != PF_OK)
            return false;
        if (n == 0)
            break;
        while (at < n) {
            at += pf_link_input(s->link, bytes + at, n - at, now);
            pf_session_events(s, take, context, now);
        }
        total += n;
    }
    if (s->transport.ops->heard != NULL && pf_link_get_stats(s->link)->frames_in != frames)
        s->transport.ops->heard(s->transport.self);
    (void)pf_link_input(s->link, NULL, 0, now); /* a full line gets no output, and silence must be noticed */
    pf_session_events(s, take, context, now);
    return true;
}

bool pf_session_write(pf_session *s, uint64_t now, bool *is_full)
{
    pf_transport *t = &s->transport;
    *is_full = false;
    while (s->has_stream) {
        size_t done = 0;
        if (s->out_at == s->out_n) {
            size_t room = t->ops->room(t->self);
            *is_full = room < PF_LINK_FRAME_MAX;
            if (*is_full)
                return true;
            s->out_at = 0;
            s->out_n = pf_link_output(s->link, s->out, room < sizeof s->out ? room : sizeof s->out, now);
            if (s->out_n == 0)
                return true;
        }
        if (t->ops->write(t->self, s->out + s->out_at, s->out_n - s->out_at, &done) != PF_OK)
            return false;
        s->out_at += done;
        *is_full = s->out_at < s->out_n;
        if (*is_full)
            return true;
    }
    return true;
}
