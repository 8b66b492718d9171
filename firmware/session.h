/* One connection to a host: its byte stream and the link that runs over it. The courier has one for the host that has
 * the device, and some for those that only look on. All calls come from the courier's thread.
 */
#ifndef PIPEFISHD_SESSION_H
#define PIPEFISHD_SESSION_H

#include "pipefish/drivers/transport.h"
#include "pipefish/link.h"

#define PF_SESSION_PEERS 8u

typedef struct pf_session {
    pf_transport transport; /* .ops NULL = nobody has this one */
    pf_link *link;
    void *workspace;                  /* of the link; NULL = not opened */
    bool has_stream;                  /* the transport is connected */
    uint32_t peers[PF_SESSION_PEERS]; /* nonces of the last hosts that had the link under its own, the newest first */
    bool has_restarted;               /* the newest, as it said when the link's own was drawn */
    bool is_visitor;                  /* it looks on: nothing that it asks for changes anything */
    uint8_t out[16384];               /* frames that the transport has not taken yet: out[out_at .. out_n) */
    size_t out_at, out_n;
} pf_session;

/* Makes the link, under a nonce of its own. PF_ERR_ARGUMENT: a setting is out of range; PF_ERR_SPACE. */
pf_status pf_session_open(pf_session *session, const pf_link_config *config);
void pf_session_close(pf_session *session); /* also one that was not opened; the transport is the caller's */

/* Where the link's events go. */
typedef void pf_session_take(void *context, pf_session *session, const pf_link_event *event, uint64_t now);

/* A host that comes back after another had the stream (a serial line has but one, whoever is behind it) is told another
 * nonce, and comes up once more before anybody hears of it: it would count from where it was, and get no answers. */
void pf_session_events(pf_session *session, pf_session_take *take, void *context, uint64_t now);

/* Another stream: half a frame is dropped, objects stay, all else begins anew, for it may be another host's. */
void pf_session_begin(pf_session *session, pf_session_take *take, void *context, uint64_t now);

/* The stream is over: likewise, but for what the link counts. */
void pf_session_reset(pf_session *session, pf_session_take *take, void *context, uint64_t now);

/* Reads what is there, some at a time lest output waits for ever. False: the stream broke. */
bool pf_session_read(pf_session *session, pf_session_take *take, void *context, uint64_t now);

/* Writes what fits; *is_full: the link may have more, which the line has no room for now. False: the stream broke. */
bool pf_session_write(pf_session *session, uint64_t now, bool *is_full);

#endif
