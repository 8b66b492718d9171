#include "tls/gate.h"

#include <string.h>

void pf_gate_address(const pf_address *peer, const pf_address *own, uint8_t address[16])
{
    memset(address, 0, 16);
    if (peer->any.sa_family == AF_INET) {
        address[10] = address[11] = 0xff;
        memcpy(address + 12, &peer->v4.sin_addr, 4);
    } else if (IN6_IS_ADDR_V4MAPPED(&peer->v6.sin6_addr) || memcmp(&peer->v6.sin6_addr, &own->v6.sin6_addr, 8) == 0) {
        memcpy(address, &peer->v6.sin6_addr, 16);
    } else {
        memcpy(address, &peer->v6.sin6_addr, 8);
    }
}

static bool is_over(const pf_gate_entry *e, uint64_t now_ns)
{
    return e->failures == 0 || now_ns - e->since_ns >= PF_GATE_WINDOW_NS;
}

bool pf_gate_is_open(const pf_gate *gate, const uint8_t address[16], uint64_t now_ns)
{
    for (size_t i = 0; i < PF_GATE_ADDRESSES; i++) {
        const pf_gate_entry *e = &gate->entry[i];
        if (!is_over(e, now_ns) && memcmp(e->address, address, 16) == 0)
            return e->failures < PF_GATE_FAILURES;
    }
    return true;
}

void pf_gate_note_failure(pf_gate *gate, const uint8_t address[16], uint64_t now_ns)
{
    pf_gate_entry *free_one = NULL, *mildest = &gate->entry[0];
    for (size_t i = 0; i < PF_GATE_ADDRESSES; i++) {
        pf_gate_entry *e = &gate->entry[i];
        if (is_over(e, now_ns)) {
            e->failures = 0;
            free_one = e;
        } else if (memcmp(e->address, address, 16) == 0) {
            e->failures++;
            return;
        }
        /* Without a free place the one with the fewest failures goes: who floods from many addresses must not wash out
         * those that are shut. */
        if (e->failures < mildest->failures || (e->failures == mildest->failures && e->since_ns < mildest->since_ns))
            mildest = e;
    }
    pf_gate_entry *e = free_one != NULL ? free_one : mildest;
    memcpy(e->address, address, 16);
    e->since_ns = now_ns;
    e->failures = 1;
}
