/* Control messages: stop and wait. The sender has one message under way; the receiver takes any that is not older than
 * the one it expects, so that a message the sender has given up (its session ended) leaves no hole. */
#include "internal.h"

#include <string.h>

static uint8_t *entry(const pf_link *link, uint32_t i)
{
    uint32_t at = (link->control.head + i) % link->config.control_queue;
    return link->control.queue + (size_t)at * (2 + link->config.max_control);
}

pf_status pf_link_send_control(pf_link *link, const void *bytes, size_t n)
{
    pf_control *c = &link->control;
    if ((bytes == NULL && n > 0) || n > link->config.max_control)
        return PF_ERR_ARGUMENT;
    if (!link->session.up)
        return PF_ERR_CLOSED;
    if (c->count == link->config.control_queue)
        return PF_ERR_SPACE;
    uint8_t *e = entry(link, c->count++);
    pf_put16(e, (uint32_t)n);
    if (n > 0)
        memcpy(e + 2, bytes, n);
    return PF_OK;
}

static void drop_head(pf_link *link)
{
    pf_control *c = &link->control;
    c->head = (c->head + 1) % link->config.control_queue;
    c->count--;
    c->sequence++;
    c->sent = false;
}

void pf_control_end(pf_link *link, bool new_peer)
{
    pf_control *c = &link->control;
    if (c->sent)
        drop_head(link); /* it may have arrived: its number is used up */
    c->count = 0;
    if (new_peer) {
        c->sequence = c->expected = 0;
        c->ack_due = false;
    }
}

bool pf_control_receive(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_control *c = &link->control;
    if (size < PF_SIZE_CONTROL)
        return false;
    uint32_t sequence = pf_get32(frame + 4);
    c->ack_due = true;
    if (sequence != c->expected && !pf_later(sequence, c->expected))
        return true;
    c->expected = sequence + 1;
    link->stats.control_received++;
    pf_link_event *event = pf_link_push_event(link, PF_LINK_CONTROL);
    event->data = frame + PF_SIZE_CONTROL;
    event->size = (uint32_t)(size - PF_SIZE_CONTROL);
    return true;
}

bool pf_control_receive_ack(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_control *c = &link->control;
    if (size != PF_SIZE_CONTROL_ACK)
        return false;
    uint32_t next = pf_get32(frame + 4);
    if (pf_later(next, c->sequence + (c->sent ? 1 : 0)))
        return false; /* of a message that was never sent */
    if (c->sent && next == c->sequence + 1)
        drop_head(link);
    return true;
}

uint64_t pf_control_due(const pf_link *link)
{
    const pf_control *c = &link->control;
    if (c->ack_due || (c->count > 0 && !c->sent))
        return 0;
    return c->count > 0 ? c->repeat_at : PF_LINK_NEVER;
}

size_t pf_control_build(pf_link *link)
{
    pf_control *c = &link->control;
    if (c->ack_due) {
        uint8_t *frame = pf_link_frame(link, PF_FRAME_CONTROL_ACK);
        pf_put32(frame + 4, c->expected);
        c->ack_due = false;
        return PF_SIZE_CONTROL_ACK;
    }
    uint8_t *frame = pf_link_frame(link, PF_FRAME_CONTROL);
    const uint8_t *e = entry(link, 0);
    size_t n = pf_get16(e);
    pf_put32(frame + 4, c->sequence);
    memcpy(frame + PF_SIZE_CONTROL, e + 2, n);
    if (c->sent) {
        link->stats.control_resent++;
        c->interval = pf_min64(2 * c->interval, PF_LINK_POLL_MAX_NS);
    } else {
        link->stats.control_sent++;
        c->interval = pf_session_rto(link);
    }
    c->sent = true;
    c->repeat_at = link->now + c->interval;
    return PF_SIZE_CONTROL + n;
}
