#include "pairing.h"

#include <errno.h>
#include <grp.h>
#include <libgen.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "log.h"

bool pf_pairing_open(pf_daemon *d, char *error, size_t n)
{
    const char *folder = d->config.link.trust;
    char why[768] = "";
    if (folder[0] == '\0' || pf_trust_open(&d->trust, folder, why, sizeof why) == PF_OK)
        return true;
    (void)snprintf(error, n, "link.trust: %s", why);
    return false;
}

bool pf_pairing_check(const pf_daemon *d, char *error, size_t n)
{
    const char *folder = d->config.link.trust;
    char why[768] = "";
    if (folder[0] == '\0')
        return true;
    if (access(folder, R_OK | X_OK) != 0 && errno == EACCES) {
        pf_log(PF_LOG_WARNING, "link.trust: %s: not for this user to look at: it is not checked", folder);
        return true;
    }
    if (pf_trust_check(folder, why, sizeof why) == PF_OK)
        return true;
    (void)snprintf(error, n, "link.trust: %s", why);
    return false;
}

/* What root makes the daemon's user cannot read: root becomes the owner of the folder, or of the one around it while it
 * is not there. */
static bool become_owner(const char *folder, char *error, size_t n)
{
    char copy[PF_CONFIG_TEXT_MAX];
    struct stat s;
    if (geteuid() != 0)
        return true;
    (void)snprintf(copy, sizeof copy, "%s", folder);
    if ((stat(folder, &s) != 0 && stat(dirname(copy), &s) != 0) || s.st_uid == 0) /* opening it says what is wrong */
        return true;
    if (setgroups(0, NULL) == 0 && setgid(s.st_gid) == 0 && setuid(s.st_uid) == 0)
        return true;
    (void)snprintf(error, n, "link.trust: %s: its owner's files cannot be made: %s", folder, strerror(errno));
    return false;
}

int pf_pairing_add(pf_daemon *d, const char *line, char *error, size_t n)
{
    char key[65], why[128] = "";
    pf_peers one;
    if (pf_peers_parse(&one, line, strlen(line), why, sizeof why) != PF_OK || one.count != 1) {
        (void)snprintf(error, n, "--pair: %s", one.count == 0 && why[0] == '\0' ? "nobody" : why);
        return 2;
    }
    if (d->config.link.trust[0] == '\0') {
        (void)snprintf(error, n, "link.trust: must be set: the folder of the keys");
        return 1;
    }
    if (!become_owner(d->config.link.trust, error, n) || !pf_pairing_open(d, error, n))
        return 1;
    const pf_peer *peer = &one.peer[0];
    int code = 0;
    if (pf_trust_set(d->trust, peer->key, peer->role, peer->name) == PF_OK) {
        pf_key_print(pf_trust_key(d->trust), key);
        (void)printf("%s: %s\nthis device's key: %s\n", peer->name, pf_role_text(peer->role), key);
    } else {
        (void)snprintf(error, n, "link.trust: %s", pf_trust_error(d->trust));
        code = 1;
    }
    pf_trust_close(d->trust);
    return code;
}
