/* Hello, keepalive, round trip and the peer's clock. */
#include "internal.h"

#include <string.h>

enum { HELLO_ANSWER = 1 }; /* bit of a hello: "answer me" */

static void end_all(pf_link *link, bool new_peer)
{
    pf_control_end(link, new_peer);
    pf_latest_end(link, new_peer);
    pf_sender_end(link, new_peer);
    pf_receiver_end(link, new_peer);
}

void pf_session_down(pf_link *link)
{
    pf_session *s = &link->session;
    s->dead_nonce = 0;
    s->hello_due = true;
    if (!s->up)
        return;
    s->up = false;
    end_all(link, false);
    pf_link_push_event(link, PF_LINK_DOWN);
}

void pf_session_forget(pf_link *link)
{
    link->session.candidate = 0;
    end_all(link, true);
}

static void come_up(pf_link *link, const uint8_t *frame)
{
    pf_session *s = &link->session;
    uint32_t nonce = pf_get32(frame + 8), fragment = pf_get16(frame + 24);
    bool new_peer = nonce != s->peer_nonce;
    if (new_peer) {
        s->dead_nonce = s->peer_nonce;
        s->peer_nonce = nonce;
        link->stats.peer_clock_error_ns = UINT64_MAX;
        end_all(link, true);
    }
    s->up = true;
    s->peer_slots = frame[6];
    s->fragment = fragment < link->config.max_fragment ? fragment : link->config.max_fragment;
    s->pong_due = s->ping_open = s->data_sampled = false;
    s->srtt = s->rttvar = 0;
    s->ping_due = link->now;
    link->stats.sessions++;
    pf_link_event *event = pf_link_push_event(link, PF_LINK_UP);
    event->peer_role = frame[4];
    event->peer_version = frame[5];
    event->peer_schema = pf_get32(frame + 32);
    event->peer_nonce = nonce;
    event->peer_boot_id = pf_get64(frame + 16);
    event->peer_restarted =
        s->was_up && new_peer && (event->peer_boot_id == 0 || event->peer_boot_id != s->peer_boot_id);
    s->was_up = true;
    s->peer_boot_id = event->peer_boot_id;
}

bool pf_session_hello(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_session *s = &link->session;
    if (size < PF_SIZE_HELLO || (frame[4] != PF_LINK_DEVICE && frame[4] != PF_LINK_HOST))
        return false;
    uint32_t nonce = pf_get32(frame + 8), echo = pf_get32(frame + 12);
    /* Our own nonce is our own hello: the line echoes. */
    if (nonce == 0 || nonce == link->config.nonce || pf_get16(frame + 24) < PF_LINK_FRAGMENT_MIN)
        return false;
    if (nonce == s->dead_nonce) {
        link->stats.stale++;
        return true;
    }
    bool in_session = s->up && nonce == s->peer_nonce;
    bool asks = (frame[7] & HELLO_ANSWER) != 0;
    if (echo != link->config.nonce) {
        if (!in_session)
            s->candidate = nonce;
        s->hello_due = true;
        return true;
    }
    s->candidate = 0;
    s->heard_at = link->now;
    if (asks) {
        s->hello_due = true;
        if (in_session)
            pf_receiver_peer_reset(link);
    }
    if (!in_session)
        come_up(link, frame);
    return true;
}

/* Only what all versions share is read: type and version, role, and the nonce if it is there. */
void pf_session_incompatible(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_session *s = &link->session;
    if (size < 12) {
        link->stats.malformed++;
        return;
    }
    uint32_t nonce = pf_get32(frame + 8);
    if (s->incompatible_told && s->incompatible_nonce == nonce)
        return;
    s->incompatible_told = true;
    s->incompatible_nonce = nonce;
    pf_link_event *event = pf_link_push_event(link, PF_LINK_INCOMPATIBLE);
    event->peer_role = frame[4];
    event->peer_version = frame[0] >> 4;
    event->peer_nonce = nonce;
}

/* An intact frame of another session: one of us has missed the other's restart, and a hello mends that. */
void pf_session_stale(pf_link *link)
{
    pf_session *s = &link->session;
    link->stats.stale++;
    if (s->up && link->now - s->hello_at >= PF_LINK_HELLO_NS)
        s->hello_due = s->ask = true;
}

void pf_session_tick(pf_link *link)
{
    if (link->session.up && link->now >= link->session.heard_at + 4 * PF_LINK_MS * link->config.keepalive_ms)
        pf_session_down(link);
}

uint64_t pf_session_due(const pf_link *link)
{
    const pf_session *s = &link->session;
    if (s->hello_due || (s->up && s->pong_due))
        return 0;
    uint64_t at = PF_LINK_NEVER;
    if (!s->up || s->candidate != 0)
        at = s->hello_at + PF_LINK_HELLO_NS;
    return s->up ? pf_min64(at, s->ping_due) : at;
}

uint64_t pf_session_deadline(const pf_link *link)
{
    uint64_t at = pf_session_due(link);
    if (link->session.up)
        at = pf_min64(at, link->session.heard_at + 4 * PF_LINK_MS * link->config.keepalive_ms);
    return at;
}

static size_t build_hello(pf_link *link)
{
    pf_session *s = &link->session;
    const pf_link_config *c = &link->config;
    uint8_t *frame = pf_link_frame(link, PF_FRAME_HELLO);
    memset(frame + 1, 0, PF_SIZE_HELLO - 1);
    frame[4] = (uint8_t)c->role;
    frame[5] = PF_LINK_VERSION;
    frame[6] = (uint8_t)c->receive_slots;
    frame[7] = !s->up || s->candidate != 0 || s->ask ? HELLO_ANSWER : 0;
    pf_put32(frame + 8, c->nonce);
    pf_put32(frame + 12, s->candidate != 0 ? s->candidate : s->peer_nonce);
    pf_put64(frame + 16, c->boot_id);
    pf_put16(frame + 24, c->max_fragment);
    pf_put32(frame + 28, c->max_object);
    pf_put32(frame + 32, c->schema);
    s->hello_due = s->ask = false;
    s->hello_at = link->now;
    return PF_SIZE_HELLO;
}

size_t pf_session_build(pf_link *link)
{
    pf_session *s = &link->session;
    if (s->hello_due || !s->up || (s->candidate != 0 && link->now >= s->hello_at + PF_LINK_HELLO_NS))
        return build_hello(link);
    if (s->pong_due) {
        uint8_t *frame = pf_link_frame(link, PF_FRAME_PONG);
        pf_put32(frame + 4, s->pong_id);
        pf_put64(frame + 8, s->pong_echo);
        pf_put64(frame + 16, link->now);
        s->pong_due = false;
        return PF_SIZE_PONG;
    }
    uint8_t *frame = pf_link_frame(link, PF_FRAME_PING);
    s->ping_open = true;
    s->ping_at = link->now;
    s->ping_due = link->now + PF_LINK_MS * link->config.keepalive_ms;
    pf_put32(frame + 4, ++s->ping_id);
    pf_put64(frame + 8, s->ping_at);
    return PF_SIZE_PING;
}

bool pf_session_ping(pf_link *link, const uint8_t *frame, size_t size)
{
    if (size != PF_SIZE_PING)
        return false;
    link->session.pong_due = true;
    link->session.pong_id = pf_get32(frame + 4);
    link->session.pong_echo = pf_get64(frame + 8);
    return true;
}

bool pf_session_pong(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_session *s = &link->session;
    pf_link_stats *stats = &link->stats;
    if (size != PF_SIZE_PONG)
        return false;
    if (!s->ping_open || pf_get32(frame + 4) != s->ping_id || pf_get64(frame + 8) != s->ping_at)
        return true; /* of an earlier ping */
    s->ping_open = false;
    uint64_t rtt = link->now - s->ping_at;
    pf_session_round_trip(link, rtt);
    /* The best sample grows worse with age, for crystals drift: 50 ppm. */
    if (stats->peer_clock_error_ns == UINT64_MAX ||
        rtt / 2 <= stats->peer_clock_error_ns + (link->now - s->clock_at) / 20000) {
        stats->peer_clock_error_ns = rtt / 2;
        stats->peer_clock_offset_ns = (int64_t)(pf_get64(frame + 16) - (s->ping_at + rtt / 2));
        s->clock_at = link->now;
    }
    return true;
}

/* Jacobson's estimator as in RFC 6298. */
void pf_session_round_trip(pf_link *link, uint64_t rtt)
{
    pf_session *s = &link->session;
    if (s->srtt == 0) {
        s->srtt = rtt;
        s->rttvar = rtt / 2;
    } else {
        uint64_t error = rtt > s->srtt ? rtt - s->srtt : s->srtt - rtt;
        s->rttvar = (3 * s->rttvar + error) / 4;
        s->srtt = (7 * s->srtt + rtt) / 8;
    }
    s->srtt = pf_max64(s->srtt, 1);
    link->stats.rtt_us = (uint32_t)pf_min64(pf_max64(s->srtt / 1000, 1), UINT32_MAX);
}

uint64_t pf_session_rto(const pf_link *link)
{
    const pf_session *s = &link->session;
    if (s->srtt == 0)
        return PF_LINK_RTO_FIRST_NS;
    return pf_max64(s->srtt + 4 * s->rttvar + PF_LINK_ACK_DELAY_NS, PF_LINK_MS * link->config.rto_min_ms);
}
