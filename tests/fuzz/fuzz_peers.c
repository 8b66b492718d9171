/* Invariants: any bytes are a table of hosts or refused with "line N: what"; a table that was read is printed and read
 * again without a change; nobody is in it twice, and nobody without a role and a name; who is entered is found with his
 * role, and whom it revokes nothing but a revocation changes. */
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
    if (n < 34)
        return 0;
    const uint8_t *key = first.count > 0 && data[0] % 2 ? first.peer[data[0] / 2 % first.count].key : data + 2;
    const pf_peer *known = pf_peers_find(&first, key);
    bool was_revoked = known != NULL && known->role == PF_ROLE_REVOKED;
    pf_role role = (pf_role)(data[1] % (PF_ROLE_CALIBRATOR + 1));
    pf_status status = pf_peers_set(&first, key, role, "the host");
    const pf_peer *now = pf_peers_find(&first, key);
    if (status == PF_OK && (now == NULL || now->role != role || (was_revoked && role != PF_ROLE_REVOKED)))
        abort();
    if (status != PF_OK && (first.count != second.count || memcmp(&first, &second, sizeof first) != 0))
        abort();
    return 0;
}
