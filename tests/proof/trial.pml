/* A profile's trial (lib/profile/SPEC.md, "The store"; store.c, keeper.c; "confirmed" is the record's `active`): written,
 * on trial, confirmed or given up, with power cut between any two steps, and a profile that keeps the daemon from running.
 *
 * Proved for WRITES profiles that the host sends, good ones and one that is bad, and CUTS power cuts at any moment:
 *   - what is loaded is a whole profile that was sent, never half of one          (assertion in load)
 *   - the slot of the confirmed profile, or of one on trial, is never erased      (assertion in write)
 *   - a profile that keeps the daemon from running is never confirmed             (assertion in confirm)
 *   - "stored" is said only of what the next start takes                          (assertion after read back)
 *   - after every history the daemon runs again, with a good profile              (no end state and no cycle before that)
 * Abstract: a record is appended whole or not at all (test_profile_store of tests/unit cuts power inside it). The numbers
 * 1 and 3 are good profiles, 2 is the bad one, 0 is none, TORN is a slot that was being written.
 */
#ifndef CUTS
#define CUTS 3
#endif
#ifndef WRITES
#define WRITES 3
#endif
#define STARTS 2 /* camera.`trial_starts` */
#define TORN   9
#define NONE   2
#define BAD    2

byte slot[2];                               /* the medium: durable */
byte confirmed = 0, trial = NONE, previous = NONE, starts; /* the newest record: durable */
byte in_use, cuts = CUTS, writes = WRITES;
bool running, over;

#define loaded ((trial != NONE && slot[trial] != TORN && slot[trial] != 0) -> slot[trial] : slot[confirmed])

inline load()
{
    in_use = loaded;
    assert(in_use == 1 || in_use == BAD || in_use == 3)
}

/* pf_profile_store_start and `take_into_use`: then the pipeline opens, or the daemon dies of a bad profile. */
inline boot()
{
    if
    :: trial != NONE && starts == 0 -> trial = NONE
    :: trial != NONE && starts > 0 -> starts--
    :: else
    fi;
    load();
    running = (in_use != BAD)
}

/* The host sends a profile p: `store_profile`, pf_profile_store_write. Each step may be the last before a cut. */
active proctype daemon()
{
    byte to, p;
    slot[0] = 1; slot[1] = 0; /* a good profile is confirmed */
restart:
    atomic { running = false; boot() };
    do
    :: over -> break
    :: !running -> goto restart /* the service manager starts it again */
    :: cuts > 0 -> cuts--; goto restart
    :: running && writes > 0 ->
        writes--;
        if
        :: p = BAD
        :: p = 3
        :: p = 1
        fi;
        if
        :: p == loaded -> skip /* `is_stored`: nothing to do */
        :: else ->
            to = 1 - confirmed;
            if
            :: trial == to || previous == to -> atomic { /* a record without it first */
                if
                :: trial == to -> trial = NONE
                :: else
                fi;
                if
                :: previous == to -> previous = NONE
                :: else
                fi }
            :: else
            fi;
            if :: cuts > 0 -> cuts--; goto restart :: skip fi;
            assert(to != confirmed && to != trial);
            slot[to] = TORN;
            if :: cuts > 0 -> cuts--; goto restart :: skip fi;
            slot[to] = p;
            if :: cuts > 0 -> cuts--; goto restart :: skip fi;
            atomic { trial = to; starts = STARTS };
            if :: cuts > 0 -> cuts--; goto restart :: skip fi;
            assert(loaded == p) /* read back: "stored" */
        fi
    :: running && trial != NONE && slot[trial] == in_use -> /* `confirm_profile`: only what runs */
        assert(slot[trial] != BAD);
        atomic { previous = confirmed; confirmed = trial; trial = NONE }
    :: running && trial != NONE -> trial = NONE                           /* `revert_profile` */
    :: running && trial == NONE && previous != NONE ->
progress_by_hand: /* the host may go to and fro for ever; the device may not restart for ever */
        atomic { to = previous; previous = confirmed; confirmed = to }
    :: running && !over && writes == 0 && cuts == 0 && (trial == NONE || slot[trial] == in_use) -> over = true
    :: running && trial != NONE && slot[trial] != in_use -> goto restart  /* its trial begins with a restart */
    od;
    assert(running && in_use != BAD && slot[confirmed] != TORN && slot[confirmed] != BAD)
}
