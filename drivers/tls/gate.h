/* Who may try a handshake now: an address that failed too often has to wait. Pure bookkeeping; times are the caller's.
 */
#ifndef PIPEFISH_TLS_GATE_H
#define PIPEFISH_TLS_GATE_H

#include "common/listener.h"

#define PF_GATE_ADDRESSES 16u
#define PF_GATE_FAILURES  5u
#define PF_GATE_WINDOW_NS UINT64_C(60000000000)

typedef struct pf_gate_entry {
    uint8_t address[16]; /* as pf_gate_address has it */
    uint64_t since_ns;   /* of the first failure that counts */
    uint32_t failures;   /* 0 = free */
} pf_gate_entry;

typedef struct pf_gate {
    pf_gate_entry entry[PF_GATE_ADDRESSES];
} pf_gate;

/* What counts as one address of a peer that has reached our `own` one: IPv4, mapped; the first half of an IPv6 address,
 * which one subscriber has to himself, but the whole of one whose first half is ours, which all of our link share. */
void pf_gate_address(const pf_address *peer, const pf_address *own, uint8_t address[16]);

bool pf_gate_is_open(const pf_gate *gate, const uint8_t address[16], uint64_t now_ns);
void pf_gate_note_failure(pf_gate *gate, const uint8_t address[16], uint64_t now_ns);

#endif
