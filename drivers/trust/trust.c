/* The folder that keeps the device's key and the hosts it knows. */
#include "common/failure.h"
#include "pipefish/drivers/file.h"
#include "pipefish/drivers/sha256.h"
#include "trust/private.h"

#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/rand.h>
#include <openssl/x509v3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#define PATH_BYTES 4096

struct pf_trust {
    char *folder;
    EVP_PKEY *private_key;
    X509 *certificate;
    uint8_t key[32];
    pf_peers peers;
    bool has_peers;         /* what was last read could be read */
    struct stat peers_stat; /* of the file when it was; all zero: there was none */
    pf_failure failure;
};

static void path_of(const pf_trust *t, const char *file, char path[PATH_BYTES])
{
    (void)snprintf(path, PATH_BYTES, "%s/%s", t->folder, file);
}

static pf_status fail_errno(pf_trust *t, const char *path, const char *doing)
{
    return pf_fail(&t->failure, PF_ERR_IO, "%s: %s: %s", path, doing, strerror(errno));
}

static pf_status fail_crypto(pf_trust *t, const char *doing)
{
    char why[160];
    ERR_error_string_n(ERR_peek_last_error(), why, sizeof why);
    ERR_clear_error();
    return pf_fail(&t->failure, PF_ERR_IO, "%s: %s: %s", t->folder, doing, why);
}

static pf_status replace_file(pf_trust *t, const char *file, const char *bytes, size_t n)
{
    char path[PATH_BYTES], why[sizeof t->failure.text];
    path_of(t, file, path);
    if (pf_file_replace(path, bytes, n, why, sizeof why) != PF_OK)
        return pf_fail(&t->failure, PF_ERR_IO, "%s", why);
    return PF_OK;
}

/* The daemon and `pipefishd --pair` change the folder one after the other; closing the descriptor unlocks it. */
static pf_status lock_folder(pf_trust *t, int *fd)
{
    *fd = open(t->folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    int locked = -1;
    while (*fd >= 0 && (locked = flock(*fd, LOCK_EX)) != 0 && errno == EINTR) {
    }
    if (locked == 0)
        return PF_OK;
    pf_status status = fail_errno(t, t->folder, "locking");
    if (*fd >= 0)
        (void)close(*fd);
    return status;
}

/* ---- the device's key */

bool pf_certificate_key(X509 *certificate, uint8_t key[32])
{
    uint8_t *der = NULL;
    int n = i2d_X509_PUBKEY(X509_get_X509_PUBKEY(certificate), &der);
    bool ok = n > 0 && pf_sha256(der, (size_t)n, key) == PF_OK;
    OPENSSL_free(der);
    return ok;
}

/* A certificate that only carries the key: valid from 1970 for ever (RFC 5280's date for "no end"). */
static X509 *self_sign(EVP_PKEY *key)
{
    X509 *c = X509_new();
    X509_NAME *name = X509_NAME_new();
    uint8_t serial[8] = {0};
    BIGNUM *number = NULL;
    bool ok = c != NULL && name != NULL && RAND_bytes(serial, sizeof serial) == 1;
    serial[0] &= 0x7f;
    serial[7] |= 1;
    ok = ok && (number = BN_bin2bn(serial, sizeof serial, NULL)) != NULL &&
         BN_to_ASN1_INTEGER(number, X509_get_serialNumber(c)) != NULL && X509_set_version(c, 2) == 1 &&
         X509_NAME_add_entry_by_txt(name, "CN", MBSTRING_ASC, (const unsigned char *)"pipefish device", -1, -1, 0) ==
             1 &&
         X509_set_subject_name(c, name) == 1 && X509_set_issuer_name(c, name) == 1 &&
         ASN1_TIME_set_string_X509(X509_getm_notBefore(c), "19700101000000Z") == 1 &&
         ASN1_TIME_set_string_X509(X509_getm_notAfter(c), "99991231235959Z") == 1 && X509_set_pubkey(c, key) == 1 &&
         X509_sign(c, key, NULL) > 0;
    BN_free(number);
    X509_NAME_free(name);
    if (!ok) {
        X509_free(c);
        c = NULL;
    }
    return c;
}

static pf_status make_identity(pf_trust *t)
{
    BIO *memory = BIO_new(BIO_s_mem());
    char *text = NULL;
    pf_status status = PF_OK;
    t->private_key = EVP_PKEY_Q_keygen(NULL, NULL, "ED25519");
    t->certificate = t->private_key != NULL ? self_sign(t->private_key) : NULL;
    if (memory == NULL || t->certificate == NULL ||
        PEM_write_bio_PrivateKey(memory, t->private_key, NULL, NULL, 0, NULL, NULL) != 1 ||
        PEM_write_bio_X509(memory, t->certificate) != 1)
        status = fail_crypto(t, "making the device's key");
    if (status == PF_OK) {
        long n = BIO_get_mem_data(memory, &text);
        status = replace_file(t, "device.pem", text, (size_t)n);
    }
    BIO_free(memory);
    return status;
}

/* PF_ERR_END: there is none. */
static pf_status load_identity(pf_trust *t)
{
    char path[PATH_BYTES];
    struct stat s;
    path_of(t, "device.pem", path);
    FILE *in = fopen(path, "rbe");
    if (in == NULL)
        return errno == ENOENT ? PF_ERR_END : fail_errno(t, path, "opening");
    pf_status status = fstat(fileno(in), &s) == 0 ? PF_OK : fail_errno(t, path, "opening");
    if (status == PF_OK && (s.st_mode & 077) != 0)
        status = pf_fail(&t->failure, PF_ERR_UNSUPPORTED,
                         "%s: others may read this private key: make a new one, or chmod 600 if you trust them", path);
    if (status == PF_OK) {
        t->private_key = PEM_read_PrivateKey(in, NULL, NULL, (void *)"");
        t->certificate = PEM_read_X509(in, NULL, NULL, (void *)"");
        if (t->private_key == NULL || t->certificate == NULL ||
            X509_check_private_key(t->certificate, t->private_key) != 1)
            status = pf_fail(&t->failure, PF_ERR_FORMAT, "%s: no private key with its certificate", path);
        ERR_clear_error();
    }
    (void)fclose(in);
    return status;
}

static pf_status open_identity(pf_trust *t)
{
    int lock;
    pf_status status = load_identity(t);
    if (status != PF_ERR_END)
        return status;
    status = lock_folder(t, &lock);
    if (status != PF_OK)
        return status;
    status = load_identity(t); /* who had the lock before may have made it */
    if (status == PF_ERR_END)
        status = make_identity(t);
    (void)close(lock);
    return status;
}

/* ---- the hosts */

static pf_status read_peers(pf_trust *t, const char *path)
{
    char text[PF_PEERS_BYTES + 1], why[128];
    FILE *in = fopen(path, "rbe");
    if (in == NULL)
        return fail_errno(t, path, "opening");
    /* The stamp first: what is changed behind it is read again at the next look. */
    bool is_read = fstat(fileno(in), &t->peers_stat) == 0;
    size_t n = fread(text, 1, sizeof text, in);
    is_read = is_read && ferror(in) == 0;
    (void)fclose(in);
    if (!is_read)
        return fail_errno(t, path, "reading");
    if ((t->peers_stat.st_mode & S_IWOTH) != 0)
        return pf_fail(&t->failure, PF_ERR_UNSUPPORTED, "%s: anybody may write this file: look at it, then chmod o-w",
                       path);
    if (n > PF_PEERS_BYTES)
        return pf_fail(&t->failure, PF_ERR_SPACE, "%s: larger than %u bytes", path, PF_PEERS_BYTES);
    pf_status status = pf_peers_parse(&t->peers, text, n, why, sizeof why);
    return status == PF_OK ? PF_OK : pf_fail(&t->failure, status, "%s: %s", path, why);
}

/* Reads the file if it is not the one that was read last. */
static pf_status refresh(pf_trust *t)
{
    char path[PATH_BYTES];
    struct stat s;
    path_of(t, "peers", path);
    if (stat(path, &s) != 0) {
        t->has_peers = false;
        if (errno != ENOENT)
            return fail_errno(t, path, "reading");
        t->has_peers = true;
        memset(&t->peers, 0, sizeof t->peers);
        memset(&t->peers_stat, 0, sizeof t->peers_stat);
        return PF_OK;
    }
    if (t->has_peers && s.st_ino == t->peers_stat.st_ino && s.st_size == t->peers_stat.st_size &&
        s.st_mtim.tv_sec == t->peers_stat.st_mtim.tv_sec && s.st_mtim.tv_nsec == t->peers_stat.st_mtim.tv_nsec)
        return PF_OK;
    pf_status status = read_peers(t, path);
    t->has_peers = status == PF_OK;
    return status;
}

pf_role pf_trust_role(pf_trust *trust, const uint8_t key[32], char *name)
{
    if (refresh(trust) != PF_OK)
        return PF_ROLE_NONE;
    const pf_peer *p = pf_peers_find(&trust->peers, key);
    if (p == NULL)
        return PF_ROLE_NONE;
    memcpy(name, p->name, sizeof p->name);
    return p->role;
}

static pf_status change_peers(pf_trust *trust, const uint8_t key[32], pf_role role, const char *name)
{
    char text[PF_PEERS_BYTES];
    trust->has_peers = false; /* what is there now, whatever its stamp says */
    pf_status status = refresh(trust);
    if (status != PF_OK)
        return status;
    pf_peers changed = trust->peers;
    status = pf_peers_set(&changed, key, role, name);
    if (status == PF_ERR_SPACE)
        return pf_fail(&trust->failure, status, "%s: knows %u hosts, which is the most", trust->folder, PF_PEERS_MAX);
    if (status == PF_ERR_UNSUPPORTED)
        return pf_fail(&trust->failure, status, "this key was revoked: make a new one");
    if (status != PF_OK)
        return pf_fail(&trust->failure, status,
                       "a role (viewer, operator, calibrator) and a name are needed: 1 to 47 "
                       "printable ASCII characters");
    size_t n = pf_peers_print(&changed, text, sizeof text);
    status = replace_file(trust, "peers", text, n);
    return status == PF_OK ? refresh(trust) : status;
}

pf_status pf_trust_set(pf_trust *trust, const uint8_t key[32], pf_role role, const char *name)
{
    int lock;
    pf_status status = lock_folder(trust, &lock);
    if (status != PF_OK)
        return status;
    status = change_peers(trust, key, role, name);
    (void)close(lock);
    return status;
}

/* ---- */

const uint8_t *pf_trust_key(const pf_trust *trust)
{
    return trust->key;
}

EVP_PKEY *pf_trust_private_key(const pf_trust *trust)
{
    return trust->private_key;
}

X509 *pf_trust_certificate(const pf_trust *trust)
{
    return trust->certificate;
}

const char *pf_trust_error(const pf_trust *trust)
{
    return trust->failure.text;
}

/* PF_ERR_END: there is none. */
static pf_status look_at_folder(pf_trust *t)
{
    struct stat s;
    if (stat(t->folder, &s) != 0)
        return errno == ENOENT ? PF_ERR_END : fail_errno(t, t->folder, "opening");
    if ((s.st_mode & S_IWOTH) != 0)
        return pf_fail(&t->failure, PF_ERR_UNSUPPORTED, "%s: anybody may write in this folder of keys: chmod o-w",
                       t->folder);
    return PF_OK;
}

static pf_status open_folder(pf_trust *t)
{
    if (mkdir(t->folder, 0700) != 0 && errno != EEXIST)
        return fail_errno(t, t->folder, "making the folder");
    pf_status status = look_at_folder(t);
    if (status == PF_OK)
        status = open_identity(t);
    if (status == PF_OK && !pf_certificate_key(t->certificate, t->key))
        status = fail_crypto(t, "hashing the device's key");
    return status == PF_OK ? refresh(t) : status;
}

static pf_status check_folder(pf_trust *t)
{
    char around[PATH_BYTES];
    pf_status status = look_at_folder(t);
    if (status == PF_ERR_END) { /* the first start makes it */
        (void)snprintf(around, sizeof around, "%s", t->folder);
        return access(dirname(around), F_OK) == 0 ? PF_OK : fail_errno(t, t->folder, "making the folder");
    }
    if (status == PF_OK)
        status = load_identity(t);
    return status == PF_OK || status == PF_ERR_END ? refresh(t) : status;
}

/* On failure of `look` *trust is untouched. */
static pf_status with_folder(pf_trust **trust, const char *folder, pf_status (*look)(pf_trust *), char *error, size_t n)
{
    pf_failure failure = {""};
    if (folder[0] == '\0' || strlen(folder) > PATH_BYTES - 32)
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_ARGUMENT, "trust: no folder"), error, n);
    pf_trust *t = calloc(1, sizeof *t);
    if (t == NULL || (t->folder = strdup(folder)) == NULL) {
        free(t);
        return pf_failure_copy(&failure, pf_fail(&failure, PF_ERR_SPACE, "trust: no memory"), error, n);
    }
    pf_status status = look(t);
    if (status != PF_OK) {
        pf_failure_copy(&t->failure, status, error, n);
        pf_trust_close(t);
        return status;
    }
    *trust = t;
    return PF_OK;
}

pf_status pf_trust_open(pf_trust **trust, const char *folder, char *error, size_t n)
{
    return with_folder(trust, folder, open_folder, error, n);
}

pf_status pf_trust_check(const char *folder, char *error, size_t n)
{
    pf_trust *trust = NULL;
    pf_status status = with_folder(&trust, folder, check_folder, error, n);
    pf_trust_close(trust);
    return status;
}

void pf_trust_close(pf_trust *trust)
{
    if (trust == NULL)
        return;
    X509_free(trust->certificate);
    EVP_PKEY_free(trust->private_key);
    free(trust->folder);
    free(trust);
}
