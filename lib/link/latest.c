/* Newest wins. A message of one fragment goes out at any time; of those with several, one is under way at a time (it is
 * finished even if a newer one waits, or a fast producer would let none through), so that one buffer is enough at each
 * end. */
#include "internal.h"

#include <string.h>

pf_status pf_link_send_latest(pf_link *link, uint32_t topic, const void *bytes, size_t n)
{
    if (topic >= PF_LINK_TOPICS || (bytes == NULL && n > 0) || n > link->config.max_latest)
        return PF_ERR_ARGUMENT;
    if (!link->session.up)
        return PF_ERR_CLOSED;
    pf_latest_message *m = &link->latest.topics[topic];
    if (m->waiting)
        link->stats.latest_replaced++;
    if (n > 0)
        memcpy(m->bytes, bytes, n);
    m->size = (uint32_t)n;
    m->number++;
    m->waiting = true;
    return PF_OK;
}

void pf_latest_end(pf_link *link, bool new_peer)
{
    pf_latest *l = &link->latest;
    for (uint32_t i = 0; i < PF_LINK_TOPICS; i++)
        l->topics[i].waiting = false;
    l->sending.waiting = false;
    if (l->partial.waiting)
        link->stats.latest_incomplete++;
    l->partial.waiting = false;
    if (new_peer)
        l->seen_mask = 0;
}

bool pf_latest_ready(const pf_link *link)
{
    for (uint32_t i = 0; i < PF_LINK_TOPICS; i++)
        if (link->latest.topics[i].waiting)
            return true;
    return link->latest.sending.waiting;
}

/* The next waiting topic in turn, of small or large messages; PF_LINK_TOPICS if there is none. */
static uint32_t next_topic(const pf_link *link, bool small)
{
    const pf_latest *l = &link->latest;
    for (uint32_t i = 1; i <= PF_LINK_TOPICS; i++) {
        uint32_t topic = (l->turns[small] + i) % PF_LINK_TOPICS;
        if (l->topics[topic].waiting && (l->topics[topic].size <= link->session.fragment) == small)
            return topic;
    }
    return PF_LINK_TOPICS;
}

static size_t build(pf_link *link, uint32_t topic, pf_latest_message *m)
{
    uint8_t *frame = pf_link_frame(link, PF_FRAME_LATEST);
    uint32_t fragment = link->session.fragment, n = pf_fragment_size(m->size, fragment, m->index);
    frame[4] = (uint8_t)topic;
    frame[5] = 0;
    pf_put16(frame + 6, m->index);
    pf_put32(frame + 8, m->number);
    pf_put32(frame + 12, m->size);
    memcpy(frame + PF_SIZE_LATEST, m->bytes + (size_t)m->index * fragment, n);
    if (++m->index == pf_fragments(m->size, fragment)) {
        m->waiting = false;
        link->stats.latest_sent++;
    }
    return PF_SIZE_LATEST + n;
}

size_t pf_latest_build(pf_link *link)
{
    pf_latest *l = &link->latest;
    uint32_t small = next_topic(link, true), large = next_topic(link, false);
    bool any_large = l->sending.waiting || large < PF_LINK_TOPICS;
    l->small_last = small < PF_LINK_TOPICS && !(l->small_last && any_large);
    if (l->small_last) {
        l->turns[true] = small;
        l->topics[small].index = 0;
        return build(link, small, &l->topics[small]);
    }
    if (!l->sending.waiting) { /* take it, and leave the topic the other buffer */
        uint8_t *spare = l->sending.bytes;
        l->sending = l->topics[large];
        l->sending.index = 0;
        l->sending_topic = l->turns[false] = large;
        l->topics[large].bytes = spare;
        l->topics[large].waiting = false;
    }
    return build(link, l->sending_topic, &l->sending);
}

static void deliver(pf_link *link, uint32_t topic, uint32_t number, const uint8_t *bytes, uint32_t size)
{
    pf_latest *l = &link->latest;
    l->seen[topic] = number;
    l->seen_mask |= 1u << topic;
    if (l->partial.waiting && l->partial_topic == topic && !pf_later(l->partial.number, number)) {
        l->partial.waiting = false;
        link->stats.latest_incomplete += l->partial.number != number;
    }
    link->stats.latest_received++;
    pf_link_event *event = pf_link_push_event(link, PF_LINK_LATEST);
    event->topic = topic;
    event->data = bytes;
    event->size = size;
}

bool pf_latest_receive(pf_link *link, const uint8_t *frame, size_t frame_size)
{
    pf_latest *l = &link->latest;
    if (frame_size < PF_SIZE_LATEST || frame[4] >= PF_LINK_TOPICS)
        return false;
    uint32_t topic = frame[4], index = pf_get16(frame + 6), number = pf_get32(frame + 8), size = pf_get32(frame + 12);
    uint32_t fragment = link->session.fragment;
    if (size > link->config.max_latest || index >= pf_fragments(size, fragment) ||
        frame_size - PF_SIZE_LATEST != pf_fragment_size(size, fragment, index))
        return false;
    if ((l->seen_mask >> topic & 1u) != 0 && !pf_later(number, l->seen[topic]))
        return true;
    if (size <= fragment) {
        deliver(link, topic, number, frame + PF_SIZE_LATEST, size);
        return true;
    }
    pf_latest_message *p = &l->partial;
    if (!p->waiting || l->partial_topic != topic || p->number != number || p->size != size) {
        if (p->waiting && l->partial_topic == topic && pf_later(p->number, number))
            return true;
        link->stats.latest_incomplete += p->waiting;
        p->waiting = true;
        p->number = number;
        p->size = size;
        p->index = 0;
        l->partial_topic = topic;
        memset(l->partial_bitmap, 0, pf_fragments(size, fragment) / 8 + 1);
    }
    if (pf_bit(l->partial_bitmap, index))
        return true;
    pf_bit_set(l->partial_bitmap, index);
    memcpy(p->bytes + (size_t)index * fragment, frame + PF_SIZE_LATEST, frame_size - PF_SIZE_LATEST);
    if (++p->index == pf_fragments(size, fragment))
        deliver(link, topic, number, p->bytes, size);
    return true;
}
