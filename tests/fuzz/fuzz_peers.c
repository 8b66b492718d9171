/* Invariants: any bytes are a table of hosts or refused with "line N: what"; a table that was read is printed and read
 * again without a change; nobody is in it twice, and nobody without a role and a name. */
#include "pipefish/drivers/trust.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    static pf_peers first, second;
    static char text[PF_PEERS_BYTES];
    char error[128] = "";
    if (pf_peers_parse(&first, (const char *)data, n, error, sizeof error) != PF_OK) {
        if (strncmp(error, "line ", 5) != 0)
            abort();
        return 0;
    }
    size_t size = pf_peers_print(&first, text, sizeof text);
    if (size >= sizeof text || pf_peers_parse(&second, text, size, error, sizeof error) != PF_OK ||
        memcmp(&first, &second, sizeof first) != 0)
        abort();
    for (uint32_t i = 0; i < first.count; i++) {
        const pf_peer *p = &first.peer[i];
        if (pf_peers_find(&first, p->key) != p || p->role < PF_ROLE_REVOKED || p->role > PF_ROLE_CALIBRATOR ||
            p->name[0] == '\0')
            abort();
    }
    return 0;
}
