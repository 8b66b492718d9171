/* The link's private state, shared by its rooms. SPEC.md describes the frames and the state machines.
 *
 *   link.c          workspace, bytes in and out, priorities, deadline
 *   session.c       hello, keepalive, round trip and clock
 *   control.c       stop and wait
 *   latest.c        newest wins
 *   bulk_send.c     offers, fragments, loss detection
 *   bulk_receive.c  slots, resume, acknowledgements
 *
 * Every room that sends has a function that says when it will have a frame (_due, PF_LINK_NEVER if only input can
 * change that) and one that builds it; pf_link_output and pf_link_deadline ask the same functions, so a deadline that
 * has come always has a frame or an event behind it. */
#ifndef PF_LINK_INTERNAL_H
#define PF_LINK_INTERNAL_H

#include "pipefish/link.h"

#define PF_LINK_NEVER         UINT64_MAX
#define PF_LINK_MS            UINT64_C(1000000)
#define PF_LINK_HELLO_NS      (200 * PF_LINK_MS)  /* between hellos until the peer answers */
#define PF_LINK_ACK_DELAY_NS  (5 * PF_LINK_MS)    /* longest wait of a fragment for its acknowledgement, */
#define PF_LINK_ACK_EVERY     8u                  /* and most fragments that wait for one */
#define PF_LINK_POLL_MAX_NS   (1000 * PF_LINK_MS) /* slowest repetition of an offer, a cancel or a control message */
#define PF_LINK_RTO_FIRST_NS  (500 * PF_LINK_MS)  /* control and offers, before any round trip was measured */
#define PF_LINK_DATA_FIRST_NS (1000 * PF_LINK_MS) /* fragments, before one was acknowledged: the queue is unknown */
#define PF_LINK_RTO_MAX_NS    (2000 * PF_LINK_MS)
#define PF_LINK_REORDER       3u /* a fragment is lost when one sent this much later has arrived */

_Static_assert(PF_LINK_FRAGMENT_MAX + 16 + 4 <= PF_LINK_FRAME_MAX - 8 && 1000 + 8 + 4 <= PF_LINK_FRAME_MAX - 8,
               "every frame fits its buffers");

enum {
    PF_LINK_HEADER = 4,
    PF_LINK_CRC = 4,
    PF_LINK_FRAGMENT_MIN = 64,
    PF_LINK_BITMAP = 64, /* bytes of an acknowledgement's bitmap, and of the sender's view of an object */
    PF_LINK_REACH = PF_LINK_BITMAP * 8,
    PF_LINK_COUNT_MAX = 65535, /* fragments of an object: its index has 16 bits */
    PF_LINK_RAW_MAX = PF_LINK_FRAME_MAX - 8,
};

typedef enum pf_frame_type {
    PF_FRAME_HELLO = 0,
    PF_FRAME_CONTROL = 1,
    PF_FRAME_CONTROL_ACK = 2,
    PF_FRAME_LATEST = 3,
    PF_FRAME_OFFER = 4,
    PF_FRAME_DATA = 5,
    PF_FRAME_ACK = 6,
    PF_FRAME_PING = 7,
    PF_FRAME_PONG = 8,
    PF_FRAME_CANCEL = 9,
} pf_frame_type;

/* Sizes of header and fixed part of the body; CONTROL, LATEST, DATA and ACK continue. */
enum {
    PF_SIZE_HELLO = 36,
    PF_SIZE_CONTROL = 8,
    PF_SIZE_CONTROL_ACK = 8,
    PF_SIZE_LATEST = 16,
    PF_SIZE_OFFER = 48,
    PF_SIZE_DATA = 12,
    PF_SIZE_ACK = 14,
    PF_SIZE_PING = 16,
    PF_SIZE_PONG = 24,
    PF_SIZE_CANCEL = 6,
};

typedef enum pf_ack_state {
    PF_ACK_WAITING = 0,
    PF_ACK_RECEIVING = 1,
    PF_ACK_COMPLETE = 2,
    PF_ACK_STORED = 3,
    PF_ACK_REFUSED = 4,
    PF_ACK_BUSY = 5,
    PF_ACK_AGAIN = 6,
    PF_ACK_UNKNOWN = 7,
} pf_ack_state;

/* ---- session ---- */

typedef struct pf_session {
    bool up, incompatible_told, was_up;
    bool hello_due, ask; /* a hello must go out; ask: with the wish for an answer */
    uint32_t peer_nonce; /* of the session; 0 = none yet */
    uint32_t candidate;  /* of a peer that has said hello and not echoed ours yet; 0 = none */
    uint32_t dead_nonce; /* of the session before: its late hellos are not a restart */
    uint32_t incompatible_nonce;
    uint32_t peer_slots, fragment;
    uint64_t peer_boot_id;
    uint64_t hello_at; /* last hello sent */
    uint64_t heard_at; /* last valid frame */
    bool pong_due, ping_open;
    uint32_t pong_id, ping_id;
    uint64_t pong_echo, ping_at, ping_due;
    uint64_t srtt, rttvar; /* ns; srtt 0 = not measured */
    bool data_sampled;
    uint64_t clock_at; /* when the kept clock offset was measured */
} pf_session;

/* ---- control ---- */

typedef struct pf_control {
    uint8_t *queue; /* control_queue x (2 + max_control) */
    uint32_t head, count;
    uint32_t sequence; /* of the message at head */
    bool sent;         /* the message at head has gone out */
    uint64_t repeat_at, interval;
    uint32_t expected; /* next one of the peer */
    bool ack_due;
} pf_control;

/* ---- latest ---- */

typedef struct pf_latest_message {
    uint8_t *bytes;
    uint32_t size, number, index;
    bool waiting;
} pf_latest_message;

typedef struct pf_latest {
    pf_latest_message topics[PF_LINK_TOPICS];
    pf_latest_message sending;        /* the one message of several fragments under way */
    uint32_t sending_topic, turns[2]; /* last topic of a large and of a small message */
    bool small_last;
    uint32_t seen[PF_LINK_TOPICS]; /* number of the newest delivered */
    uint32_t seen_mask;
    pf_latest_message partial; /* being received; .index counts its fragments */
    uint32_t partial_topic;
    uint8_t *partial_bitmap;
} pf_latest;

/* ---- bulk ---- */

typedef enum pf_send_state {
    PF_SEND_FREE = 0,
    PF_SEND_NEW,        /* to be offered */
    PF_SEND_OFFERED,    /* no acceptance yet */
    PF_SEND_SENDING,    /* accepted */
    PF_SEND_STORING,    /* all has arrived; the peer is storing it */
    PF_SEND_CANCELLING, /* the caller has its memory back; the peer does not know it yet */
} pf_send_state;

/* Fragments base .. base + PF_LINK_REACH - 1 can be under way; their bits are at index modulo PF_LINK_REACH. */
typedef struct pf_send_slot {
    uint8_t state;
    uint8_t kind;
    uint16_t handle;
    uint32_t order; /* oldest first */
    uint32_t size, fragment, count;
    uint32_t base; /* first fragment that the peer lacks */
    uint32_t next; /* first never sent in this session */
    uint32_t lost_count;
    uint64_t poll_at, interval;
    const uint8_t *bytes;
    uint8_t name[PF_LINK_NAME_SIZE];
    uint8_t acked[PF_LINK_BITMAP], lost[PF_LINK_BITMAP];
} pf_send_slot;

/* A fragment on the wire; the ring holds them by tx. */
typedef struct pf_flight {
    uint64_t at;
    uint16_t index, size;
    uint8_t slot;
    bool open; /* neither acknowledged nor lost */
} pf_flight;

typedef struct pf_sender {
    pf_send_slot slots[PF_LINK_SLOTS_MAX];
    pf_flight *ring;
    uint32_t ring_size;
    uint32_t tx_next, tx_tail; /* ring holds tail .. next - 1 */
    uint32_t tx_seen;          /* highest that the peer has seen */
    uint32_t flying;           /* bytes of the open ones */
    uint64_t progress_at;
    uint32_t backoff;
    uint32_t order;
    uint16_t handle;
} pf_sender;

typedef enum pf_receive_state {
    PF_RECEIVE_FREE = 0,
    PF_RECEIVE_ASKED, /* PF_LINK_OFFER is open */
    PF_RECEIVE_RECEIVING,
    PF_RECEIVE_COMPLETE, /* PF_LINK_OBJECT is open */
    PF_RECEIVE_STORED,
    PF_RECEIVE_REFUSED,
    PF_RECEIVE_AGAIN, /* waits for the offer under another handle */
} pf_receive_state;

typedef struct pf_receive_slot {
    uint8_t state, kind;
    bool named;   /* the peer has mentioned it since it came up: .handle is valid */
    bool ack_due; /* tell the peer at once */
    uint16_t handle;
    uint32_t order; /* of the last offer */
    uint32_t size, fragment, count;
    uint32_t base, top, received; /* first missing, one past the highest, number of fragments */
    uint8_t *bytes, *bitmap;
    uint8_t name[PF_LINK_NAME_SIZE];
} pf_receive_slot;

typedef struct pf_reply {
    uint16_t handle;
    uint8_t state;
} pf_reply;

typedef struct pf_receiver {
    pf_receive_slot slots[PF_LINK_SLOTS_MAX];
    pf_reply replies[8]; /* acknowledgements of handles without a slot */
    uint32_t reply_count;
    uint32_t tx_highest, order;
    uint32_t unacked; /* fragments since the last acknowledgement */
    uint64_t ack_at;  /* when they must be acknowledged */
} pf_receiver;

struct pf_link {
    pf_link_config config; /* defaults filled in */
    pf_link_stats stats;
    uint64_t now;
    pf_session session;
    pf_control control;
    pf_latest latest;
    pf_sender sender;
    pf_receiver receiver;
    int32_t credit;          /* bytes of bulk sent since, less those of latest: above zero it is the turn of latest */
    bool delimiter_due;      /* a leading zero ends whatever half frame the peer holds */
    uint32_t in_size;        /* a full buffer is more than any frame has */
    pf_link_event events[4]; /* a frame raises one at most, and input waits until it is taken; DOWN may join it */
    uint32_t event_head, event_count;
    uint8_t in[PF_LINK_FRAME_MAX];
    uint8_t raw[PF_LINK_RAW_MAX];
};

/* ---- link.c ---- */

/* A zeroed event at the end of the queue. */
pf_link_event *pf_link_push_event(pf_link *link, pf_link_event_type type);
/* Starts a frame of the current session in link->raw; the body follows at PF_LINK_HEADER. */
uint8_t *pf_link_frame(pf_link *link, pf_frame_type type);

static inline uint16_t pf_get16(const uint8_t *p)
{
    return (uint16_t)(p[0] | (uint32_t)p[1] << 8);
}
static inline uint32_t pf_get32(const uint8_t *p)
{
    return pf_get16(p) | (uint32_t)pf_get16(p + 2) << 16;
}
static inline uint64_t pf_get64(const uint8_t *p)
{
    return pf_get32(p) | (uint64_t)pf_get32(p + 4) << 32;
}

static inline void pf_put16(uint8_t *p, uint32_t v)
{
    p[0] = (uint8_t)v;
    p[1] = (uint8_t)(v >> 8);
}

static inline void pf_put32(uint8_t *p, uint32_t v)
{
    pf_put16(p, v);
    pf_put16(p + 2, v >> 16);
}

static inline void pf_put64(uint8_t *p, uint64_t v)
{
    pf_put32(p, (uint32_t)v);
    pf_put32(p + 4, (uint32_t)(v >> 32));
}

/* a is later than b, for counters that wrap. */
static inline bool pf_later(uint32_t a, uint32_t b)
{
    return a != b && a - b < 0x80000000u;
}
static inline bool pf_bit(const uint8_t *bits, uint32_t i)
{
    return ((uint32_t)bits[i / 8] & 1u << (i % 8)) != 0;
}
static inline void pf_bit_set(uint8_t *bits, uint32_t i)
{
    bits[i / 8] = (uint8_t)(bits[i / 8] | 1u << (i % 8));
}
static inline void pf_bit_clear(uint8_t *bits, uint32_t i)
{
    bits[i / 8] = (uint8_t)(bits[i / 8] & ~(1u << (i % 8)));
}
static inline uint64_t pf_min64(uint64_t a, uint64_t b)
{
    return a < b ? a : b;
}
static inline uint64_t pf_max64(uint64_t a, uint64_t b)
{
    return a > b ? a : b;
}

/* Fragments of n bytes; an empty message is one empty fragment. Exact for all n. */
static inline uint32_t pf_fragments(uint32_t n, uint32_t fragment)
{
    return n == 0 ? 1 : (n - 1) / fragment + 1;
}

/* Bytes of fragment i < pf_fragments(n, fragment). */
static inline uint32_t pf_fragment_size(uint32_t n, uint32_t fragment, uint32_t i)
{
    uint32_t rest = n - i * fragment;
    return rest < fragment ? rest : fragment;
}

/* ---- the rooms. _receive: an intact frame of the session without its checksum, size >= PF_LINK_HEADER; false if it
 * makes no sense. _build: returns the frame's size in link->raw without checksum; call it only when it is due. ---- */

bool pf_session_hello(pf_link *link, const uint8_t *frame, size_t size);
void pf_session_incompatible(pf_link *link, const uint8_t *frame, size_t size);
bool pf_session_ping(pf_link *link, const uint8_t *frame, size_t size);
bool pf_session_pong(pf_link *link, const uint8_t *frame, size_t size);
void pf_session_stale(pf_link *link);
void pf_session_down(pf_link *link);
/* All counters begin anew. While down. */
void pf_session_forget(pf_link *link);
void pf_session_tick(pf_link *link);
uint64_t pf_session_deadline(const pf_link *link);
uint64_t pf_session_due(const pf_link *link);
size_t pf_session_build(pf_link *link);
void pf_session_round_trip(pf_link *link, uint64_t rtt);
uint64_t pf_session_rto(const pf_link *link);

void pf_control_end(pf_link *link, bool new_peer);
bool pf_control_receive(pf_link *link, const uint8_t *frame, size_t size);
bool pf_control_receive_ack(pf_link *link, const uint8_t *frame, size_t size);
uint64_t pf_control_due(const pf_link *link);
size_t pf_control_build(pf_link *link);

void pf_latest_end(pf_link *link, bool new_peer);
bool pf_latest_receive(pf_link *link, const uint8_t *frame, size_t size);
bool pf_latest_ready(const pf_link *link);
size_t pf_latest_build(pf_link *link);

void pf_sender_end(pf_link *link, bool new_peer);
bool pf_sender_receive_ack(pf_link *link, const uint8_t *frame, size_t size);
void pf_sender_tick(pf_link *link);
uint64_t pf_sender_timeout(const pf_link *link);
uint64_t pf_sender_due(const pf_link *link);
size_t pf_sender_build(pf_link *link);
bool pf_sender_ready(const pf_link *link);
size_t pf_sender_build_data(pf_link *link);

void pf_receiver_end(pf_link *link, bool new_peer);
void pf_receiver_peer_reset(pf_link *link);
bool pf_receiver_offer(pf_link *link, const uint8_t *frame, size_t size);
bool pf_receiver_data(pf_link *link, const uint8_t *frame, size_t size);
bool pf_receiver_cancel(pf_link *link, const uint8_t *frame, size_t size);
uint64_t pf_receiver_due(const pf_link *link);
size_t pf_receiver_build(pf_link *link);

#endif
