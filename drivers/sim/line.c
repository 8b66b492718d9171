/* The bytes of a direction stand in a ring, each with the time of its arrival; faults are decided as they are written.
 */
#include "pipefish/drivers/sim_line.h"

#include <string.h>

#define RECEIVE_BUFFER 65536u /* bytes that have arrived and wait for the reader; more are lost */

typedef struct byte_slot {
    uint64_t arrives;
    uint8_t byte;
} byte_slot;

typedef struct direction {
    byte_slot *ring;
    uint64_t head, tail, left; /* bytes ever put in, taken out, and gone from the FIFO: tail <= left <= head */
    uint64_t free_q8;          /* when the last one will have left, 1/256 ns */
    uint64_t frame, earlier;   /* where the frame being written and the one before it begin */
    uint64_t random;
    uint32_t burst; /* bytes still to be lost */
    pf_sim_line_stats stats;
} direction;

struct pf_sim_line {
    uint64_t byte_q8; /* 1/256 ns: at 3 Mbaud a byte does not last a whole number of nanoseconds */
    uint64_t latency_ns, ring_size;
    uint32_t fifo;
    bool connected;
    pf_sim_faults faults;
    direction directions[2]; /* by the writing end */
};

static bool complete_faults(pf_sim_faults *f)
{
    if (f->drop_burst == 0)
        f->drop_burst = 8;
    return f->drop_burst <= 4096 && f->corrupt_ppm <= 1000000 && f->drop_ppm <= 1000000 &&
           f->frame_loss_ppm <= 1000000 && f->duplicate_ppm <= 1000000 && f->reorder_ppm <= 1000000;
}

static bool complete_config(pf_sim_line_config *c)
{
    if (c->fifo == 0)
        c->fifo = 4096;
    return c->baud >= 300 && c->baud <= 100000000 && c->fifo >= 16 && c->fifo <= 1048576 &&
           c->latency_ns <= 1000000000 && complete_faults(&c->faults);
}

/* Twice the FIFO, for duplicates; what is on its way; the reader's buffer. */
static uint64_t ring_size(const pf_sim_line_config *c)
{
    return 2 * (uint64_t)c->fifo + c->latency_ns * c->baud / UINT64_C(10000000000) + 1 + RECEIVE_BUFFER;
}

static uint64_t header_size(void)
{
    return (sizeof(pf_sim_line) + 15) / 16 * 16;
}

size_t pf_sim_line_workspace_size(const pf_sim_line_config *config)
{
    if (config == NULL)
        return 0;
    pf_sim_line_config c = *config;
    return complete_config(&c) ? (size_t)(header_size() + 2 * ring_size(&c) * sizeof(byte_slot)) : 0;
}

pf_status pf_sim_line_init(pf_sim_line **line, const pf_sim_line_config *config, void *workspace, size_t size)
{
    size_t needed = pf_sim_line_workspace_size(config);
    if (line == NULL || workspace == NULL || needed == 0 || (uintptr_t)workspace % 16 != 0)
        return PF_ERR_ARGUMENT;
    if (size < needed)
        return PF_ERR_SPACE;
    pf_sim_line_config c = *config;
    complete_config(&c);
    pf_sim_line *l = workspace;
    memset(l, 0, sizeof *l);
    l->byte_q8 = UINT64_C(2560000000000) / c.baud;
    l->latency_ns = c.latency_ns;
    l->ring_size = ring_size(&c);
    l->fifo = c.fifo;
    l->connected = true;
    l->faults = c.faults;
    for (uint32_t i = 0; i < 2; i++) {
        l->directions[i].ring = (byte_slot *)((uint8_t *)workspace + header_size()) + i * l->ring_size;
        l->directions[i].random = c.seed * 2 + i;
    }
    *line = l;
    return PF_OK;
}

/* SplitMix64 (Steele, Lea, Flood 2014). */
static uint64_t next_random(direction *d)
{
    uint64_t z = d->random += UINT64_C(0x9E3779B97F4A7C15);
    z = (z ^ z >> 30) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ z >> 27) * UINT64_C(0x94D049BB133111EB);
    return z ^ z >> 31;
}

static bool happens(direction *d, uint32_t ppm)
{
    return ppm > 0 && next_random(d) % 1000000 < ppm;
}

static byte_slot *at(const pf_sim_line *l, const direction *d, uint64_t i)
{
    return &d->ring[i % l->ring_size];
}

static void let_leave(const pf_sim_line *l, direction *d, uint64_t now)
{
    while (d->left < d->head && at(l, d, d->left)->arrives - l->latency_ns <= now)
        d->left++;
}

size_t pf_sim_line_room(pf_sim_line *line, uint32_t end, uint64_t now_ns)
{
    direction *d = &line->directions[end & 1];
    let_leave(line, d, now_ns);
    uint64_t waiting = d->head - d->left;
    return waiting < line->fifo ? (size_t)(line->fifo - waiting) : 0;
}

/* One byte through the wire: it takes its time, whether it arrives or not. */
static void put(pf_sim_line *l, direction *d, uint8_t byte, uint64_t now)
{
    d->free_q8 = (d->free_q8 > now << 8 ? d->free_q8 : now << 8) + l->byte_q8;
    if (d->burst == 0 && happens(d, l->faults.drop_ppm))
        d->burst = l->faults.drop_burst;
    if (d->burst > 0 || d->head - d->tail == l->ring_size) {
        d->burst -= d->burst > 0;
        d->stats.bytes_dropped++;
        return;
    }
    if (happens(d, l->faults.corrupt_ppm)) {
        byte = (uint8_t)(byte ^ 1u << next_random(d) % 8);
        d->stats.bytes_corrupted++;
    }
    *at(l, d, d->head++) = (byte_slot){.arrives = (d->free_q8 >> 8) + l->latency_ns, .byte = byte};
}

static void reverse(const pf_sim_line *l, direction *d, uint64_t from, uint64_t to)
{
    for (; from + 1 < to; from++) {
        byte_slot *a = at(l, d, from), *b = at(l, d, --to);
        uint8_t byte = a->byte;
        a->byte = b->byte;
        b->byte = byte;
    }
}

/* The frame's zero has been written: frame faults. Places in the ring keep their times, only bytes move. */
static void end_frame(pf_sim_line *l, direction *d, uint64_t now)
{
    uint64_t begin = d->frame > d->left ? d->frame : d->left, end = d->head;
    bool whole = begin == d->frame && end > begin + 1;
    if (end > begin + 1 && happens(d, l->faults.frame_loss_ppm)) {
        byte_slot *s = at(l, d, begin + next_random(d) % (end - 1 - begin));
        uint8_t other = (uint8_t)(1 + next_random(d) % 255);
        s->byte = other != s->byte ? other : (uint8_t)(other % 255 + 1);
        d->stats.frames_lost++;
    }
    d->earlier = d->earlier > d->left ? d->earlier : d->left;
    if (whole && d->earlier + 1 < d->frame && happens(d, l->faults.reorder_ppm)) {
        uint64_t length = end - d->frame;
        reverse(l, d, d->earlier, end);
        reverse(l, d, d->earlier, d->earlier + length);
        reverse(l, d, d->earlier + length, end);
        d->frame = d->earlier + length;
        d->stats.frames_reordered++;
    }
    if (whole && happens(d, l->faults.duplicate_ppm)) {
        begin = d->frame;
        d->frame = d->head;
        for (uint64_t i = begin; i < end; i++)
            put(l, d, at(l, d, i)->byte, now);
        d->stats.frames_duplicated++;
    }
    d->earlier = d->frame;
    d->frame = d->head;
}

size_t pf_sim_line_write(pf_sim_line *line, uint32_t end, const uint8_t *bytes, size_t n, uint64_t now_ns)
{
    direction *d = &line->directions[end & 1];
    size_t room = pf_sim_line_room(line, end, now_ns);
    n = n < room ? n : room;
    d->stats.bytes_written += n;
    if (!line->connected) {
        d->stats.bytes_dropped += n;
        return n;
    }
    for (size_t i = 0; i < n; i++) {
        put(line, d, bytes[i], now_ns);
        if (bytes[i] == 0)
            end_frame(line, d, now_ns);
    }
    return n;
}

size_t pf_sim_line_read(pf_sim_line *line, uint32_t end, uint8_t *bytes, size_t capacity, uint64_t now_ns)
{
    direction *d = &line->directions[~end & 1];
    size_t n = 0;
    let_leave(line, d, now_ns);
    while (n < capacity && d->tail < d->head && at(line, d, d->tail)->arrives <= now_ns)
        bytes[n++] = at(line, d, d->tail++)->byte;
    d->stats.bytes_read += n;
    return n;
}

uint64_t pf_sim_line_arrival(const pf_sim_line *line, uint32_t end)
{
    const direction *d = &line->directions[~end & 1];
    return d->tail < d->head ? at(line, d, d->tail)->arrives : UINT64_MAX;
}

uint64_t pf_sim_line_room_at(const pf_sim_line *line, uint32_t end, size_t n)
{
    const direction *d = &line->directions[end & 1];
    uint64_t may_wait = n < line->fifo ? line->fifo - n : 0;
    if (d->head - d->left <= may_wait)
        return 0;
    return at(line, d, d->head - may_wait - 1)->arrives - line->latency_ns;
}

void pf_sim_line_cut(pf_sim_line *line)
{
    for (uint32_t i = 0; i < 2; i++) {
        direction *d = &line->directions[i];
        d->stats.bytes_dropped += d->head - d->tail;
        d->tail = d->left = d->frame = d->earlier = d->head;
        d->free_q8 = 0;
        d->burst = 0;
    }
}

void pf_sim_line_connect(pf_sim_line *line, bool connected)
{
    line->connected = connected;
    if (!connected)
        pf_sim_line_cut(line);
}

void pf_sim_line_set_faults(pf_sim_line *line, const pf_sim_faults *faults)
{
    pf_sim_faults f = *faults;
    if (complete_faults(&f))
        line->faults = f;
}

const pf_sim_line_stats *pf_sim_line_get_stats(const pf_sim_line *line, uint32_t end)
{
    return &line->directions[end & 1].stats;
}
