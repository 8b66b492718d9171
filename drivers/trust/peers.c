/* The hosts that a device knows, as a table and as a text. */
#include "pipefish/drivers/trust.h"

#include <stdio.h>
#include <string.h>

static const char *const roles[] = {
    [PF_ROLE_NONE] = "none",         [PF_ROLE_REVOKED] = "revoked",       [PF_ROLE_VIEWER] = "viewer",
    [PF_ROLE_OPERATOR] = "operator", [PF_ROLE_CALIBRATOR] = "calibrator",
};

pf_role pf_role_parse(const char *word, size_t n)
{
    for (int i = PF_ROLE_REVOKED; i <= PF_ROLE_CALIBRATOR; i++)
        if (strlen(roles[i]) == n && memcmp(roles[i], word, n) == 0)
            return (pf_role)i;
    return PF_ROLE_NONE;
}

const char *pf_role_text(pf_role role)
{
    return roles[role];
}

static int digit(char c)
{
    if (c >= '0' && c <= '9')
        return c - '0';
    if (c >= 'a' && c <= 'f')
        return c - 'a' + 10;
    return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

bool pf_key_parse(const char *text, size_t n, uint8_t key[32])
{
    if (n != 64)
        return false;
    for (size_t i = 0; i < 32; i++) {
        int high = digit(text[2 * i]), low = digit(text[2 * i + 1]);
        if (high < 0 || low < 0)
            return false;
        key[i] = (uint8_t)(high * 16 + low);
    }
    return true;
}

void pf_key_print(const uint8_t key[32], char text[65])
{
    for (size_t i = 0; i < 32; i++)
        (void)snprintf(text + 2 * i, 3, "%02x", key[i]);
}

/* A name stands in a line of its own, in a log and in a status: no control characters, no blanks around it. */
static bool is_name(const char *name, size_t n)
{
    if (n == 0 || n >= PF_PEER_NAME_MAX || name[0] == ' ' || name[n - 1] == ' ')
        return false;
    for (size_t i = 0; i < n; i++)
        if (name[i] < 0x20 || name[i] > 0x7e)
            return false;
    return true;
}

const pf_peer *pf_peers_find(const pf_peers *peers, const uint8_t key[32])
{
    for (uint32_t i = 0; i < peers->count; i++)
        if (memcmp(peers->peer[i].key, key, 32) == 0)
            return &peers->peer[i];
    return NULL;
}

pf_status pf_peers_set(pf_peers *peers, const uint8_t key[32], pf_role role, const char *name)
{
    const pf_peer *known = pf_peers_find(peers, key);
    uint32_t at = known != NULL ? (uint32_t)(known - peers->peer) : peers->count;
    if (role <= PF_ROLE_NONE || role > PF_ROLE_CALIBRATOR || !is_name(name, strlen(name)))
        return PF_ERR_ARGUMENT;
    if (known != NULL && known->role == PF_ROLE_REVOKED && role != PF_ROLE_REVOKED)
        return PF_ERR_UNSUPPORTED;
    if (at == PF_PEERS_MAX)
        return PF_ERR_SPACE;
    if (at == peers->count)
        peers->count++;
    pf_peer *p = &peers->peer[at];
    memcpy(p->key, key, 32);
    p->role = role;
    (void)snprintf(p->name, sizeof p->name, "%s", name);
    return PF_OK;
}

/* One line without its end; NULL, or what is wrong with it. */
static const char *take_line(pf_peers *peers, const char *line, size_t n)
{
    const char *end = line + n, *role_end = memchr(line, ' ', n);
    if (role_end == NULL)
        return "must be \"role key name\"";
    pf_role role = pf_role_parse(line, (size_t)(role_end - line));
    if (role == PF_ROLE_NONE)
        return "the role must be viewer, operator, calibrator or revoked";
    const char *key = role_end + 1, *key_end = memchr(key, ' ', (size_t)(end - key));
    pf_peer p = {.role = role};
    if (key_end == NULL || !pf_key_parse(key, (size_t)(key_end - key), p.key))
        return "the key must be 64 hexadecimal digits, a name after it";
    if (!is_name(key_end + 1, (size_t)(end - key_end - 1)))
        return "the name must be 1 to 47 printable ASCII characters";
    if (pf_peers_find(peers, p.key) != NULL)
        return "this key is there already";
    if (peers->count == PF_PEERS_MAX)
        return "";
    memcpy(p.name, key_end + 1, (size_t)(end - key_end - 1));
    peers->peer[peers->count++] = p;
    return NULL;
}

pf_status pf_peers_parse(pf_peers *peers, const char *text, size_t size, char *error, size_t n)
{
    const char *end = text + size;
    unsigned line = 0;
    memset(peers, 0, sizeof *peers);
    while (text < end) {
        const char *stop = memchr(text, '\n', (size_t)(end - text));
        const char *next = stop != NULL ? stop + 1 : end;
        size_t length = (size_t)((stop != NULL ? stop : end) - text);
        const char *why = length == 0 || text[0] == '#' ? NULL : take_line(peers, text, length);
        line++;
        if (why != NULL) {
            bool is_full = why[0] == '\0';
            if (is_full)
                (void)snprintf(error, n, "line %u: more than %u hosts", line, PF_PEERS_MAX);
            else
                (void)snprintf(error, n, "line %u: %s", line, why);
            return is_full ? PF_ERR_SPACE : PF_ERR_FORMAT;
        }
        text = next;
    }
    return PF_OK;
}

size_t pf_peers_print(const pf_peers *peers, char *text, size_t capacity)
{
    size_t at = 0;
    if (capacity > 0)
        text[0] = '\0';
    for (uint32_t i = 0; i < peers->count && at < capacity; i++) {
        char key[65];
        pf_key_print(peers->peer[i].key, key);
        at += (size_t)snprintf(text + at, capacity - at, "%s %s %s\n", roles[peers->peer[i].role], key,
                               peers->peer[i].name);
    }
    return at;
}
