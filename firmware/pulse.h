/* Who works, and since when: a thread that has worked on one thing for too long hangs. A thread that waits for
 * something that may take for ever (a frame, a host, room) rests. */
#ifndef PIPEFISHD_PULSE_H
#define PIPEFISHD_PULSE_H

#include <stdint.h>

typedef enum pf_pulse {
    PF_PULSE_CAPTURE = 0,
    PF_PULSE_TRACKING,
    PF_PULSE_STORE,
    PF_PULSE_COURIER,
    PF_PULSE_GPIO,
    PF_PULSE_MAIN,
    PF_PULSES,
} pf_pulse;

/* The calling thread is this one from now on, and works. The system shows it by that name (top -H), but for main, whose
 * name is the process's. */
void pf_pulse_begin(pf_pulse pulse);

/* For a thread that knows nothing of pulses: when it began what it does now; 0 = it is not there. */
void pf_pulse_note(pf_pulse pulse, uint64_t since_ns);

/* The calling thread begins another piece of work; rests. A thread that never began is not watched. */
void pf_pulse_work(void);
void pf_pulse_rest(void);

/* The name of a thread that has worked on one thing for more than `most_ns`, or NULL. Any thread. */
const char *pf_pulse_hung(uint64_t now_ns, uint64_t most_ns);

#endif
