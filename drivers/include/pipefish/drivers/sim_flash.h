/* An emulated flash memory in RAM that fails as flash memories do: for tests, and for users without hardware. Faults
 * come from the seed and the calls alone: the same calls give the same bytes. No allocation, no operating system.
 *
 * It checks its user: a program of bytes that are not erased, out of range or not aligned is refused with PF_ERR_IO and
 * counted as a violation.
 *
 * Power cuts: pf_sim_flash_cut_after lets so many more operations (program, erase, flush) happen; the one after them
 * fails, and so does everything until pf_sim_flash_power_on. What is in the memory then depends on the kind of cut:
 *   clean      that operation did not happen, all before it did
 *   torn       that operation happened to a part: a program up to some byte, of which some bits; an erase up to some
 *              byte, the rest half erased
 *   reordered  the memory had a cache: of the operations since the last flush, that one included, any may have
 *              happened, in any order
 *   tail       that operation left noise: in its range from some byte to the end
 */
#ifndef PIPEFISH_DRIVERS_SIM_FLASH_H
#define PIPEFISH_DRIVERS_SIM_FLASH_H

#include "pipefish/flash.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_SIM_FLASH_CACHE 256u /* most operations between two flushes; one more flushes by itself */

typedef enum pf_sim_cut {
    PF_SIM_CUT_CLEAN = 0,
    PF_SIM_CUT_TORN = 1,
    PF_SIM_CUT_REORDERED = 2,
    PF_SIM_CUT_TAIL = 3,
    PF_SIM_CUTS = 4,
} pf_sim_cut;

typedef struct pf_sim_flash_config {
    uint32_t erase_size, program_size, sectors; /* as in pf_flash; together at most 64 MiB */
    uint64_t seed;
    bool starts_dirty; /* full of noise, as never erased; else erased */
} pf_sim_flash_config;

typedef struct pf_sim_flash_stats { /* since init */
    uint64_t operations;            /* program, erase and flush, those that failed included */
    uint64_t programs, erases, flushes;
    uint64_t violations;
    uint32_t most_erases; /* of one sector: wear */
} pf_sim_flash_stats;

typedef struct pf_sim_flash pf_sim_flash; /* opaque, in the caller's workspace */

size_t pf_sim_flash_workspace_size(const pf_sim_flash_config *config); /* 0 if out of range */

/* *flash becomes the interface to it. PF_ERR_ARGUMENT: a size is out of range. */
pf_status pf_sim_flash_init(pf_sim_flash **sim, pf_flash *flash, const pf_sim_flash_config *config, void *workspace,
                            size_t size);

/* Other faults from now on. */
void pf_sim_flash_seed(pf_sim_flash *sim, uint64_t seed);

/* Power fails at the operation after `operations` more. */
void pf_sim_flash_cut_after(pf_sim_flash *sim, uint64_t operations, pf_sim_cut kind);
bool pf_sim_flash_is_off(const pf_sim_flash *sim);
/* Power comes back; a cut and a spoiled program that have not happened are forgotten. */
void pf_sim_flash_power_on(pf_sim_flash *sim);

/* The program after so many more operations leaves one bit wrong, and says nothing. */
void pf_sim_flash_spoil_after(pf_sim_flash *sim, uint64_t operations);

/* From now on every erase and program of this sector fails. */
void pf_sim_flash_break(pf_sim_flash *sim, uint32_t sector);

/* Flips a bit behind the interface's back; bit < 8 x size. */
void pf_sim_flash_flip(pf_sim_flash *sim, uint64_t bit);

const pf_sim_flash_stats *pf_sim_flash_get_stats(const pf_sim_flash *sim);
uint32_t pf_sim_flash_erases(const pf_sim_flash *sim, uint32_t sector);

/* Takes over content, wear and the state of power from another one of the same geometry: to go on from one state in
 * several ways. */
void pf_sim_flash_copy(pf_sim_flash *to, const pf_sim_flash *from);

#ifdef __cplusplus
}
#endif
#endif
