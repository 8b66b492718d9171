/* Whom a device lets in: its own key, and the keys of the hosts that it knows, each with a role. A key is named by the
 * SHA-256 of its public half (SubjectPublicKeyInfo, DER). A folder keeps both:
 *   device.pem  the device's private key (Ed25519) with a certificate that nobody but itself signed; mode 0600
 *   peers       one host a line, "role key name": viewer|operator|calibrator|revoked, 64 hexadecimal digits, a text
 * Certificates only carry keys: their dates and issuers mean nothing, for a crawler has no clock to trust.
 */
#ifndef PIPEFISH_DRIVERS_TRUST_H
#define PIPEFISH_DRIVERS_TRUST_H

#include "pipefish/drivers/transport.h"

#define PF_PEERS_MAX     64u
#define PF_PEER_NAME_MAX 48u    /* bytes, with the zero */
#define PF_PEERS_BYTES   16384u /* largest file */

typedef struct pf_peer {
    uint8_t key[32];
    pf_role role; /* PF_ROLE_REVOKED: never again */
    char name[PF_PEER_NAME_MAX];
} pf_peer;

typedef struct pf_peers {
    pf_peer peer[PF_PEERS_MAX];
    uint32_t count;
} pf_peers;

/* Parses any bytes at all. Empty lines and those that begin with # are left out. PF_OK; PF_ERR_FORMAT (a line is none,
 * or a key is there twice) and PF_ERR_SPACE (too many), *peers undefined: error[n] says which line. */
pf_status pf_peers_parse(pf_peers *peers, const char *text, size_t size, char *error, size_t n);

/* The text of it, zero at the end; `capacity` of PF_PEERS_BYTES is always enough. Returns its length. */
size_t pf_peers_print(const pf_peers *peers, char *text, size_t capacity);

/* NULL = nobody we know. */
const pf_peer *pf_peers_find(const pf_peers *peers, const uint8_t key[32]);

/* Lets a host in, or gives it another role or name. PF_ERR_ARGUMENT: no role, or a name that is empty, too long or has
 * control characters; PF_ERR_SPACE; PF_ERR_UNSUPPORTED: it was revoked, and a key that was lost stays lost. */
pf_status pf_peers_set(pf_peers *peers, const uint8_t key[32], pf_role role, const char *name);

pf_role pf_role_parse(const char *word, size_t n); /* PF_ROLE_NONE: no such role */
const char *pf_role_text(pf_role role);            /* "viewer"; "none" */

/* "1f0c..." of 64 digits, either case. */
bool pf_key_parse(const char *text, size_t n, uint8_t key[32]);
void pf_key_print(const uint8_t key[32], char text[65]);

typedef struct pf_trust pf_trust;

/* Opens a folder, makes it (mode 0700) and the device's key if they are not there. On failure *trust is untouched and
 * error[n] says what. PF_OK; PF_ERR_IO; PF_ERR_FORMAT (device.pem or peers is damaged); PF_ERR_UNSUPPORTED (others may
 * read the key, or write the folder or its file of hosts); PF_ERR_SPACE. */
pf_status pf_trust_open(pf_trust **trust, const char *folder, char *error, size_t n);
void pf_trust_close(pf_trust *trust); /* NULL is allowed */

/* What pf_trust_open would say of what is there; nothing is made. A folder that is not there can be, in one that is. */
pf_status pf_trust_check(const char *folder, char *error, size_t n);

/* The device's own key. */
const uint8_t *pf_trust_key(const pf_trust *trust);

/* What the file says now of a key: it is read again when it was changed. A file that has become unreadable lets nobody
 * in; error() says why. *name[PF_PEER_NAME_MAX] is filled for those known. */
pf_role pf_trust_role(pf_trust *trust, const uint8_t key[32], char *name);

/* pf_peers_set on the file: on the disk, whole or not at all, when it returns PF_OK. Also PF_ERR_IO, PF_ERR_FORMAT. */
pf_status pf_trust_set(pf_trust *trust, const uint8_t key[32], pf_role role, const char *name);

const char *pf_trust_error(const pf_trust *trust); /* last failure in words */

/* Listens with mutual TLS 1.3: only hosts whose key the trust knows get through. One host has the line, up to
 * PF_VISITORS_MAX others look on; the next has it when the first has gone or been silent for `silence_ms`, 3/8 of that
 * if it has the same key. Handshakes: at most 4 at once, 2 of one address, 5 s each, 1 s while others wait for the
 * place; an address that failed 5 times in a minute has to wait for the end of it. `trust` must outlive the transport.
 * Same results as pf_tcp_listen. */
typedef struct pf_tls_config {
    const char *address; /* numeric; "0.0.0.0", "::" = all */
    uint16_t port;       /* 0 = any */
    uint32_t silence_ms;
    pf_trust *trust;
} pf_tls_config;
pf_status pf_tls_listen(pf_transport *transport, const pf_tls_config *config, char *error, size_t n);

/* What pf_tls_listen would say of the address, without listening. PF_OK, PF_ERR_ARGUMENT. */
pf_status pf_tls_check(const pf_tls_config *config, char *error, size_t n);

#endif
