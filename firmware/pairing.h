/* The device's key and the hosts that it lets in, as the settings name their folder. */
#ifndef PIPEFISH_PAIRING_H
#define PIPEFISH_PAIRING_H

#include "daemon.h"

/* Opens the folder of link.trust, if it is set, as daemon->trust. False: error[n] says why. */
bool pf_pairing_open(pf_daemon *daemon, char *error, size_t n);

/* Only looks: for --check-config. False: error[n]. */
bool pf_pairing_check(const pf_daemon *daemon, char *error, size_t n);

/* Lets a host in without its cable: "role key name" as a line of the file of hosts. Root does it as the folder's owner,
 * who the program then is. Returns its exit code: 0, or 1 (failed) and 2 (no such line), and error[n] says why. */
int pf_pairing_add(pf_daemon *daemon, const char *line, char *error, size_t n);

#endif
