/* Quadrature decoder: edges of two lines become a count. Every edge counts one, so contacts that bounce count forth and
 * back and end where they should. Edges carry numbers; missing ones are noticed, counted, and bridged in the direction
 * of the last edge if what comes next agrees. Pure: no device, no clock.
 */
#ifndef PIPEFISH_QUADRATURE_H
#define PIPEFISH_QUADRATURE_H

#include "pipefish/base.h"

enum { PF_QUADRATURE_A = 0, PF_QUADRATURE_B = 1 };

typedef struct pf_quadrature {
    int64_t count; /* edges forwards less edges backwards; forwards is A before B */
    /* statistics */
    uint32_t missed;   /* edges known to be lost, by their numbers */
    uint32_t repeated; /* edges to a level that the line had already: its return was not seen */
    uint32_t illegal;  /* both lines changed at once, or lost edges that fit no steady motion */
    /* private */
    int way;       /* of the last edge: 1, -1; 0 = none yet */
    uint8_t state; /* bit 0: A, bit 1: B */
    bool has_number;
    uint32_t number;
} pf_quadrature;

void pf_quadrature_init(pf_quadrature *q, bool a, bool b);

/* A line has changed to `level`. `number` goes up by one an edge of either line, modulo 2^32; the first may be any. */
void pf_quadrature_edge(pf_quadrature *q, int line, bool level, uint32_t number);

/* Both levels as read now, for decoders without edges and after a start: one step counts, two are illegal and do not.
 */
void pf_quadrature_sample(pf_quadrature *q, bool a, bool b);

#define PF_EDGE_ORDER_MAX     8u
#define PF_EDGE_ORDER_WAIT_NS 20000000u /* how long an edge may come after one with a higher number */

/* An edge as the kernel reports it. */
typedef struct pf_edge {
    uint32_t line; /* index in the group of lines it was asked for with */
    bool is_active;
    uint32_t number;  /* goes up by one an edge of the group; a gap is edges that the kernel dropped */
    uint64_t time_ns; /* monotonic clock */
} pf_edge;

/* Brings edges into the order of their numbers: the kernel reports each line's from a thread of its own. */
typedef struct pf_edge_order {
    uint32_t late; /* statistics: edges that came when nobody waited for them any more; they do not count */
    bool has_next;
    uint32_t next, n;
    pf_edge held[PF_EDGE_ORDER_MAX];
} pf_edge_order;

/* Takes an edge in. pf_edge_order_next then gives those that are due. */
void pf_edge_order_add(pf_edge_order *order, const pf_edge *edge);

/* The next edge: the one with the next number, or, if that does not come, the one after it: when PF_EDGE_ORDER_MAX
 * wait, or one has waited for PF_EDGE_ORDER_WAIT_NS. False: none is due. Call it until then, after each edge added. */
bool pf_edge_order_next(pf_edge_order *order, uint64_t now_ns, pf_edge *edge);

#define PF_HISTORY 1024u /* counts remembered: a second at 1000 edges a second */

/* Counts by time, so that a frame gets the count of its own moment. */
typedef struct pf_history {
    uint32_t n; /* written so far, modulo 2^32 */
    struct {
        uint64_t time_ns;
        int64_t count;
    } item[PF_HISTORY];
} pf_history;

/* Times do not fall; one that does counts as the time of the last. */
void pf_history_add(pf_history *h, uint64_t time_ns, int64_t count);

/* The count at a moment: of the last item at or before it; before all that is remembered, the count of the oldest.
 * `fallback` if there is none at all. */
int64_t pf_history_at(const pf_history *h, uint64_t time_ns, int64_t fallback);

#endif
