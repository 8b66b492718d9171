#include "gpio/quadrature.h"

#include <string.h>

/* Where a state is in the cycle 00, A, AB, B that forward motion runs through; and back. */
static const uint8_t place_of[4] = {0, 1, 3, 2}, state_at[4] = {0, 1, 3, 2};

void pf_quadrature_init(pf_quadrature *q, bool a, bool b)
{
    memset(q, 0, sizeof *q);
    q->state = (uint8_t)((unsigned)a | (unsigned)b << 1);
}

static bool level_of(unsigned state, int line)
{
    return state >> line & 1u;
}

/* Edges were lost before one that brings `line` to `level`. */
static void bridge(pf_quadrature *q, uint32_t lost, int line, bool level)
{
    const uint8_t forward = (uint8_t)(lost & 3u), step = q->way < 0 ? (uint8_t)((4u - forward) & 3u) : forward;
    const uint8_t state = state_at[(place_of[q->state] + step) & 3u];
    q->missed += lost;
    if (q->way != 0 && lost < 0x80000000u && level_of(state, line) != level) {
        q->state = state;
        q->count += (int64_t)q->way * lost;
        return;
    }
    q->illegal++;
    q->state = (uint8_t)((q->state & ~(1u << line)) | (level ? 0u : 1u << line)); /* as it must have been */
}

static void move_to(pf_quadrature *q, uint8_t state)
{
    q->way = ((place_of[state] - place_of[q->state]) & 3) == 1 ? 1 : -1;
    q->count += q->way;
    q->state = state;
}

void pf_quadrature_edge(pf_quadrature *q, int line, bool level, uint32_t number)
{
    if (q->has_number && number - q->number != 1)
        bridge(q, number - q->number - 1, line, level);
    q->has_number = true;
    q->number = number;
    if (level_of(q->state, line) == level)
        q->repeated++;
    else
        move_to(q, (uint8_t)(q->state ^ 1u << line));
}

void pf_quadrature_sample(pf_quadrature *q, bool a, bool b)
{
    const uint8_t state = (uint8_t)((unsigned)a | (unsigned)b << 1);
    const unsigned changed = state ^ q->state;
    if (changed == 3) {
        q->illegal++;
        q->state = state;
    } else if (changed != 0) {
        move_to(q, state);
    }
}

void pf_edge_order_add(pf_edge_order *o, const pf_edge *edge)
{
    uint32_t i = o->n;
    if (!o->has_next) {
        o->has_next = true;
        o->next = edge->number;
    }
    if (edge->number - o->next > UINT32_MAX / 2 || o->n == PF_EDGE_ORDER_MAX) {
        o->late++;
        return;
    }
    for (; i > 0 && o->held[i - 1].number - o->next > edge->number - o->next; i--)
        o->held[i] = o->held[i - 1];
    o->held[i] = *edge;
    o->n++;
}

bool pf_edge_order_next(pf_edge_order *o, uint64_t now_ns, pf_edge *edge)
{
    if (o->n == 0 || (o->held[0].number != o->next && o->n < PF_EDGE_ORDER_MAX &&
                      now_ns < o->held[0].time_ns + PF_EDGE_ORDER_WAIT_NS))
        return false;
    *edge = o->held[0];
    o->next = edge->number + 1;
    o->n--;
    memmove(o->held, o->held + 1, o->n * sizeof o->held[0]);
    return true;
}

void pf_history_add(pf_history *h, uint64_t time_ns, int64_t count)
{
    if (h->n > 0 && time_ns < h->item[(h->n - 1) % PF_HISTORY].time_ns)
        time_ns = h->item[(h->n - 1) % PF_HISTORY].time_ns;
    h->item[h->n % PF_HISTORY].time_ns = time_ns;
    h->item[h->n % PF_HISTORY].count = count;
    h->n = h->n == UINT32_MAX ? PF_HISTORY : h->n + 1; /* 2^32 is a multiple of it: the order stays */
}

int64_t pf_history_at(const pf_history *h, uint64_t time_ns, int64_t fallback)
{
    const uint32_t held = h->n < PF_HISTORY ? h->n : PF_HISTORY;
    for (uint32_t k = 1; k <= held; k++) {
        const uint32_t i = (h->n - k) % PF_HISTORY;
        if (h->item[i].time_ns <= time_ns || k == held)
            return h->item[i].count;
    }
    return fallback;
}
