/* The receiving half of bulk. A slot keeps what has arrived of an object whatever happens to the line or the peer; the
 * offer of the same name, size and fragment size goes on from there. */
#include "internal.h"

#include <string.h>

static pf_receive_slot *find_handle(pf_link *link, uint32_t handle)
{
    for (uint32_t i = 0; i < link->config.receive_slots; i++) {
        pf_receive_slot *slot = &link->receiver.slots[i];
        if (slot->state != PF_RECEIVE_FREE && slot->handle == handle && handle != 0)
            return slot;
    }
    return NULL;
}

static pf_receive_slot *find_name(pf_link *link, const uint8_t *name)
{
    for (uint32_t i = 0; i < link->config.receive_slots; i++) {
        pf_receive_slot *slot = &link->receiver.slots[i];
        if (slot->state != PF_RECEIVE_FREE && memcmp(slot->name, name, PF_LINK_NAME_SIZE) == 0)
            return slot;
    }
    return NULL;
}

static bool question_open(const pf_receive_slot *slot)
{
    return slot->state == PF_RECEIVE_ASKED || slot->state == PF_RECEIVE_COMPLETE;
}

/* A full queue drops the reply: the peer repeats what it asked. */
static void reply(pf_link *link, uint32_t handle, pf_ack_state state)
{
    pf_receiver *r = &link->receiver;
    for (uint32_t i = 0; i < r->reply_count; i++)
        if (r->replies[i].handle == handle && r->replies[i].state == state)
            return;
    if (r->reply_count < sizeof r->replies / sizeof r->replies[0])
        r->replies[r->reply_count++] = (pf_reply){.handle = (uint16_t)handle, .state = (uint8_t)state};
}

static void tell(pf_receive_slot *slot)
{
    slot->ack_due = slot->handle != 0;
}

static void clear_fragments(pf_receive_slot *slot)
{
    slot->base = slot->top = slot->received = 0;
    memset(slot->bitmap, 0, slot->count / 8 + 1);
}

void pf_receiver_end(pf_link *link, bool new_peer)
{
    pf_receiver *r = &link->receiver;
    for (uint32_t i = 0; i < link->config.receive_slots; i++) {
        pf_receive_slot *slot = &r->slots[i];
        slot->named = slot->ack_due = false;
        if (!new_peer)
            continue;
        slot->handle = 0;
        if (slot->state == PF_RECEIVE_STORED || slot->state == PF_RECEIVE_REFUSED)
            slot->state = PF_RECEIVE_FREE;
        if (slot->state == PF_RECEIVE_AGAIN)
            slot->state = PF_RECEIVE_RECEIVING;
    }
    r->reply_count = 0;
    r->unacked = 0;
    if (new_peer)
        r->tx_highest = 0;
}

/* The peer offers anew what it still has; what it does not mention may be dropped. */
void pf_receiver_peer_reset(pf_link *link)
{
    for (uint32_t i = 0; i < link->config.receive_slots; i++)
        link->receiver.slots[i].named = false;
}

/* A slot for a new object: a free one, one that is done, the oldest partial that the peer does not mention any more. */
static pf_receive_slot *find_room(pf_link *link)
{
    pf_receive_slot *best = NULL;
    uint32_t best_rank = 0;
    for (uint32_t i = 0; i < link->config.receive_slots; i++) {
        pf_receive_slot *slot = &link->receiver.slots[i];
        uint32_t rank = 0;
        if (slot->state == PF_RECEIVE_FREE)
            rank = 3;
        else if ((slot->state == PF_RECEIVE_STORED || slot->state == PF_RECEIVE_REFUSED) && !slot->ack_due)
            rank = 2;
        else if (!question_open(slot) && !slot->named && !slot->ack_due)
            rank = 1;
        if (rank > best_rank || (rank > 0 && rank == best_rank && pf_later(best->order, slot->order))) {
            best = slot;
            best_rank = rank;
        }
    }
    return best;
}

static void adopt(pf_link *link, pf_receive_slot *slot, uint32_t handle)
{
    pf_receive_slot *other = find_handle(link, handle);
    if (other != NULL && other != slot) { /* the peer's numbers have gone round */
        other->handle = 0;
        other->named = other->ack_due = false;
    }
    slot->handle = (uint16_t)handle;
    slot->named = true;
    slot->order = ++link->receiver.order;
    tell(slot);
}

bool pf_receiver_offer(pf_link *link, const uint8_t *frame, size_t frame_size)
{
    if (frame_size != PF_SIZE_OFFER)
        return false;
    uint32_t handle = pf_get16(frame + 4), kind = frame[6], size = pf_get32(frame + 8), fragment = pf_get16(frame + 12);
    const uint8_t *name = frame + 16;
    if (handle == 0 || size == 0 || fragment < PF_LINK_FRAGMENT_MIN || fragment > link->session.fragment)
        return false;
    uint32_t count = pf_fragments(size, fragment);
    if (link->config.receive_slots == 0) {
        reply(link, handle, PF_ACK_BUSY);
        return true;
    }
    if (size > link->config.max_object || count > PF_LINK_COUNT_MAX) {
        reply(link, handle, PF_ACK_REFUSED);
        return true;
    }
    pf_receive_slot *slot = find_name(link, name);
    /* Done under another handle: a new offer of the same bytes, which the caller may want once more. */
    bool done = slot != NULL && (slot->state == PF_RECEIVE_STORED || slot->state == PF_RECEIVE_REFUSED);
    bool same = slot != NULL && slot->size == size && slot->fragment == fragment && slot->kind == kind;
    if (same && (!done || slot->handle == handle)) {
        if (slot->state == PF_RECEIVE_AGAIN && slot->handle != handle)
            slot->state = PF_RECEIVE_RECEIVING;
        adopt(link, slot, handle);
        return true;
    }
    /* If the name is known with another size or fragment size, what we hold does not help. */
    if (slot == NULL)
        slot = find_room(link);
    if (slot == NULL || question_open(slot)) {
        reply(link, handle, PF_ACK_BUSY);
        return true;
    }
    slot->state = PF_RECEIVE_ASKED;
    slot->kind = (uint8_t)kind;
    slot->size = size;
    slot->fragment = fragment;
    slot->count = count;
    memcpy(slot->name, name, PF_LINK_NAME_SIZE);
    clear_fragments(slot);
    adopt(link, slot, handle);
    pf_link_event *event = pf_link_push_event(link, PF_LINK_OFFER);
    event->slot = (uint32_t)(slot - link->receiver.slots);
    event->kind = kind;
    event->size = size;
    memcpy(event->name, name, PF_LINK_NAME_SIZE);
    return true;
}

static bool has_part(const pf_receive_slot *slot)
{
    return slot->state == PF_RECEIVE_RECEIVING && slot->handle != 0 && slot->top > 0;
}

/* All objects that are arriving, not only the one of this fragment: the last ones of another may have been lost. */
static void tell_all(pf_link *link)
{
    for (uint32_t i = 0; i < link->config.receive_slots; i++)
        if (has_part(&link->receiver.slots[i]))
            link->receiver.slots[i].ack_due = true;
    link->receiver.unacked = 0;
}

static void complete(pf_link *link, pf_receive_slot *slot)
{
    slot->state = PF_RECEIVE_COMPLETE;
    tell(slot);
    link->stats.objects_received++;
    link->stats.object_bytes_received += slot->size;
    pf_link_event *event = pf_link_push_event(link, PF_LINK_OBJECT);
    event->slot = (uint32_t)(slot - link->receiver.slots);
    event->kind = slot->kind;
    event->size = slot->size;
    event->data = slot->bytes;
    memcpy(event->name, slot->name, PF_LINK_NAME_SIZE);
}

static void keep_fragment(pf_link *link, pf_receive_slot *slot, uint32_t index, const uint8_t *bytes, size_t n)
{
    memcpy(slot->bytes + (size_t)index * slot->fragment, bytes, n);
    pf_bit_set(slot->bitmap, index);
    slot->received++;
    slot->top = index >= slot->top ? index + 1 : slot->top;
    while (slot->base < slot->count && pf_bit(slot->bitmap, slot->base))
        slot->base++;
    link->stats.fragments_received++;
}

bool pf_receiver_data(pf_link *link, const uint8_t *frame, size_t size)
{
    pf_receiver *r = &link->receiver;
    if (size <= PF_SIZE_DATA)
        return false;
    uint32_t handle = pf_get16(frame + 4), index = pf_get16(frame + 6), tx = pf_get32(frame + 8);
    size_t n = size - PF_SIZE_DATA;
    pf_receive_slot *slot = find_handle(link, handle);
    if (slot != NULL && (index >= slot->count || n != pf_fragment_size(slot->size, slot->fragment, index)))
        return false;
    bool gap = tx != r->tx_highest + 1;
    if (pf_later(tx, r->tx_highest))
        r->tx_highest = tx;
    if (slot == NULL) {
        link->stats.stale++;
        reply(link, handle, PF_ACK_UNKNOWN);
        return true;
    }
    slot->named = true;
    if (slot->state != PF_RECEIVE_RECEIVING) {
        link->stats.fragments_duplicate++;
        tell(slot);
        return true;
    }
    if (pf_bit(slot->bitmap, index)) {
        link->stats.fragments_duplicate++;
        gap = true;
    } else {
        keep_fragment(link, slot, index, frame + PF_SIZE_DATA, n);
    }
    if (r->unacked++ == 0)
        r->ack_at = link->now + PF_LINK_ACK_DELAY_NS;
    if (slot->received == slot->count)
        complete(link, slot);
    if (gap || slot->state == PF_RECEIVE_COMPLETE || r->unacked >= PF_LINK_ACK_EVERY)
        tell_all(link);
    return true;
}

bool pf_receiver_cancel(pf_link *link, const uint8_t *frame, size_t size)
{
    if (size != PF_SIZE_CANCEL)
        return false;
    uint32_t handle = pf_get16(frame + 4);
    pf_receive_slot *slot = find_handle(link, handle);
    if (slot != NULL) {
        slot->handle = 0;
        slot->named = slot->ack_due = false;
        if (!question_open(slot)) /* an open question is answered first; then the slot is for anyone */
            slot->state = PF_RECEIVE_FREE;
    }
    reply(link, handle, PF_ACK_UNKNOWN);
    return true;
}

pf_status pf_link_answer_object(pf_link *link, uint32_t number, pf_link_answer answer)
{
    if (number >= link->config.receive_slots || !question_open(&link->receiver.slots[number]))
        return PF_ERR_ARGUMENT;
    pf_receive_slot *slot = &link->receiver.slots[number];
    bool object = slot->state == PF_RECEIVE_COMPLETE;
    if (answer == PF_ANSWER_STORED) {
        slot->state = PF_RECEIVE_STORED;
    } else if (answer == PF_ANSWER_REFUSE) {
        slot->state = PF_RECEIVE_REFUSED;
    } else if (answer == PF_ANSWER_ACCEPT && !object) {
        slot->state = PF_RECEIVE_RECEIVING;
    } else if (answer == PF_ANSWER_AGAIN && object) {
        slot->state = slot->handle != 0 ? PF_RECEIVE_AGAIN : PF_RECEIVE_RECEIVING;
        clear_fragments(slot);
    } else {
        return PF_ERR_ARGUMENT;
    }
    tell(slot);
    return PF_OK;
}

/* ---- acknowledgements ---- */

uint64_t pf_receiver_due(const pf_link *link)
{
    const pf_receiver *r = &link->receiver;
    bool part = false;
    if (r->reply_count > 0)
        return 0;
    for (uint32_t i = 0; i < link->config.receive_slots; i++) {
        if (r->slots[i].ack_due)
            return 0;
        part = part || has_part(&r->slots[i]);
    }
    return part && r->unacked > 0 ? r->ack_at : PF_LINK_NEVER;
}

static size_t build_ack(pf_link *link, uint32_t handle, pf_ack_state state, uint32_t base)
{
    uint8_t *frame = pf_link_frame(link, PF_FRAME_ACK);
    pf_put16(frame + 4, handle);
    frame[6] = (uint8_t)state;
    frame[7] = 0;
    pf_put32(frame + 8, link->receiver.tx_highest);
    pf_put16(frame + 12, base);
    return PF_SIZE_ACK;
}

static size_t build_slot_ack(pf_link *link, pf_receive_slot *slot)
{
    static const uint8_t states[] = {
        [PF_RECEIVE_FREE] = PF_ACK_UNKNOWN,        [PF_RECEIVE_ASKED] = PF_ACK_WAITING,
        [PF_RECEIVE_RECEIVING] = PF_ACK_RECEIVING, [PF_RECEIVE_COMPLETE] = PF_ACK_COMPLETE,
        [PF_RECEIVE_STORED] = PF_ACK_STORED,       [PF_RECEIVE_REFUSED] = PF_ACK_REFUSED,
        [PF_RECEIVE_AGAIN] = PF_ACK_AGAIN,
    };
    slot->ack_due = false;
    size_t size = build_ack(link, slot->handle, (pf_ack_state)states[slot->state], slot->base);
    if (slot->state != PF_RECEIVE_RECEIVING)
        return size;
    uint8_t *bitmap = link->raw + PF_SIZE_ACK;
    memset(bitmap, 0, PF_LINK_BITMAP);
    for (uint32_t i = slot->base + 1; i < slot->top && i - slot->base <= PF_LINK_REACH; i++)
        if (pf_bit(slot->bitmap, i)) {
            uint32_t bit = i - slot->base - 1;
            pf_bit_set(bitmap, bit);
            size = PF_SIZE_ACK + bit / 8 + 1;
        }
    return size;
}

size_t pf_receiver_build(pf_link *link)
{
    pf_receiver *r = &link->receiver;
    if (r->reply_count > 0) {
        pf_reply first = r->replies[0];
        r->reply_count--;
        memmove(r->replies, r->replies + 1, r->reply_count * sizeof r->replies[0]);
        return build_ack(link, first.handle, (pf_ack_state)first.state, 0);
    }
    if (r->unacked > 0 && link->now >= r->ack_at)
        tell_all(link);
    for (uint32_t i = 0; i < link->config.receive_slots; i++)
        if (r->slots[i].ack_due)
            return build_slot_ack(link, &r->slots[i]);
    return 0;
}
