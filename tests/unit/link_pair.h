/* Two links back to back, in steps, and frames made by hand: what test_link.c and test_link_bulk.c are built on. */
#ifndef LINK_PAIR_H
#define LINK_PAIR_H

#include "../../lib/link/internal.h" /* for the counters' wrap, and the numbers of the frames */

#define MS UINT64_C(1000000)

typedef struct end {
    pf_link *link;
    pf_link_config config;
    uint32_t counts[10];    /* by event type */
    pf_link_event last[10]; /* without .data */
    uint8_t data[40000];    /* of the last event that had some */
} end;

extern end a, b; /* device and host; setUp configures them */
extern uint64_t now;
extern uint8_t wire[100000]; /* the last output that was carried */
extern size_t wire_size;

/* Starts an end anew in a workspace of the exact size. */
void open_end(end *e);
void feed(end *e, const uint8_t *bytes, size_t n);
/* Carries what `from` has to say; returns the bytes. */
size_t move(end *from, end *to);
/* Lets both talk for `ms` milliseconds. */
void talk(uint64_t ms);
/* Starts both and lets them come up. */
void open_both(void);
/* Feeds a frame as an intact sender would put it on the wire. */
void feed_raw(end *e, const uint8_t *frame, size_t n);
/* A frame of b's, made by hand: header with the session's tag, then zeros; `frame` has PF_LINK_RAW_MAX bytes. */
uint8_t *hand_made(uint8_t *frame, pf_frame_type type);
void put_name(uint8_t *name, uint8_t id);
/* Frames from b to a of an object with this handle. */
void offer_by_hand(uint8_t handle, uint8_t id, uint32_t size);
void data_by_hand(uint8_t handle, uint32_t index, uint32_t tx, size_t n);
/* What a's next acknowledgement says of this handle; 255 = none comes. */
uint32_t ack_state(uint32_t handle);

#endif
