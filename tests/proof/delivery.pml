/* Delivery of objects over the link (lib/link/SPEC.md, "Bulk"): bulk_send.c and pf_store on the device, bulk_receive.c
 * and the survey file on the host, under frames lost and overtaken, sessions that break, and ends that restart.
 *
 * Proved for OBJECTS objects of FRAGMENTS fragments, a receiver with SLOTS slots, LOSSES lost frames, REORDERS frames
 * that overtake another, BREAKS broken sessions and CRASHES restarts at any moment:
 *   - the device forgets an object only after the host has it durably           (assertion in SENT)
 *   - the host keeps no object twice                                            (assertion in user)
 *   - a fragment lands in no other object than its own                          (assertion in host)
 *   - whatever happens, all objects arrive and are forgotten: no end state and no cycle before that (-DNOREDUCE -l)
 * Abstract: HELLO is one step that both ends take together; a frame of another session is dropped by its nonce; time is
 * "nothing is under way". Names are those of the specification and the code: prove looks for what stands in
 * backquotes, begins with pf_ or is a C file in the code, and for a mtype's with the prefix beside it.
 */
#ifndef OBJECTS
#define OBJECTS 2
#endif
#define FRAGMENTS 2
#define SLOTS     1
#define NO_HANDLE 255
#define ALL       3 /* bits of FRAGMENTS */
#define OF_1      4 /* beside them in a frame: of object 1; of the proof, not of the program */
#ifndef LOSSES
#define LOSSES 2
#endif
#ifndef BREAKS
#define BREAKS 1
#endif
#ifndef CRASHES
#define CRASHES 1
#endif
#ifndef REORDERS
#define REORDERS 1
#endif

mtype = { OFFER, DATA };                          /* PF_FRAME_: frames to the host */
mtype = { WAITING, BUSY, UNKNOWN };               /* PF_ACK_: answers to the device, beside the slot's own states */
mtype = { FREE, NEW, OFFERED, SENDING, STORING }; /* PF_SEND_: pf_send_state */
mtype = { ASKED, RECEIVING, COMPLETE, STORED };   /* PF_RECEIVE_: states of a receiver's slot; FREE is one of them too */

chan to_host = [2] of { byte, mtype, byte, byte };   /* session, frame, handle, name (OFFER) or fragment (DATA) */
chan to_device = [2] of { byte, byte, mtype, byte }; /* session, handle, state, bits that are here */

byte session = 1, losses = LOSSES, breaks = BREAKS, crashes = CRASHES, reorders = REORDERS;
bool up = true, ready;

/* the device: the spool is durable, the slots of the link are not */
bool spooled[OBJECTS];
mtype send_state[OBJECTS];
byte next_handle, handle[OBJECTS], acked[OBJECTS], sent[OBJECTS];

/* the host: the file is durable */
bool filed[OBJECTS];
byte kept[OBJECTS]; /* how often: of the proof, not of the program */
mtype slot_state[OBJECTS];
byte slot_handle[OBJECTS], here[OBJECTS];

#define used ((slot_state[0] != FREE) + (slot_state[1] != FREE))
#define is_known(o) (send_state[o] == OFFERED || send_state[o] == SENDING || send_state[o] == STORING)
#define count_known (is_known(0) + is_known(1))
#define question (slot_state[0] == ASKED || slot_state[0] == COMPLETE || slot_state[1] == ASKED || slot_state[1] == COMPLETE)
#define quiet (up && len(to_host) == 0 && len(to_device) == 0 && !question)
#define done (!spooled[0] && !spooled[1])

/* A frame is lost, or is under way, where chaos may let the next one overtake it. */
inline send_frame(kind, h, f)
{
    if
    :: losses > 0 -> losses--
    :: to_host ! session, kind, h, f
    fi
}

inline answer(h, state, bits)
{
    if
    :: losses > 0 -> losses--
    :: to_device ! session, h, state, bits
    fi
}

/* pf_sender_end, and what a receiver forgets with a session: handles and "stored"; what has arrived stays. */
inline end_session(i)
{
    session++;
    i = 0;
    do
    :: i < OBJECTS ->
        if
        :: send_state[i] != FREE -> send_state[i] = NEW
        :: else
        fi;
        if
        :: slot_state[i] == STORED -> slot_state[i] = FREE
        :: else
        fi;
        slot_handle[i] = NO_HANDLE;
        i++
    :: else -> break
    od;
    up = false
}

init
{
    d_step {
        spooled[0] = true; spooled[1] = true;
        send_state[0] = NEW; send_state[1] = NEW;
        slot_state[0] = FREE; slot_state[1] = FREE;
        ready = true
    }
}

active proctype device()
{
    byte s, o, h, bits;
    mtype state;
    ready;
end:
    do
    /* acknowledgements: pf_sender_receive_ack */
    :: to_device ? s, h, state, bits -> d_step {
        o = 0; /* `find_handle` */
        if
        :: is_known(0) && handle[0] == h
        :: else -> o = 1
        fi;
        if
        :: s == session && up && is_known(o) && h == handle[o] ->
            if
            :: state == RECEIVING ->
                if
                :: send_state[o] == OFFERED -> send_state[o] = SENDING; acked[o] = 0; sent[o] = 0
                :: else
                fi;
                if
                :: send_state[o] == SENDING -> acked[o] = acked[o] | bits; sent[o] = sent[o] | bits
                :: else
                fi
            :: state == COMPLETE -> send_state[o] = STORING
            :: state == STORED -> /* SENT: pf_store_release_slot, one transaction of the spool */
                assert(filed[o]);
                spooled[o] = false;
                send_state[o] = FREE
            :: state == UNKNOWN ->
                if
                :: send_state[o] != OFFERED -> send_state[o] = NEW
                :: else
                fi
            :: else /* WAITING, BUSY: ask again later */
            fi
        :: else
        fi; s = 0; o = 0; h = 0; bits = 0; state = 0 }
    /* offers: `next_signal`, no more than the peer's slots */
    :: atomic { up && nfull(to_host) && send_state[0] == NEW && count_known < SLOTS ->
        next_handle++; handle[0] = next_handle; send_state[0] = OFFERED; send_frame(OFFER, handle[0], 0) }
    :: atomic { up && nfull(to_host) && send_state[1] == NEW && count_known < SLOTS ->
        next_handle++; handle[1] = next_handle; send_state[1] = OFFERED; send_frame(OFFER, handle[1], 1) }
    /* fresh fragments: pf_sender_build_data */
    :: atomic { up && nfull(to_host) && send_state[0] == SENDING && (sent[0] & 1) == 0 ->
        sent[0] = sent[0] | 1; send_frame(DATA, handle[0], 1) }
    :: atomic { up && nfull(to_host) && send_state[0] == SENDING && (sent[0] & 2) == 0 ->
        sent[0] = sent[0] | 2; send_frame(DATA, handle[0], 2) }
    :: atomic { up && nfull(to_host) && send_state[1] == SENDING && (sent[1] & 1) == 0 ->
        sent[1] = sent[1] | 1; send_frame(DATA, handle[1], OF_1 | 1) }
    :: atomic { up && nfull(to_host) && send_state[1] == SENDING && (sent[1] & 2) == 0 ->
        sent[1] = sent[1] | 2; send_frame(DATA, handle[1], OF_1 | 2) }
    /* timeouts: OFFER again (offered, storing); lost fragments again (pf_sender_tick) */
    :: atomic { quiet && (send_state[0] == OFFERED || send_state[0] == STORING) ->
        send_frame(OFFER, handle[0], 0) }
    :: atomic { quiet && (send_state[1] == OFFERED || send_state[1] == STORING) ->
        send_frame(OFFER, handle[1], 1) }
    :: atomic { quiet && send_state[0] == SENDING && sent[0] == ALL -> sent[0] = acked[0];
        if
        :: acked[0] == ALL -> send_frame(DATA, handle[0], 1) /* all here, but "complete" was lost */
        :: else
        fi }
    :: atomic { quiet && send_state[1] == SENDING && sent[1] == ALL -> sent[1] = acked[1];
        if
        :: acked[1] == ALL -> send_frame(DATA, handle[1], OF_1 | 1)
        :: else
        fi }
    od
}

active proctype host()
{
    byte s, o, h, f;
    mtype kind;
    ready;
end:
    do
    :: nfull(to_device) && len(to_host) > 0 -> atomic {
        to_host ? s, kind, h, f;
        if
        :: s != session || !up
        :: s == session && up && kind == OFFER ->
            o = f; /* found by its name */
            if
            :: slot_state[o] == FREE && used >= SLOTS && (slot_state[1 - o] == STORED ||
                    (slot_state[1 - o] == RECEIVING && slot_handle[1 - o] == NO_HANDLE)) ->
                slot_state[1 - o] = FREE; here[1 - o] = 0 /* stored, or not mentioned in this session */
            :: else
            fi;
            if
            :: slot_state[o] == FREE && used >= SLOTS -> answer(h, BUSY, 0)
            :: slot_state[o] == FREE && used < SLOTS || slot_state[o] == STORED && slot_handle[o] != h ->
                slot_state[o] = ASKED; slot_handle[o] = h; here[o] = 0; answer(h, WAITING, 0)
            :: else ->
                slot_handle[o] = h; /* takes over what has arrived */
                if
                :: slot_state[o] == ASKED -> answer(h, WAITING, 0)
                :: else -> answer(h, slot_state[o], here[o])
                fi
            fi
        :: s == session && up && kind == DATA ->
            o = 0; /* found by its handle */
            if
            :: slot_handle[0] == h
            :: else -> o = 1
            fi;
            if
            :: slot_state[o] == FREE || slot_handle[o] != h -> answer(h, UNKNOWN, 0)
            :: else ->
                if
                :: slot_state[o] == RECEIVING ->
                    assert((f & OF_1) == OF_1 * o);
                    here[o] = here[o] | (f & ALL);
                    if
                    :: here[o] == ALL -> slot_state[o] = COMPLETE
                    :: else
                    fi
                :: else
                fi;
                if
                :: slot_state[o] == ASKED -> answer(h, WAITING, 0)
                :: else -> answer(h, slot_state[o], here[o])
                fi
            fi
        fi; s = 0; o = 0; h = 0; f = 0; kind = 0 }
    od
}

/* The host's program: answers the link's questions. It outlives sessions, not the host's restart. */
active proctype user()
{
    ready;
end:
    do
    :: d_step { slot_state[0] == ASKED -> if :: filed[0] -> slot_state[0] = STORED :: else -> slot_state[0] = RECEIVING fi }
    :: d_step { slot_state[1] == ASKED -> if :: filed[1] -> slot_state[1] = STORED :: else -> slot_state[1] = RECEIVING fi }
    :: d_step { slot_state[0] == COMPLETE && !filed[0] -> kept[0]++; assert(kept[0] == 1); filed[0] = true }
    :: d_step { slot_state[1] == COMPLETE && !filed[1] -> kept[1]++; assert(kept[1] == 1); filed[1] = true }
    :: d_step { slot_state[0] == COMPLETE && filed[0] -> slot_state[0] = STORED }
    :: d_step { slot_state[1] == COMPLETE && filed[1] -> slot_state[1] = STORED }
    od
}

/* HELLO: both ends begin a session. */
active proctype hello()
{
end:
    do
    :: !up -> up = true
    od
}

active proctype chaos()
{
    byte i, a, b, c;
    mtype m;
    ready;
end:
    do
    /* the second frame of two that are under way overtakes the first */
    :: d_step { reorders > 0 && len(to_host) == 2 -> reorders--;
        to_host ? a, m, b, c; to_host ! a, m, b, c; a = 0; m = 0; b = 0; c = 0 }
    :: d_step { reorders > 0 && len(to_device) == 2 -> reorders--;
        to_device ? a, b, m, c; to_device ! a, b, m, c; a = 0; b = 0; m = 0; c = 0 }
    :: d_step { up && breaks > 0 -> breaks--; end_session(i) }
    :: d_step { crashes > 0 -> crashes--; end_session(i); /* the device: what the spool has is loaded again */
        next_handle = 0;
        i = 0;
        do
        :: i < OBJECTS ->
            if
            :: spooled[i] -> send_state[i] = NEW
            :: else -> send_state[i] = FREE
            fi;
            i++
        :: else -> break
        od; i = 0 }
    :: d_step { crashes > 0 -> crashes--; end_session(i); /* the host: only the file outlives it */
        i = 0;
        do
        :: i < OBJECTS -> slot_state[i] = FREE; here[i] = 0; i++
        :: else -> break
        od; i = 0 }
    od
}

/* Ends only when all is delivered: else there is an end state before that. */
active proctype watcher()
{
    ready;
    done
}
