/* Mutual TLS 1.3 by OpenSSL. One epoll descriptor holds the listener, the guests whose handshake is under way, the host
 * that has the line, and the visitors that look on: it is what the daemon polls, and it becomes readable for all. */
#include "common/lines.h"
#include "pipefish/drivers/clock.h"
#include "tls/gate.h"
#include "trust/private.h"

#include <errno.h>
#include <openssl/err.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

#define GUESTS_MAX           4
#define GUESTS_OF_ADDRESS    2
#define HANDSHAKE_NS         UINT64_C(5000000000)
#define PATIENCE_NS          UINT64_C(1000000000) /* a handshake that lasts longer gives way to one that begins */
#define LEAVING_NS           UINT64_C(1000000000) /* for the peer to read why */
#define RECHECK_NS           UINT64_C(250000000)  /* between looks at the file of hosts */
#define CERTIFICATE_MAX      8192                 /* bytes of a peer's chain */
#define ACCEPTS_MAX          16                   /* of one call of service: the rest of the daemon waits */
#define FINGERPRINT_IN_ERROR 16                   /* digits */
/* What every host has. The others that OpenSSL offers, strangers could choose: ffdhe8192 takes a hundred times longer.
 */
#define GROUPS "X25519:P-256"

typedef struct guest {
    pf_line line; /* first: a transport's self */
    SSL *ssl;
    bool is_counted; /* among the refused, by its key */
    bool is_leaving; /* it was refused; what it still sends is thrown away until it closes */
    uint64_t deadline_ns;
    uint8_t address[16], key[32];
    pf_role role;
    char name[PF_PEER_NAME_MAX];
} guest;

typedef struct tls {
    pf_lines lines; /* first: what a line belongs to is a tls */
    SSL_CTX *context;
    pf_trust *trust;
    guest guests[GUESTS_MAX], host, visitors[PF_VISITORS_MAX];
    uint64_t recheck_ns;
    pf_gate gate;
    pf_transport_stats stats;
} tls;

static tls *owner(const guest *g)
{
    return (tls *)g->line.lines;
}

static guest nobody(tls *t)
{
    return (guest){.line = pf_line_empty(&t->lines)};
}

static void drop(guest *g)
{
    SSL_free(g->ssl);
    pf_line_drop(&g->line);
    *g = nobody(owner(g));
}

/* ---- who may come in */

/* OpenSSL asks this instead of looking for an issuer: the key alone counts. */
static int verify(X509_STORE_CTX *store, void *argument)
{
    tls *t = argument;
    SSL *ssl = X509_STORE_CTX_get_ex_data(store, SSL_get_ex_data_X509_STORE_CTX_idx());
    guest *g = SSL_get_app_data(ssl);
    X509 *certificate = X509_STORE_CTX_get0_cert(store);
    if (certificate == NULL || !pf_certificate_key(certificate, g->key))
        return 0;
    g->role = pf_trust_role(t->trust, g->key, g->name);
    if (g->role >= PF_ROLE_VIEWER)
        return 1;
    X509_STORE_CTX_set_error(store, g->role == PF_ROLE_REVOKED ? X509_V_ERR_CERT_REVOKED : X509_V_ERR_CERT_REJECTED);
    char key[65];
    pf_key_print(g->key, key);
    g->is_counted = true;
    if (g->role == PF_ROLE_REVOKED) {
        t->stats.refused_revoked++;
        (void)pf_fail(&t->lines.failure, PF_ERR_CLOSED, "a host whose key was revoked: %s (%.*s...)", g->name,
                      FINGERPRINT_IN_ERROR, key);
    } else {
        t->stats.refused_unknown++;
        (void)pf_fail(&t->lines.failure, PF_ERR_CLOSED, "a host that is not known: key %s", key);
    }
    return 0;
}

static pf_status open_context(tls *t)
{
    t->context = SSL_CTX_new(TLS_server_method());
    /* No tickets and no resumption: each session proves its key anew, and nothing that was recorded can be sent again.
     */
    bool ok = t->context != NULL && SSL_CTX_set_min_proto_version(t->context, TLS1_3_VERSION) == 1 &&
              SSL_CTX_set_max_proto_version(t->context, TLS1_3_VERSION) == 1 &&
              SSL_CTX_set1_groups_list(t->context, GROUPS) == 1 && SSL_CTX_set_num_tickets(t->context, 0) == 1 &&
              SSL_CTX_use_certificate(t->context, pf_trust_certificate(t->trust)) == 1 &&
              SSL_CTX_use_PrivateKey(t->context, pf_trust_private_key(t->trust)) == 1;
    if (!ok) {
        ERR_clear_error();
        return pf_fail(&t->lines.failure, PF_ERR_IO, "%s: OpenSSL gives no TLS 1.3", t->lines.name);
    }
    (void)SSL_CTX_set_session_cache_mode(t->context, SSL_SESS_CACHE_OFF);
    (void)SSL_CTX_set_options(t->context, SSL_OP_NO_TICKET | SSL_OP_NO_COMPRESSION);
    (void)SSL_CTX_set_mode(t->context, SSL_MODE_ENABLE_PARTIAL_WRITE | SSL_MODE_ACCEPT_MOVING_WRITE_BUFFER |
                                           SSL_MODE_RELEASE_BUFFERS);
    /* Else one call of SSL_read goes on for as long as a host sends new keys instead of data: nobody else is served. */
    (void)SSL_CTX_clear_mode(t->context, SSL_MODE_AUTO_RETRY);
    SSL_CTX_set_max_cert_list(t->context, CERTIFICATE_MAX);
    SSL_CTX_set_verify(t->context, SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, NULL);
    SSL_CTX_set_cert_verify_callback(t->context, verify, t);
    return PF_OK;
}

/* ---- guests */

/* Where all places are taken: that of the oldest, if it was sent away or has had its time. */
static guest *make_place(tls *t, uint64_t now)
{
    guest *oldest = NULL;
    for (int i = 0; i < GUESTS_MAX; i++)
        if (oldest == NULL || t->guests[i].deadline_ns < oldest->deadline_ns)
            oldest = &t->guests[i];
    if (!oldest->is_leaving) {
        if (now + HANDSHAKE_NS < oldest->deadline_ns + PATIENCE_NS)
            return NULL;
        t->stats.refused_late++;
        pf_gate_note_failure(&t->gate, oldest->address, now);
    }
    drop(oldest);
    return oldest;
}

static guest *free_place(tls *t, const uint8_t address[16], uint64_t now)
{
    guest *place = NULL;
    int same = 0;
    for (int i = 0; i < GUESTS_MAX; i++) {
        if (t->guests[i].line.fd < 0)
            place = &t->guests[i];
        else if (!t->guests[i].is_leaving && memcmp(t->guests[i].address, address, 16) == 0)
            same++;
    }
    if (same >= GUESTS_OF_ADDRESS)
        return NULL;
    return place != NULL ? place : make_place(t, now);
}

/* Takes those that wait. One for whom there is no place is closed at once: left waiting it would keep the listener
 * readable, and the daemon awake. */
static pf_status take_guests(tls *t, uint64_t now)
{
    for (int i = 0; i < ACCEPTS_MAX; i++) {
        pf_address peer, own;
        uint8_t address[16];
        int fd;
        pf_status status = pf_lines_accept(&t->lines, &peer, &fd, now);
        if (status != PF_OK)
            return status == PF_ERR_AGAIN ? PF_OK : status;
        memset(&own, 0, sizeof own);
        (void)getsockname(fd, &own.any, &(socklen_t){sizeof own});
        pf_gate_address(&peer, &own, address);
        guest *g = pf_gate_is_open(&t->gate, address, now) ? free_place(t, address, now) : NULL;
        SSL *ssl = g != NULL ? SSL_new(t->context) : NULL;
        if (ssl == NULL || SSL_set_fd(ssl, fd) != 1) {
            SSL_free(ssl);
            (void)close(fd);
            t->stats.refused_often++;
            (void)pf_fail(&t->lines.failure, PF_ERR_CLOSED,
                          "too many handshakes at once, or failed ones of one address");
            continue;
        }
        *g = nobody(t);
        g->line.fd = fd;
        g->ssl = ssl;
        g->deadline_ns = now + HANDSHAKE_NS;
        memcpy(g->address, address, sizeof g->address);
        SSL_set_accept_state(ssl);
        SSL_set_app_data(ssl, g);
        pf_line_watch(&g->line, EPOLLIN);
    }
    return PF_OK;
}

/* Says no more, but lets the peer read what was said: a close with bytes unread would destroy it on the way. */
static void send_away(guest *g, uint64_t now)
{
    (void)shutdown(g->line.fd, SHUT_WR);
    g->is_leaving = true;
    g->deadline_ns = now + LEAVING_NS;
    pf_line_watch(&g->line, EPOLLIN);
}

static void see_off(guest *g, uint64_t now)
{
    uint8_t bytes[4096];
    ssize_t k = recv(g->line.fd, bytes, sizeof bytes, 0);
    if (k == 0 || (k < 0 && errno != EAGAIN && errno != EINTR) || now >= g->deadline_ns)
        drop(g);
}

/* Whether the line is another's: of a host that is heard. One with the same key may be the same program that lost its
 * way, so it need not be silent for so long: while it is well it is heard every quarter of that time. */
static bool is_taken(const tls *t, const guest *g, uint64_t now)
{
    bool is_same = memcmp(t->host.key, g->key, 32) == 0;
    return t->host.line.fd >= 0 &&
           now - t->lines.heard_ns < (is_same ? t->lines.silence_ns * 3 / 8 : t->lines.silence_ns);
}

static void seat(guest *place, guest *g)
{
    drop(place);
    *place = *g;
    *g = nobody(owner(g));
    SSL_set_app_data(place->ssl, place);
}

/* A guest that has proved its key: it becomes the host, or looks on, or is told that there is no room for it. */
static bool welcome(tls *t, guest *g, uint64_t now)
{
    if (g->role > PF_ROLE_VIEWER && !is_taken(t, g, now)) {
        seat(&t->host, g);
        t->lines.heard_ns = now;
        t->stats.sessions++;
        return true;
    }
    pf_line *place = pf_lines_place(&t->lines);
    if (place != NULL) {
        seat((guest *)place, g);
        place->is_new = true;
        t->stats.sessions++;
        return false;
    }
    t->stats.refused_busy++;
    (void)pf_fail(&t->lines.failure, PF_ERR_CLOSED, "%s wanted to look on, as %u do already", g->name, PF_VISITORS_MAX);
    (void)SSL_shutdown(g->ssl);
    send_away(g, now);
    return false;
}

/* One step of a handshake. True: it became the host. */
static bool serve_guest(tls *t, guest *g, uint64_t now)
{
    if (g->is_leaving) {
        see_off(g, now);
        return false;
    }
    ERR_clear_error();
    int done = SSL_do_handshake(g->ssl);
    int why = done == 1 ? SSL_ERROR_NONE : SSL_get_error(g->ssl, done);
    if (why == SSL_ERROR_NONE)
        return welcome(t, g, now);
    if (why == SSL_ERROR_WANT_READ || why == SSL_ERROR_WANT_WRITE) {
        if (now < g->deadline_ns) {
            pf_line_watch(&g->line, why == SSL_ERROR_WANT_WRITE ? EPOLLIN | EPOLLOUT : EPOLLIN);
            return false;
        }
        t->stats.refused_late++;
        (void)pf_fail(&t->lines.failure, PF_ERR_CLOSED, "a handshake took longer than 5 s");
    } else if (!g->is_counted) {
        const char *reason = ERR_reason_error_string(ERR_peek_last_error());
        t->stats.refused_handshake++;
        (void)pf_fail(&t->lines.failure, PF_ERR_CLOSED, "a handshake failed: %s", reason != NULL ? reason : "closed");
    }
    ERR_clear_error();
    pf_gate_note_failure(&t->gate, g->address, now);
    send_away(g, now);
    return false;
}

/* ---- those that are there */

static pf_status hang_up(guest *g, const char *why)
{
    tls *t = owner(g);
    drop(g);
    return pf_fail(&t->lines.failure, PF_ERR_CLOSED, "%s", why);
}

/* A key that was revoked while its host is there ends the session. So does another role: what it may do is settled when
 * a session begins. */
static void recheck(guest *g)
{
    if (g->line.fd < 0 || pf_trust_role(owner(g)->trust, g->key, g->name) == g->role)
        return;
    (void)SSL_shutdown(g->ssl);
    (void)hang_up(g, "the host's role was changed");
}

static void recheck_all(tls *t, uint64_t now)
{
    if (now < t->recheck_ns)
        return;
    t->recheck_ns = now + RECHECK_NS;
    recheck(&t->host);
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        recheck(&t->visitors[i]);
}

/* Bytes that OpenSSL has already decrypted make no descriptor readable: the watch for room, which there nearly always
 * is, stands for them. */
static void rewatch(guest *g, bool is_full)
{
    pf_line_watch(&g->line, is_full || SSL_pending(g->ssl) > 0 ? EPOLLIN | EPOLLOUT : EPOLLIN);
}

/* What an SSL_read or SSL_write of `k` came to. True: it may be tried again later. */
static bool may_go_on(guest *g, int k, bool *is_full)
{
    int why = SSL_get_error(g->ssl, k);
    *is_full = why == SSL_ERROR_WANT_WRITE;
    return why == SSL_ERROR_WANT_READ || why == SSL_ERROR_WANT_WRITE;
}

static pf_status tls_read(void *self, uint8_t *bytes, size_t capacity, size_t *done)
{
    guest *g = self;
    bool is_full = false;
    *done = 0;
    if (g->line.fd < 0)
        return PF_ERR_CLOSED;
    if (capacity == 0)
        return PF_OK;
    ERR_clear_error();
    int k = SSL_read(g->ssl, bytes, capacity > 65536 ? 65536 : (int)capacity);
    if (k > 0)
        *done = (size_t)k;
    else if (!may_go_on(g, k, &is_full))
        return hang_up(g, "the other side closed the connection");
    rewatch(g, is_full);
    return PF_OK;
}

static pf_status tls_write(void *self, const uint8_t *bytes, size_t n, size_t *done)
{
    guest *g = self;
    bool is_full = false;
    *done = 0;
    if (g->line.fd < 0)
        return PF_ERR_CLOSED;
    if (n == 0)
        return PF_OK;
    ERR_clear_error();
    int k = SSL_write(g->ssl, bytes, n > 65536 ? 65536 : (int)n);
    if (k > 0)
        *done = (size_t)k;
    else if (!may_go_on(g, k, &is_full))
        return hang_up(g, "the connection broke");
    rewatch(g, is_full);
    return PF_OK;
}

/* ---- the interface */

static pf_status tls_service(void *self, bool *fresh)
{
    guest *g = self;
    tls *t = owner(g);
    uint64_t now = pf_now();
    *fresh = false;
    if (g != &t->host)
        return g->line.fd >= 0 ? PF_OK : PF_ERR_CLOSED;
    pf_status status = take_guests(t, now);
    for (int i = 0; i < GUESTS_MAX; i++)
        if (t->guests[i].line.fd >= 0 && serve_guest(t, &t->guests[i], now))
            *fresh = true;
    recheck_all(t, now);
    if (t->host.line.fd >= 0)
        return PF_OK;
    *fresh = false;
    return status == PF_OK ? PF_ERR_AGAIN : status;
}

static pf_role tls_peer(void *self, const char **name, const pf_transport_stats **stats)
{
    guest *g = self;
    *stats = &owner(g)->stats;
    *name = g->name;
    return g->role;
}

static void leave(guest *g)
{
    if (g->line.fd >= 0)
        (void)SSL_shutdown(g->ssl);
    drop(g);
}

static void tls_close(void *self)
{
    guest *g = self;
    tls *t = owner(g);
    leave(g);
    if (g != &t->host)
        return;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++)
        leave(&t->visitors[i]);
    for (int i = 0; i < GUESTS_MAX; i++)
        drop(&t->guests[i]);
    pf_lines_close(&t->lines);
    SSL_CTX_free(t->context);
    free(t);
}

static const pf_transport_ops tls_ops = {
    .fd = pf_line_fd,
    .service = tls_service,
    .visitor = pf_line_visitor,
    .read = tls_read,
    .write = tls_write,
    .heard = pf_line_heard,
    .room = pf_line_room,
    .peer = tls_peer,
    .name = pf_line_name,
    .error = pf_line_error,
    .close = tls_close,
};

pf_status pf_tls_check(const pf_tls_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    pf_address a;
    return pf_failure_copy(&failure, pf_address_parse(&a, config->address, config->port, "tls", &failure), error, n);
}

pf_status pf_tls_listen(pf_transport *transport, const pf_tls_config *config, char *error, size_t n)
{
    pf_failure failure = {""};
    tls *t = calloc(1, sizeof *t);
    if (t == NULL)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "tls: no memory"), error, n);
    t->lines = (pf_lines){.epoll = -1,
                          .listener = -1,
                          .host = &t->host.line,
                          .ops = &tls_ops,
                          .silence_ns = config->silence_ms * UINT64_C(1000000)};
    t->host = nobody(t);
    for (int i = 0; i < GUESTS_MAX; i++)
        t->guests[i] = t->host;
    for (uint32_t i = 0; i < PF_VISITORS_MAX; i++) {
        t->visitors[i] = t->host;
        t->lines.visitors[i] = &t->visitors[i].line;
    }
    t->trust = config->trust;
    pf_address a;
    pf_status status = pf_address_parse(&a, config->address, config->port, "tls", &t->lines.failure);
    if (status == PF_OK)
        status = pf_lines_open(&t->lines, &a, config->address, "tls");
    if (status == PF_OK)
        status = open_context(t);
    if (status != PF_OK) {
        pf_failure_copy(&t->lines.failure, status, error, n);
        tls_close(&t->host);
        return status;
    }
    transport->self = &t->host.line;
    transport->ops = &tls_ops;
    return PF_OK;
}
