/* What worked last. A daemon that did not come up three times in a row with the same settings takes those of its last
 * good run. A start is good once it has run for a minute, or ended as it was meant to. One that was up and well for
 * five seconds when the board lost its power is neither good nor failed. A folder keeps
 * - starts: how many starts in a row were not good, the SHA-256 of the settings' file they had, the kernel's boot id at
 *   the last of them, and "up" while that is up and well
 * - good.ini: every setting of the last good run
 */
#ifndef PIPEFISHD_RECALL_H
#define PIPEFISHD_RECALL_H

#include <pthread.h>

#include "daemon.h"

#define PF_RECALL_STARTS  3u
#define PF_RECALL_GOOD_NS UINT64_C(60000000000)
#define PF_RECALL_UP_NS   UINT64_C(5000000000) /* frames were taken, the lamp is on */

struct pf_recall {
    char folder[PF_CONFIG_TEXT_MAX]; /* "" = nothing is kept */
    char hash[65];                   /* of the settings' file */
    char boot[40];                   /* the kernel's boot id */
    bool has_good;
    bool is_recalled;      /* the settings in force are those of the last good run */
    pthread_mutex_t mutex; /* of what follows and of the file of starts, once the guard runs */
    unsigned starts;       /* in a row that were not good, this one included */
    bool is_done, is_up;
};

/* Notes a start with this file. What cannot be kept is logged, and is no reason not to start. */
void pf_recall_begin(pf_recall *recall, const char *folder, const char *file);

/* Whether this start is to take good.ini; path[n] becomes its name. */
bool pf_recall_is_due(const pf_recall *recall, char *path, size_t n);

/* The daemon is up, and no thread hangs: by main. Or one does: by the guard, for main may be the one, again and again
 * until it goes on; main then takes it back. Either waits for the disk when that is news. */
void pf_recall_up(pf_recall *recall, bool is_well);

/* The run with these settings was good. By main. */
void pf_recall_good(pf_recall *recall, const pf_config *config);

#endif
