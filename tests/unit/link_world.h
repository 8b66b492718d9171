/* Two links with an application each, over the emulated line, in virtual time: what test_link_channel.c runs.
 *
 * Each application sends objects 0..n-1 from a spool that survives its restarts, numbered control messages and numbered
 * latest messages, and keeps what it receives; it asserts while it runs that nothing arrives twice, damaged, out of
 * order or older than what came before. */
#ifndef LINK_WORLD_H
#define LINK_WORLD_H

#include "pipefish/drivers/sim_line.h"
#include "pipefish/link.h"

#define WORLD_OBJECTS     12u
#define WORLD_OBJECT_SIZE 24000u
#define WORLD_WORKSPACE   1600000u
#define WORLD_MS          UINT64_C(1000000)

typedef struct world_app {
    pf_link *link;
    pf_link_config config;
    bool fresh;     /* has not been started */
    uint32_t start; /* counts restarts */
    /* what it sends */
    uint32_t objects, sizes[WORLD_OBJECTS];
    bool given[WORLD_OBJECTS], sent[WORLD_OBJECTS], refused[WORLD_OBJECTS]; /* by the peer */
    uint32_t control_next, latest_next[PF_LINK_TOPICS];
    uint64_t control_every, latest_every, control_at, latest_at; /* ns; 0 = none */
    uint32_t latest_size;
    /* what it receives */
    bool stored[WORLD_OBJECTS];
    uint32_t refuse_mask, again_left; /* objects it refuses; times it pretends that the bytes do not match */
    uint64_t answer_delay;
    struct {
        uint64_t at;
        uint32_t slot;
        pf_link_answer answer;
        uint32_t id;
        bool open, object;
    } questions[PF_LINK_SLOTS_MAX];
    uint32_t offers, ups, downs;
    uint32_t control_start, control_seen, control_count; /* of the peer: its start and the next number */
    uint32_t latest_start, latest_seen[PF_LINK_TOPICS], latest_count;
    uint64_t worst_control_wait;
} world_app;

typedef struct world {
    uint64_t now, random;
    pf_sim_line *line;
    world_app apps[2];
    uint64_t control_sent_at[2][256];
    bool lossless; /* then no control message may be missing */
} world;

/* Workspaces are static; one world at a time. */
void world_init(world *w, const pf_sim_line_config *line, const pf_link_config configs[2]);
uint64_t world_random(world *w, uint64_t below);
/* Starts an end again: another nonce, and nothing left of its link. */
void world_restart(world *w, uint32_t end);
/* Runs until both spools are empty; false when that takes longer than `limit`. */
bool world_run(world *w, uint64_t limit);
/* Runs for so long, whatever happens. */
void world_pass(world *w, uint64_t duration);
bool world_done(const world *w);
uint8_t world_byte(uint32_t end, uint32_t id, uint32_t i);

#endif
