/* The link between crawler and host: framing, acknowledged delivery, flow control. Sans-IO: it consumes and produces
 * bytes and takes the time as an argument; the same code runs in the daemon, the host client, the tests and the
 * fuzzers. lib/link/SPEC.md describes every byte.
 *
 * Three priorities:
 *   control  small messages, reliable, in order, exactly once in a session (requests, replies)
 *   latest   previews and counters by topic: a newer one replaces an older one, nothing is repeated
 *   bulk     objects named by their SHA-256: selective repeat, resumed after any interruption, and released by the
 * sender only when the receiver says that it has stored the object durably Both ends are equal: either may send any of
 * the three.
 *
 * The caller's loop, for each chunk of bytes read:      and whenever the line can take bytes:
 *   while (n) {                                           n = pf_link_output(link, buffer, sizeof buffer, now);
 *       k = pf_link_input(link, bytes, n, now);           write(buffer, n)
 *       bytes += k; n -= k;
 *       while (pf_link_next_event(link, &event)) ...
 *   }
 */
#ifndef PIPEFISH_LINK_H
#define PIPEFISH_LINK_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_LINK_VERSION      1u    /* of the wire format */
#define PF_LINK_FRAGMENT_MAX 1024u /* one fragment is 11.4 ms at 921600 baud: what control waits for at most */
#define PF_LINK_FRAME_MAX    1072u /* most bytes of one frame on the wire: header, fragment, checksum, COBS, delimiter */
#define PF_LINK_NAME_SIZE    32u
#define PF_LINK_SLOTS_MAX    16u
#define PF_LINK_TOPICS       8u

typedef enum pf_link_role { PF_LINK_DEVICE = 1, PF_LINK_HOST = 2 } pf_link_role;

/* What a bulk object is; the payload is a message of pipefish.proto. */
typedef enum pf_object_kind {
    PF_OBJECT_SURVEY_START = 1,
    PF_OBJECT_KEYFRAME = 2,
    PF_OBJECT_SURVEY_END = 3,
    PF_OBJECT_PROFILE = 4,   /* profile binary */
    PF_OBJECT_RAW_FRAME = 5, /* one uncompressed or lossless frame, for calibration */
} pf_object_kind;

typedef enum pf_topic {
    PF_TOPIC_STATUS = 0,
    PF_TOPIC_PREVIEW = 1,
    PF_TOPIC_TRACKS = 2,
    PF_TOPIC_TELEMETRY = 3
} pf_topic;

/* Zero means the default in brackets. */
typedef struct pf_link_config {
    uint32_t role;         /* pf_link_role, required */
    uint32_t nonce;        /* required, not 0: random for each start of this end, tells a restart from a reconnection */
    uint64_t boot_id;      /* of this end; 0 = does not matter (host) */
    uint32_t schema;       /* version of pipefish.proto that this end speaks */
    uint32_t max_fragment; /* 64..1024 bytes [1024]; the smaller of both ends is used */
    uint32_t send_slots;   /* objects under way at once, 1..16 [4] */
    uint32_t receive_slots; /* objects being received at once, 1..16 [4]; 0 with max_object = 0: receives none, and
                               the peer keeps what it has to send for another session */
    uint32_t max_object;    /* most bytes of a received object [0: receives none] */
    uint32_t max_latest;    /* most bytes of a latest message, sent or received [16384] */
    uint32_t max_control;   /* most bytes of a control message, 16..1000 [512] */
    uint32_t control_queue; /* control messages that wait to be sent, 1..64 [8] */
    uint32_t window;        /* most unacknowledged bulk bytes on the wire [65536] */
    uint32_t keepalive_ms;  /* ping interval [1000]; the peer counts as gone after 4 of them in silence */
    uint32_t rto_min_ms;    /* least retransmission timeout [50] */
} pf_link_config;

typedef struct pf_link_stats {    /* since init; never reset */
    uint64_t bytes_in, bytes_out; /* on the wire */
    uint64_t frames_in, frames_out;
    uint64_t crc_errors; /* frames whose checksum or COBS coding was wrong */
    uint64_t malformed;  /* intact frames that make no sense: wrong length, unknown type, out of range */
    uint64_t stale;      /* frames of an earlier session, or of an object that is done */
    /* sent counts repetitions too; duplicate: received, but not needed */
    uint64_t fragments_sent, fragments_resent, fragments_received, fragments_duplicate;
    uint64_t objects_sent, objects_received; /* durably acknowledged / handed to the caller */
    uint64_t object_bytes_sent, object_bytes_received;
    uint64_t control_sent, control_resent, control_received;
    uint64_t latest_sent, latest_replaced, latest_received, latest_incomplete;
    uint64_t sessions;            /* times the peer came up */
    uint32_t rtt_us;              /* smoothed; 0 = not measured yet */
    int64_t peer_clock_offset_ns; /* peer's clock minus ours, from the ping with the least round trip */
    uint64_t peer_clock_error_ns; /* half of that round trip; UINT64_MAX = not measured yet */
} pf_link_stats;

typedef enum pf_link_event_type {
    PF_LINK_UP = 1,           /* the peer answers; .peer_* are valid. Comes again when the peer has restarted */
    PF_LINK_DOWN = 2,         /* silence for 4 keepalives, or pf_link_reset */
    PF_LINK_INCOMPATIBLE = 3, /* the peer speaks another version: .peer_version */
    PF_LINK_CONTROL = 4,      /* .data, .size */
    PF_LINK_LATEST = 5,       /* .topic, .data, .size */
    PF_LINK_OFFER = 6,        /* peer wants to send .name .kind .size: answer with pf_link_answer_object(.slot) */
    PF_LINK_OBJECT = 7,       /* all bytes are here: .slot .name .kind .data .size. Check the name against the bytes,
                                 store durably, then pf_link_answer_object(.slot). .data stays valid until then */
    PF_LINK_SENT = 8,         /* peer has .name durably; its memory is yours again */
    PF_LINK_REFUSED = 9,      /* peer will never take .name (too large, wrong kind); its memory is yours again */
} pf_link_event_type;

typedef struct pf_link_event {
    uint32_t type; /* pf_link_event_type: says which of the others are valid */
    uint32_t slot, kind, topic, size;
    const uint8_t *data; /* except for PF_LINK_OBJECT: valid until the next call of any pf_link_ function */
    uint8_t name[PF_LINK_NAME_SIZE];
    uint32_t peer_role, peer_version, peer_schema, peer_nonce;
    uint64_t peer_boot_id;
    bool peer_restarted; /* PF_LINK_UP: another nonce than at the last PF_LINK_UP, and not the same boot */
} pf_link_event;

typedef struct pf_link pf_link; /* opaque, in the caller's workspace */

size_t pf_link_workspace_size(const pf_link_config *config); /* 0 if out of range */
pf_status pf_link_init(pf_link **link, const pf_link_config *config, void *workspace, size_t size);

/* The byte stream broke (cable out, TCP reconnected): drop half a frame and say hello again. Objects stay and resume.
 */
void pf_link_reset(pf_link *link, uint64_t now_ns);

/* As pf_link_reset, and under another nonce (not 0): for an end that has several links, or several peers in turn. What
 * one end counted on in its last session with us the other may have forgotten since; under a new nonce both begin anew.
 */
void pf_link_renew(pf_link *link, uint32_t nonce, uint64_t now_ns);

/* Consumes bytes; returns how many, fewer than n when an event waits to be taken. Any bytes at all are safe. Once all
 * are consumed a peer that was silent for too long counts as gone; bytes NULL and n 0 do only that, and must be called
 * when pf_link_output is not, because the line takes nothing. */
size_t pf_link_input(pf_link *link, const uint8_t *bytes, size_t n, uint64_t now_ns);

/* Takes the next event; false when there is none. */
bool pf_link_next_event(pf_link *link, pf_link_event *event);

/* Writes whole frames, most urgent first, as many as fit; 0 = nothing to send now. capacity >= PF_LINK_FRAME_MAX.
 * Give it no more room than the line takes in a few milliseconds: what is written can no longer be overtaken. */
size_t pf_link_output(pf_link *link, uint8_t *out, size_t capacity, uint64_t now_ns);

/* When to call pf_link_output (and next_event) again at the latest if nothing is read or sent; absolute, same clock. */
uint64_t pf_link_deadline(const pf_link *link, uint64_t now_ns);

/* Queues one control message (copied). PF_ERR_SPACE: the queue is full, try when it drained; PF_ERR_CLOSED: no peer;
 * PF_ERR_ARGUMENT: too large. A message queued when the session ends is dropped: the caller sees PF_LINK_DOWN or UP. */
pf_status pf_link_send_control(pf_link *link, const void *bytes, size_t n);

/* Replaces what waits under this topic (copied). PF_ERR_CLOSED: no peer (nothing kept); PF_ERR_ARGUMENT: too large. */
pf_status pf_link_send_latest(pf_link *link, uint32_t topic, const void *bytes, size_t n);

/* Starts an object; `bytes` is borrowed until PF_LINK_SENT or PF_LINK_REFUSED names it or pf_link_cancel_object.
 * Works without a peer: it is offered when one comes. PF_ERR_SPACE: all send slots are taken; PF_ERR_ARGUMENT: empty,
 * or the name is under way already. */
pf_status pf_link_send_object(pf_link *link, const uint8_t name[PF_LINK_NAME_SIZE], uint32_t kind, const void *bytes,
                              size_t n);
pf_status pf_link_cancel_object(pf_link *link, const uint8_t name[PF_LINK_NAME_SIZE]);
uint32_t pf_link_free_send_slots(const pf_link *link);

typedef enum pf_link_answer {
    PF_ANSWER_ACCEPT = 1, /* offer: send it */
    PF_ANSWER_STORED = 2, /* offer or object: I have it durably */
    PF_ANSWER_REFUSE = 3, /* offer or object: never */
    PF_ANSWER_AGAIN = 4,  /* object: the bytes do not match the name; send all of it again */
} pf_link_answer;

/* Answers PF_LINK_OFFER or PF_LINK_OBJECT. A question stays open, and is not asked again, whatever happens to the
 * session or the line: it must be answered once. PF_ERR_ARGUMENT: no such question is open, or not with this answer. */
pf_status pf_link_answer_object(pf_link *link, uint32_t slot, pf_link_answer answer);

const pf_link_stats *pf_link_get_stats(const pf_link *link);
bool pf_link_is_up(const pf_link *link);

/* COBS of n bytes without the delimiter. out needs n + n / 254 + 1 bytes; returns the bytes written. */
size_t pf_cobs_encode(const uint8_t *bytes, size_t n, uint8_t *out);
/* In: one frame without its delimiter. Returns PF_OK and *n_out, or PF_ERR_FORMAT. in == out is allowed. */
pf_status pf_cobs_decode(const uint8_t *bytes, size_t n, uint8_t *out, size_t *n_out);

#ifdef __cplusplus
}
#endif
#endif
