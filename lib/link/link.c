/* Workspace, bytes in and out, priorities and the deadline. */
#include "internal.h"

#include <string.h>

static bool in_range(uint32_t value, uint32_t least, uint32_t most)
{
    return value >= least && value <= most;
}

static void use_default(uint32_t *field, uint32_t value)
{
    if (*field == 0)
        *field = value;
}

/* Fills in the defaults; false if a value is out of range. */
static bool complete_config(pf_link_config *c)
{
    if (c->max_object > 0)
        use_default(&c->receive_slots, 4);
    use_default(&c->max_fragment, PF_LINK_FRAGMENT_MAX);
    use_default(&c->send_slots, 4);
    use_default(&c->max_latest, 16384);
    use_default(&c->max_control, 512);
    use_default(&c->control_queue, 8);
    use_default(&c->window, 65536);
    use_default(&c->keepalive_ms, 1000);
    use_default(&c->rto_min_ms, 50);
    return (c->role == PF_LINK_DEVICE || c->role == PF_LINK_HOST) && c->nonce != 0 &&
           in_range(c->max_fragment, PF_LINK_FRAGMENT_MIN, PF_LINK_FRAGMENT_MAX) &&
           in_range(c->send_slots, 1, PF_LINK_SLOTS_MAX) && c->receive_slots <= PF_LINK_SLOTS_MAX &&
           (c->receive_slots == 0) == (c->max_object == 0) &&
           c->max_object <= (uint32_t)PF_LINK_COUNT_MAX * PF_LINK_FRAGMENT_MAX && c->max_latest <= 1u << 20 &&
           in_range(c->max_control, 16, 1000) && in_range(c->control_queue, 1, 64) &&
           in_range(c->window, PF_LINK_FRAGMENT_MAX, 1u << 24) && in_range(c->keepalive_ms, 10, 60000) &&
           in_range(c->rto_min_ms, 1, 10000);
}

/* Takes n bytes, 16-byte aligned, of the workspace; with base NULL only counts. */
static void *take(uint8_t *base, uint64_t *used, uint64_t n)
{
    void *p = base == NULL ? NULL : base + *used;
    *used += (n + 15) / 16 * 16;
    return p;
}

/* Fragments that can be under way; a power of two, so that the ring goes round where tx does. */
static uint32_t ring_size(const pf_link_config *c)
{
    uint32_t n = 1;
    while (n < c->window / PF_LINK_FRAGMENT_MIN)
        n *= 2;
    return n;
}

static uint64_t object_bitmap_size(const pf_link_config *c)
{
    return pf_min64(c->max_object / PF_LINK_FRAGMENT_MIN, PF_LINK_COUNT_MAX) / 8 + 1;
}

/* Lays out the workspace; with link NULL only its size. */
static uint64_t lay_out(const pf_link_config *c, pf_link *link)
{
    pf_link nowhere; /* takes the pointers when nothing is laid out */
    pf_link *l = link == NULL ? &nowhere : link;
    uint8_t *base = (uint8_t *)link;
    uint64_t used = 0;
    take(base, &used, sizeof(pf_link));
    l->control.queue = take(base, &used, (uint64_t)c->control_queue * (2 + c->max_control));
    for (uint32_t i = 0; i < PF_LINK_TOPICS; i++)
        l->latest.topics[i].bytes = take(base, &used, c->max_latest);
    l->latest.sending.bytes = take(base, &used, c->max_latest);
    l->latest.partial.bytes = take(base, &used, c->max_latest);
    l->latest.partial_bitmap = take(base, &used, c->max_latest / PF_LINK_FRAGMENT_MIN / 8 + 1);
    l->sender.ring = take(base, &used, (uint64_t)ring_size(c) * sizeof(pf_flight));
    for (uint32_t i = 0; i < c->receive_slots; i++) {
        l->receiver.slots[i].bytes = take(base, &used, c->max_object);
        l->receiver.slots[i].bitmap = take(base, &used, object_bitmap_size(c));
    }
    return used;
}

size_t pf_link_workspace_size(const pf_link_config *config)
{
    if (config == NULL)
        return 0;
    pf_link_config c = *config;
    if (!complete_config(&c))
        return 0;
    uint64_t size = lay_out(&c, NULL);
    return size <= SIZE_MAX ? (size_t)size : 0;
}

pf_status pf_link_init(pf_link **link, const pf_link_config *config, void *workspace, size_t size)
{
    size_t needed = pf_link_workspace_size(config);
    if (link == NULL || workspace == NULL || needed == 0 || (uintptr_t)workspace % 16 != 0)
        return PF_ERR_ARGUMENT;
    if (size < needed)
        return PF_ERR_SPACE;
    pf_link *l = workspace;
    memset(l, 0, sizeof *l);
    l->config = *config;
    complete_config(&l->config);
    lay_out(&l->config, l);
    l->sender.ring_size = ring_size(&l->config);
    l->sender.tx_next = l->sender.tx_tail = 1;
    l->stats.peer_clock_error_ns = UINT64_MAX;
    l->session.hello_due = true;
    l->delimiter_due = true;
    *link = l;
    return PF_OK;
}

/* A clock that steps back would make timers hang; the link stands still instead. */
static void set_now(pf_link *link, uint64_t now_ns)
{
    link->now = pf_max64(link->now, now_ns);
}

void pf_link_reset(pf_link *link, uint64_t now_ns)
{
    set_now(link, now_ns);
    link->in_size = 0;
    link->delimiter_due = true;
    pf_session_down(link);
}

void pf_link_renew(pf_link *link, uint32_t nonce, uint64_t now_ns)
{
    pf_link_reset(link, now_ns);
    link->config.nonce = nonce;
    pf_session_forget(link);
}

pf_link_event *pf_link_push_event(pf_link *link, pf_link_event_type type)
{
    const uint32_t room = sizeof link->events / sizeof link->events[0];
    pf_link_event *event = &link->events[(link->event_head + link->event_count++) % room];
    memset(event, 0, sizeof *event);
    event->type = type;
    return event;
}

bool pf_link_next_event(pf_link *link, pf_link_event *event)
{
    if (link->event_count == 0)
        return false;
    *event = link->events[link->event_head];
    link->event_head = (link->event_head + 1) % (sizeof link->events / sizeof link->events[0]);
    link->event_count--;
    return true;
}

/* Tells the session: half of each nonce, so that a frame meant for an earlier start of either end is recognised. */
static uint32_t tag(uint32_t from, uint32_t to)
{
    return (from ^ to >> 16) & 0xFFFFu;
}

uint8_t *pf_link_frame(pf_link *link, pf_frame_type type)
{
    link->raw[0] = (uint8_t)(PF_LINK_VERSION << 4 | type);
    link->raw[1] = 0;
    pf_put16(link->raw + 2, tag(link->config.nonce, link->session.peer_nonce));
    return link->raw;
}

static bool dispatch(pf_link *link, const uint8_t *frame, size_t size)
{
    link->session.heard_at = link->now;
    switch (frame[0] & 15u) {
    case PF_FRAME_CONTROL:
        return pf_control_receive(link, frame, size);
    case PF_FRAME_CONTROL_ACK:
        return pf_control_receive_ack(link, frame, size);
    case PF_FRAME_LATEST:
        return pf_latest_receive(link, frame, size);
    case PF_FRAME_OFFER:
        return pf_receiver_offer(link, frame, size);
    case PF_FRAME_DATA:
        return pf_receiver_data(link, frame, size);
    case PF_FRAME_ACK:
        return pf_sender_receive_ack(link, frame, size);
    case PF_FRAME_PING:
        return pf_session_ping(link, frame, size);
    case PF_FRAME_PONG:
        return pf_session_pong(link, frame, size);
    case PF_FRAME_CANCEL:
        return pf_receiver_cancel(link, frame, size);
    default:
        return false;
    }
}

static void receive_frame(pf_link *link)
{
    uint8_t *frame = link->in;
    size_t size = link->in_size;
    link->in_size = 0;
    if (size == 0)
        return;
    if (size == sizeof link->in || pf_cobs_decode(frame, size, frame, &size) != PF_OK ||
        size < PF_LINK_HEADER + PF_LINK_CRC ||
        pf_crc32c(0, frame, size - PF_LINK_CRC) != pf_get32(frame + size - PF_LINK_CRC)) {
        link->stats.crc_errors++;
        return;
    }
    size -= PF_LINK_CRC;
    link->stats.frames_in++;
    bool hello = (frame[0] & 15u) == PF_FRAME_HELLO;
    if (frame[0] >> 4 != PF_LINK_VERSION) {
        if (hello)
            pf_session_incompatible(link, frame, size);
        else
            link->stats.malformed++;
    } else if (hello) {
        link->stats.malformed += !pf_session_hello(link, frame, size);
    } else if (!link->session.up || pf_get16(frame + 2) != tag(link->session.peer_nonce, link->config.nonce)) {
        pf_session_stale(link);
    } else {
        link->stats.malformed += !dispatch(link, frame, size);
    }
}

size_t pf_link_input(pf_link *link, const uint8_t *bytes, size_t n, uint64_t now_ns)
{
    size_t i = 0;
    set_now(link, now_ns);
    while (i < n && link->event_count == 0) {
        uint8_t byte = bytes[i++];
        if (byte == 0)
            receive_frame(link);
        else if (link->in_size < sizeof link->in)
            link->in[link->in_size++] = byte;
    }
    /* Here too, for a line that takes nothing is given no output; after the bytes, for they may be a sign of life. */
    if (i == n && link->event_count == 0)
        pf_session_tick(link);
    link->stats.bytes_in += i;
    return i;
}

/* Bytes on the wire of a frame of n bytes at most, with checksum, COBS and delimiter. */
static size_t wire_size(size_t n)
{
    return n + PF_LINK_CRC + (n + PF_LINK_CRC) / 254 + 2;
}

/* Builds the most urgent frame if it fits into `room`; 0 = none now. */
static size_t build_next(pf_link *link, size_t room)
{
    uint64_t now = link->now;
    if (pf_session_due(link) <= now)
        return room < wire_size(PF_SIZE_HELLO) ? 0 : pf_session_build(link);
    if (!link->session.up)
        return 0;
    if (pf_control_due(link) <= now)
        return room < wire_size(PF_SIZE_CONTROL + link->config.max_control) ? 0 : pf_control_build(link);
    if (pf_receiver_due(link) <= now)
        return room < wire_size(PF_SIZE_ACK + PF_LINK_BITMAP) ? 0 : pf_receiver_build(link);
    if (pf_sender_due(link) <= now)
        return room < wire_size(PF_SIZE_OFFER) ? 0 : pf_sender_build(link);
    bool latest = pf_latest_ready(link), bulk = pf_sender_ready(link);
    if ((!latest && !bulk) || room < wire_size(PF_SIZE_LATEST + link->session.fragment))
        return 0;
    if (!bulk)
        return pf_latest_build(link);
    if (!latest)
        return pf_sender_build_data(link);
    /* Half of the line each, in bytes; at most one frame is owed, for the past does not count. */
    bool latest_turn = link->credit >= 0;
    size_t n = latest_turn ? pf_latest_build(link) : pf_sender_build_data(link);
    link->credit += latest_turn ? -(int32_t)n : (int32_t)n;
    if (link->credit > PF_LINK_RAW_MAX)
        link->credit = PF_LINK_RAW_MAX;
    return n;
}

size_t pf_link_output(pf_link *link, uint8_t *out, size_t capacity, uint64_t now_ns)
{
    set_now(link, now_ns);
    pf_session_tick(link);
    pf_sender_tick(link);
    size_t used = 0;
    for (;;) {
        size_t lead = link->delimiter_due ? 1 : 0;
        size_t n = capacity - used <= lead ? 0 : build_next(link, capacity - used - lead);
        if (n == 0)
            break;
        pf_put32(link->raw + n, pf_crc32c(0, link->raw, n));
        if (lead != 0)
            out[used++] = 0;
        link->delimiter_due = false;
        used += pf_cobs_encode(link->raw, n + PF_LINK_CRC, out + used);
        out[used++] = 0;
        link->stats.frames_out++;
    }
    link->stats.bytes_out += used;
    return used;
}

uint64_t pf_link_deadline(const pf_link *link, uint64_t now_ns)
{
    uint64_t at = pf_session_deadline(link);
    if (link->event_count > 0)
        return now_ns;
    if (link->session.up) {
        if (pf_latest_ready(link) || pf_sender_ready(link))
            return now_ns;
        at = pf_min64(at, pf_control_due(link));
        at = pf_min64(at, pf_receiver_due(link));
        at = pf_min64(at, pf_sender_due(link));
        at = pf_min64(at, pf_sender_timeout(link));
    }
    return pf_max64(at, now_ns);
}

const pf_link_stats *pf_link_get_stats(const pf_link *link)
{
    return &link->stats;
}
bool pf_link_is_up(const pf_link *link)
{
    return link->session.up;
}
