/* An emulated full-duplex line in virtual time, for tests, benchmarks and users without a crawler.
 *
 * Each direction: a transmit FIFO of `fifo` bytes, drained at the baud rate (8N1: ten bits a byte); each byte arrives
 * `latency_ns` after its last bit. Faults come from the seed alone: the same calls give the same bytes. They act on
 * single bytes (corrupt, drop) and on frames, the bytes up to and with a zero (frame_loss, duplicate, reorder);
 * duplicates take their time on the line. Duplication and reordering are for lines of datagrams; a serial line has
 * neither. Rates are in millionths. No allocation, no clock, no operating system. */
#ifndef PIPEFISH_DRIVERS_SIM_LINE_H
#define PIPEFISH_DRIVERS_SIM_LINE_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct pf_sim_faults {
    uint32_t corrupt_ppm;    /* of bytes: one bit flips */
    uint32_t drop_ppm;       /* of bytes: a burst starts here that is lost, as a UART's overrun does */
    uint32_t drop_burst;     /* bytes of a burst, 1..4096 [8] */
    uint32_t frame_loss_ppm; /* of frames: one byte is changed, to another than zero */
    uint32_t duplicate_ppm;  /* of frames: comes twice */
    uint32_t reorder_ppm;    /* of frames: changes place with the one before, if that has not begun to arrive */
} pf_sim_faults;

typedef struct pf_sim_line_config {
    uint32_t baud;       /* 300..100000000 */
    uint32_t fifo;       /* bytes, 16..1048576 [4096] */
    uint64_t latency_ns; /* at most one second [0] */
    uint64_t seed;
    pf_sim_faults faults; /* of both directions */
} pf_sim_line_config;

typedef struct pf_sim_line_stats { /* of one direction */
    uint64_t bytes_written, bytes_read;
    uint64_t bytes_corrupted, bytes_dropped; /* dropped: by bursts, cuts and a full receive buffer */
    uint64_t frames_lost, frames_duplicated, frames_reordered;
} pf_sim_line_stats;

typedef struct pf_sim_line pf_sim_line; /* opaque, in the caller's workspace; its ends are 0 and 1 */

size_t pf_sim_line_workspace_size(const pf_sim_line_config *config); /* 0 if out of range */
pf_status pf_sim_line_init(pf_sim_line **line, const pf_sim_line_config *config, void *workspace, size_t size);

/* Bytes that this end's FIFO takes now. */
size_t pf_sim_line_room(pf_sim_line *line, uint32_t end, uint64_t now_ns);
/* Puts bytes into this end's FIFO; returns how many it took. */
size_t pf_sim_line_write(pf_sim_line *line, uint32_t end, const uint8_t *bytes, size_t n, uint64_t now_ns);
/* Takes what has arrived at this end; returns how many. */
size_t pf_sim_line_read(pf_sim_line *line, uint32_t end, uint8_t *bytes, size_t capacity, uint64_t now_ns);
/* When the next byte arrives at this end; UINT64_MAX if none is on its way. */
uint64_t pf_sim_line_arrival(const pf_sim_line *line, uint32_t end);
/* When this end's FIFO will take n bytes (n <= fifo). */
uint64_t pf_sim_line_room_at(const pf_sim_line *line, uint32_t end, size_t n);

/* Loses all that is under way in both directions. */
void pf_sim_line_cut(pf_sim_line *line);
/* While disconnected, what is written is lost at once (bytes count as dropped); disconnecting cuts. */
void pf_sim_line_connect(pf_sim_line *line, bool connected);
void pf_sim_line_set_faults(pf_sim_line *line, const pf_sim_faults *faults);
const pf_sim_line_stats *pf_sim_line_get_stats(const pf_sim_line *line, uint32_t end); /* of what this end writes */

#ifdef __cplusplus
}
#endif
#endif
