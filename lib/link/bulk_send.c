/* The sending half of bulk: offers, fragments, loss detection.
 *
 * Loss is found as QUIC does (RFC 9002): each transmission has a number of its own, tx, and a fragment is lost when one
 * sent three later, or one sent later and more than 9/8 of the round trip after it, has arrived. The timeout starts
 * anew with each progress, so a deep queue in the operating system that drains slowly does not fire it; it repeats one
 * fragment, whose acknowledgement tells the fate of all the others. */
#include "internal.h"

#include <string.h>

static pf_flight *flight(const pf_sender *s, uint32_t tx)
{
    return &s->ring[tx % s->ring_size];
}

static pf_send_slot *find_name(pf_link *link, const uint8_t *name)
{
    for (uint32_t i = 0; i < link->config.send_slots; i++) {
        pf_send_slot *slot = &link->sender.slots[i];
        if (slot->state != PF_SEND_FREE && slot->state != PF_SEND_CANCELLING &&
            memcmp(slot->name, name, PF_LINK_NAME_SIZE) == 0)
            return slot;
    }
    return NULL;
}

static pf_send_slot *find_handle(pf_link *link, uint32_t handle)
{
    for (uint32_t i = 0; i < link->config.send_slots; i++)
        if (link->sender.slots[i].state > PF_SEND_NEW && link->sender.slots[i].handle == handle)
            return &link->sender.slots[i];
    return NULL;
}

pf_status pf_link_send_object(pf_link *link, const uint8_t name[PF_LINK_NAME_SIZE], uint32_t kind, const void *bytes,
                              size_t n)
{
    if (name == NULL || bytes == NULL || n == 0 || n > UINT32_MAX || kind > 255 || find_name(link, name) != NULL)
        return PF_ERR_ARGUMENT;
    for (uint32_t i = 0; i < link->config.send_slots; i++) {
        pf_send_slot *slot = &link->sender.slots[i];
        if (slot->state != PF_SEND_FREE)
            continue;
        memset(slot, 0, sizeof *slot);
        slot->state = PF_SEND_NEW;
        slot->kind = (uint8_t)kind;
        slot->order = ++link->sender.order;
        slot->size = (uint32_t)n;
        slot->bytes = bytes;
        memcpy(slot->name, name, PF_LINK_NAME_SIZE);
        return PF_OK;
    }
    return PF_ERR_SPACE;
}

uint32_t pf_link_free_send_slots(const pf_link *link)
{
    uint32_t n = 0;
    for (uint32_t i = 0; i < link->config.send_slots; i++)
        n += link->sender.slots[i].state == PF_SEND_FREE;
    return n;
}

static void pop_closed(pf_sender *s)
{
    while (s->tx_tail != s->tx_next && !flight(s, s->tx_tail)->open)
        s->tx_tail++;
}

static void close_flight(pf_sender *s, pf_flight *f)
{
    f->open = false;
    s->flying -= f->size;
}

/* Forgets what is under way of a slot that is done or starts anew. */
static void close_slot(pf_link *link, pf_send_slot *slot, pf_send_state state)
{
    pf_sender *s = &link->sender;
    for (uint32_t tx = s->tx_tail; tx != s->tx_next; tx++)
        if (flight(s, tx)->open && flight(s, tx)->slot == slot - s->slots)
            close_flight(s, flight(s, tx));
    pop_closed(s);
    slot->state = (uint8_t)state;
}

pf_status pf_link_cancel_object(pf_link *link, const uint8_t name[PF_LINK_NAME_SIZE])
{
    pf_send_slot *slot = name == NULL ? NULL : find_name(link, name);
    if (slot == NULL)
        return PF_ERR_ARGUMENT;
    bool known = slot->state > PF_SEND_NEW; /* never without a peer */
    close_slot(link, slot, known ? PF_SEND_CANCELLING : PF_SEND_FREE);
    slot->bytes = NULL;
    slot->poll_at = 0;
    slot->interval = pf_session_rto(link);
    return PF_OK;
}

void pf_sender_end(pf_link *link, bool new_peer)
{
    pf_sender *s = &link->sender;
    for (uint32_t i = 0; i < link->config.send_slots; i++)
        if (s->slots[i].state != PF_SEND_FREE)
            s->slots[i].state = s->slots[i].state == PF_SEND_CANCELLING ? PF_SEND_FREE : PF_SEND_NEW;
    if (new_peer) {
        s->tx_next = 1;
        s->tx_seen = 0;
    }
    s->tx_tail = s->tx_next;
    s->flying = 0;
    s->backoff = 0;
}

/* ---- offers, polls and cancels ---- */

/* The slot whose offer, poll or cancel is due first; *at says when. */
static pf_send_slot *next_signal(const pf_link *link, uint64_t *at)
{
    const pf_send_slot *best = NULL, *oldest_new = NULL;
    uint32_t known = 0;
    *at = PF_LINK_NEVER;
    for (uint32_t i = 0; i < link->config.send_slots; i++) {
        const pf_send_slot *slot = &link->sender.slots[i];
        known += slot->state > PF_SEND_NEW;
        if (slot->state == PF_SEND_NEW && (oldest_new == NULL || pf_later(oldest_new->order, slot->order)))
            oldest_new = slot;
        bool polls =
            slot->state == PF_SEND_OFFERED || slot->state == PF_SEND_STORING || slot->state == PF_SEND_CANCELLING;
        if (polls && slot->poll_at < *at) {
            best = slot;
            *at = slot->poll_at;
        }
    }
    /* No more than the peer has room for; a peer without slots only talks, and the objects wait for another. */
    if (oldest_new != NULL && known < link->session.peer_slots) {
        best = oldest_new;
        *at = 0;
    }
    return (pf_send_slot *)best;
}

uint64_t pf_sender_due(const pf_link *link)
{
    uint64_t at;
    next_signal(link, &at);
    return at;
}

static void poll_after(pf_link *link, pf_send_slot *slot, uint64_t interval)
{
    slot->interval = pf_min64(interval, PF_LINK_POLL_MAX_NS);
    slot->poll_at = link->now + slot->interval;
}

size_t pf_sender_build(pf_link *link)
{
    uint64_t at;
    pf_send_slot *slot = next_signal(link, &at);
    if (slot->state == PF_SEND_NEW) {
        do
            link->sender.handle++;
        while (link->sender.handle == 0 || find_handle(link, link->sender.handle) != NULL);
        slot->handle = link->sender.handle;
        slot->state = PF_SEND_OFFERED;
        slot->fragment = link->session.fragment;
        slot->count = pf_fragments(slot->size, slot->fragment);
        poll_after(link, slot, pf_session_rto(link));
    } else {
        poll_after(link, slot, 2 * slot->interval);
    }
    if (slot->state == PF_SEND_CANCELLING) {
        uint8_t *frame = pf_link_frame(link, PF_FRAME_CANCEL);
        pf_put16(frame + 4, slot->handle);
        return PF_SIZE_CANCEL;
    }
    uint8_t *frame = pf_link_frame(link, PF_FRAME_OFFER);
    pf_put16(frame + 4, slot->handle);
    frame[6] = slot->kind;
    frame[7] = 0;
    pf_put32(frame + 8, slot->size);
    pf_put16(frame + 12, slot->fragment);
    pf_put16(frame + 14, 0);
    memcpy(frame + 16, slot->name, PF_LINK_NAME_SIZE);
    return PF_SIZE_OFFER;
}

/* ---- fragments ---- */

/* First fragment never sent and not known to have arrived, or count or the end of the reach. */
static uint32_t next_fresh(const pf_send_slot *slot)
{
    uint32_t i = slot->next;
    while (i < slot->count && i - slot->base < PF_LINK_REACH && pf_bit(slot->acked, i % PF_LINK_REACH))
        i++;
    return i;
}

/* The window holds back fresh fragments only: a lost one was inside it before. */
static bool has_data(const pf_send_slot *slot, bool window_open)
{
    if (slot->state != PF_SEND_SENDING)
        return false;
    uint32_t fresh = next_fresh(slot);
    return slot->lost_count > 0 || (window_open && fresh < slot->count && fresh - slot->base < PF_LINK_REACH);
}

/* The oldest object with something to send, so that objects finish one after the other. */
static pf_send_slot *next_slot(const pf_link *link)
{
    const pf_send_slot *best = NULL;
    const pf_sender *s = &link->sender;
    bool window_open = s->flying + link->session.fragment <= link->config.window;
    if (s->tx_next - s->tx_tail >= s->ring_size)
        return NULL;
    for (uint32_t i = 0; i < link->config.send_slots; i++)
        if (has_data(&s->slots[i], window_open) && (best == NULL || pf_later(best->order, s->slots[i].order)))
            best = &s->slots[i];
    return (pf_send_slot *)best;
}

bool pf_sender_ready(const pf_link *link)
{
    return next_slot(link) != NULL;
}

size_t pf_sender_build_data(pf_link *link)
{
    pf_sender *s = &link->sender;
    pf_send_slot *slot = next_slot(link);
    uint32_t index;
    if (slot->lost_count > 0) {
        for (index = slot->base; !pf_bit(slot->lost, index % PF_LINK_REACH);)
            index++;
        pf_bit_clear(slot->lost, index % PF_LINK_REACH);
        slot->lost_count--;
        link->stats.fragments_resent++;
    } else {
        index = next_fresh(slot);
        slot->next = index + 1;
    }
    uint32_t n = pf_fragment_size(slot->size, slot->fragment, index), tx = s->tx_next++;
    uint8_t *frame = pf_link_frame(link, PF_FRAME_DATA);
    pf_put16(frame + 4, slot->handle);
    pf_put16(frame + 6, index);
    pf_put32(frame + 8, tx);
    memcpy(frame + PF_SIZE_DATA, slot->bytes + (size_t)index * slot->fragment, n);
    if (s->flying == 0)
        s->progress_at = link->now;
    *flight(s, tx) = (pf_flight){.at = link->now,
                                 .index = (uint16_t)index,
                                 .size = (uint16_t)n,
                                 .slot = (uint8_t)(slot - s->slots),
                                 .open = true};
    s->flying += n;
    link->stats.fragments_sent++;
    return PF_SIZE_DATA + n;
}

static void lose(pf_sender *s, pf_flight *f)
{
    pf_send_slot *slot = &s->slots[f->slot];
    close_flight(s, f);
    pf_bit_set(slot->lost, f->index % PF_LINK_REACH);
    slot->lost_count++;
}

/* ---- acknowledgements ---- */

/* Round trip and progress from the newest transmission that the peer has seen. */
static void note_seen(pf_link *link, uint32_t tx)
{
    pf_sender *s = &link->sender;
    if (!pf_later(tx, s->tx_seen))
        return;
    s->tx_seen = tx;
    s->progress_at = link->now;
    s->backoff = 0;
    if (tx - s->tx_tail < s->tx_next - s->tx_tail) {
        pf_session_round_trip(link, link->now - flight(s, tx)->at);
        link->session.data_sampled = true;
    }
}

static void arrived(pf_send_slot *slot, uint32_t index)
{
    uint32_t bit = index % PF_LINK_REACH;
    pf_bit_set(slot->acked, bit);
    if (pf_bit(slot->lost, bit)) {
        pf_bit_clear(slot->lost, bit);
        slot->lost_count--;
    }
}

/* Takes over what the peer has. An old acknowledgement (base behind ours) still tells the truth about its fragments. */
static void apply(pf_send_slot *slot, uint32_t base, const uint8_t *bitmap, size_t bytes)
{
    if (base > slot->base) {
        for (uint32_t i = slot->base; i < base && i - slot->base < PF_LINK_REACH; i++) {
            arrived(slot, i);
            pf_bit_clear(slot->acked, i % PF_LINK_REACH);
        }
        slot->base = base;
        slot->next = slot->next < base ? base : slot->next;
        if (base < slot->count)
            pf_bit_clear(slot->acked, base % PF_LINK_REACH);
    }
    for (uint32_t i = 0; i < bytes * 8; i++) {
        uint32_t index = base + 1 + i;
        if (pf_bit(bitmap, i) && index > slot->base && index - slot->base < PF_LINK_REACH)
            arrived(slot, index);
    }
}

/* Closes the flights of a slot that have arrived, and those that must be lost since `seen` has. */
static void settle(pf_link *link, pf_send_slot *slot, uint32_t seen)
{
    pf_sender *s = &link->sender;
    uint64_t old = link->session.srtt + link->session.srtt / 8;
    for (uint32_t tx = s->tx_tail; tx != s->tx_next; tx++) {
        pf_flight *f = flight(s, tx);
        if (!f->open || f->slot != slot - s->slots)
            continue;
        if (f->index < slot->base || pf_bit(slot->acked, f->index % PF_LINK_REACH))
            close_flight(s, f);
        else if (pf_later(seen, tx) && (seen - tx >= PF_LINK_REORDER || link->now - f->at > old))
            lose(s, f);
    }
    pop_closed(s);
}

static void finish(pf_link *link, pf_send_slot *slot, pf_link_event_type type)
{
    close_slot(link, slot, PF_SEND_FREE);
    pf_link_event *event = pf_link_push_event(link, type);
    event->kind = slot->kind;
    event->size = slot->size;
    memcpy(event->name, slot->name, PF_LINK_NAME_SIZE);
    if (type == PF_LINK_SENT) {
        link->stats.objects_sent++;
        link->stats.object_bytes_sent += slot->size;
    }
}

/* The peer takes it: from the start, or from where it was interrupted. */
static void accepted(pf_send_slot *slot)
{
    slot->state = PF_SEND_SENDING;
    slot->base = slot->next = slot->lost_count = 0;
    memset(slot->acked, 0, sizeof slot->acked);
    memset(slot->lost, 0, sizeof slot->lost);
}

static bool bitmap_fits(const pf_send_slot *slot, uint32_t base, const uint8_t *bitmap, size_t bytes)
{
    for (uint32_t i = 0; i < bytes * 8; i++)
        if (pf_bit(bitmap, i) && base + 1 + i >= slot->count)
            return false;
    return true;
}

bool pf_sender_receive_ack(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_sender *s = &link->sender;
    if (size < PF_SIZE_ACK || size > PF_SIZE_ACK + PF_LINK_BITMAP || frame[6] > PF_ACK_UNKNOWN)
        return false;
    uint32_t state = frame[6], seen = pf_get32(frame + 8), base = pf_get16(frame + 12);
    pf_send_slot *slot = find_handle(link, pf_get16(frame + 4));
    if (pf_later(seen, s->tx_next - 1))
        return false;
    note_seen(link, seen);
    if (slot == NULL)
        return true; /* of an object that is done */
    if (slot->state == PF_SEND_CANCELLING) {
        if (state == PF_ACK_UNKNOWN)
            slot->state = PF_SEND_FREE;
        return true;
    }
    if (state == PF_ACK_REFUSED) {
        finish(link, slot, PF_LINK_REFUSED);
        return true;
    }
    if (base > slot->count || !bitmap_fits(slot, base, frame + PF_SIZE_ACK, size - PF_SIZE_ACK))
        return false;
    switch (state) {
    case PF_ACK_BUSY:
        if (slot->state == PF_SEND_OFFERED)
            poll_after(link, slot, pf_max64(slot->interval, 100 * PF_LINK_MS));
        break;
    case PF_ACK_RECEIVING:
        if (slot->state == PF_SEND_OFFERED && slot->count <= PF_LINK_COUNT_MAX)
            accepted(slot);
        if (slot->state == PF_SEND_SENDING) {
            apply(slot, base, frame + PF_SIZE_ACK, size - PF_SIZE_ACK);
            settle(link, slot, seen);
        }
        break;
    case PF_ACK_COMPLETE:
        if (slot->state == PF_SEND_STORING)
            break;
        close_slot(link, slot, PF_SEND_STORING);
        poll_after(link, slot, pf_max64(4 * pf_session_rto(link), 200 * PF_LINK_MS));
        break;
    case PF_ACK_STORED:
        finish(link, slot, PF_LINK_SENT);
        break;
    case PF_ACK_AGAIN:
    case PF_ACK_UNKNOWN:
        if (slot->state != PF_SEND_OFFERED)
            close_slot(link, slot, PF_SEND_NEW);
        break;
    default: /* waiting: ask again later */
        break;
    }
    return true;
}

/* ---- timeout ---- */

/* The oldest flight, once a later one has arrived, needs no waiting for progress: its own acknowledgement is overdue.
 */
static bool overtaken(const pf_sender *s)
{
    return pf_later(s->tx_seen, s->tx_tail) && s->tx_seen - s->tx_tail >= PF_LINK_REORDER;
}

uint64_t pf_sender_timeout(const pf_link *link)
{
    const pf_sender *s = &link->sender;
    if (s->tx_tail == s->tx_next)
        return PF_LINK_NEVER;
    uint64_t rto = pf_session_rto(link), at = flight(s, s->tx_tail)->at;
    if (overtaken(s))
        return at + rto;
    if (!link->session.data_sampled)
        rto = pf_max64(rto, PF_LINK_DATA_FIRST_NS);
    return pf_max64(at, s->progress_at) + pf_min64(rto << s->backoff, pf_max64(rto, PF_LINK_RTO_MAX_NS));
}

void pf_sender_tick(pf_link *link)
{
    pf_sender *s = &link->sender;
    while (link->now >= pf_sender_timeout(link)) {
        if (!overtaken(s)) {
            s->progress_at = link->now;
            s->backoff = s->backoff < 6 ? s->backoff + 1 : 6;
        }
        lose(s, flight(s, s->tx_tail));
        pop_closed(s);
    }
}
