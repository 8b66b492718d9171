#include "pulse.h"

#include <stdatomic.h>
#include <stddef.h>
#include <sys/prctl.h>

#include "pipefish/drivers/clock.h"

static _Atomic uint64_t working_since[PF_PULSES]; /* 0 = rests, or is not there */
static _Thread_local _Atomic uint64_t *own;
static const char *const names[PF_PULSES] = {"capture", "tracking", "store", "link", "GPIO", "main"};

void pf_pulse_begin(pf_pulse pulse)
{
    own = &working_since[pulse];
    if (pulse != PF_PULSE_MAIN)
        (void)prctl(PR_SET_NAME, names[pulse]);
    pf_pulse_work();
}

void pf_pulse_note(pf_pulse pulse, uint64_t since_ns)
{
    atomic_store(&working_since[pulse], since_ns);
}

void pf_pulse_work(void)
{
    if (own != NULL)
        atomic_store(own, pf_now());
}

void pf_pulse_rest(void)
{
    if (own != NULL)
        atomic_store(own, 0);
}

const char *pf_pulse_hung(uint64_t now_ns, uint64_t most_ns)
{
    for (int i = 0; i < PF_PULSES; i++) {
        uint64_t since = atomic_load(&working_since[i]);
        if (since != 0 && now_ns > since && now_ns - since > most_ns)
            return names[i];
    }
    return NULL;
}
