#include "camera_common/timing.h"

#include <string.h>

#define STAMP_OLDEST_NS 2000000000u

void pf_numbering_init(pf_numbering *n, uint64_t period_ns)
{
    memset(n, 0, sizeof *n);
    n->period_ns = period_ns;
    n->is_fresh = true;
}

void pf_numbering_restart(pf_numbering *n)
{
    n->is_fresh = true;
}

/* Periods in `elapsed`, rounded; at least 1. */
static uint64_t periods(const pf_numbering *n, uint64_t elapsed)
{
    uint64_t k = n->period_ns == 0 ? 1 : (elapsed + n->period_ns / 2) / n->period_ns;
    return k < 1 ? 1 : k;
}

void pf_numbering_take(pf_numbering *n, uint32_t sequence, uint64_t stamp_ns, uint64_t now_ns, uint64_t *number,
                       uint64_t *time_ns)
{
    uint64_t time = stamp_ns;
    if (stamp_ns == 0 || stamp_ns > now_ns || now_ns - stamp_ns > STAMP_OLDEST_NS ||
        (n->has_last && stamp_ns <= n->last_ns)) {
        n->bad_times++;
        time = n->has_last && now_ns <= n->last_ns ? n->last_ns + 1 : now_ns;
    }
    if (!n->has_last) {
        n->last = 0;
    } else if (n->is_fresh) {
        uint64_t step = periods(n, time - n->last_ns);
        n->gaps += step - 1;
        n->last += step;
    } else {
        uint32_t step = sequence - n->last_kernel; /* modulo 2^32: the kernel's number may wrap */
        if (step == 0 || step > UINT32_MAX / 2) {
            n->bad_counts++;
            step = 1;
        }
        n->gaps += step - 1;
        n->last += step;
    }
    n->has_last = true;
    n->is_fresh = false;
    n->last_kernel = sequence;
    n->last_ns = time;
    *number = n->last;
    *time_ns = time;
}

/* ---- recovery */

void pf_recovery_init(pf_recovery *r, uint64_t period_ns, uint64_t now_ns)
{
    memset(r, 0, sizeof *r);
    r->period_ns = period_ns;
    r->since_ns = r->whole_ns = r->retry_ns = now_ns;
}

static uint64_t patience(const pf_recovery *r)
{
    uint64_t wait = 3 * r->period_ns;
    if (!r->has_frame) /* a camera that needs longer than we thought gets it at a later try */
        return (PF_RECOVERY_FIRST_NS << (r->fruitless < 3 ? r->fruitless : 3)) + wait;
    return wait < PF_RECOVERY_LEAST_NS ? PF_RECOVERY_LEAST_NS : wait;
}

pf_recovery_action pf_recovery_next(pf_recovery *r, uint64_t now_ns)
{
    if (!r->is_open)
        return now_ns >= r->retry_ns ? PF_RECOVERY_OPEN : PF_RECOVERY_WAIT;
    if (!r->is_broken && now_ns - r->since_ns < patience(r))
        return PF_RECOVERY_WAIT;
    r->is_broken = false;
    return r->was_restarted ? PF_RECOVERY_REOPEN : PF_RECOVERY_RESTART;
}

void pf_recovery_pause(pf_recovery *r, uint64_t elapsed_ns)
{
    r->since_ns += elapsed_ns;
    r->whole_ns += elapsed_ns;
}

static void begin(pf_recovery *r, uint64_t now_ns)
{
    r->is_open = true;
    r->has_frame = r->is_broken = false;
    r->since_ns = r->whole_ns = now_ns;
}

void pf_recovery_opened(pf_recovery *r, uint64_t now_ns)
{
    begin(r, now_ns);
    r->was_restarted = false;
}

void pf_recovery_restarted(pf_recovery *r, uint64_t now_ns)
{
    r->restarts++;
    begin(r, now_ns);
    r->was_restarted = true;
}

void pf_recovery_closed(pf_recovery *r, uint64_t now_ns)
{
    if (r->is_open) {
        r->reopens++;
        r->fruitless += !r->has_frame;
    }
    r->is_open = false;
    r->retry_ns = now_ns + PF_RECOVERY_RETRY_NS;
}

void pf_recovery_frame(pf_recovery *r, uint64_t now_ns)
{
    r->has_frame = true;
    r->fruitless = 0;
    r->was_restarted = r->is_broken = false;
    r->since_ns = r->whole_ns = now_ns;
}

void pf_recovery_damaged(pf_recovery *r, uint64_t now_ns)
{
    if (now_ns - r->whole_ns < PF_RECOVERY_DAMAGED_NS)
        r->since_ns = now_ns;
}

void pf_recovery_error(pf_recovery *r)
{
    r->is_broken = true;
}

void pf_recovery_unplug(pf_recovery *r)
{
    r->unplugs++;
    r->is_broken = r->was_restarted = true; /* a restart would be in vain */
}
