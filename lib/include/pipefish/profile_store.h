/* Where a device keeps its calibration profile: two slots in flash memory, and a record of which one counts. A new
 * profile is written to the slot that is not in use and is on trial until it is confirmed; unless that happens within
 * the starts it was given, the device goes back to the one before. Power may fail at any operation: what is loaded
 * afterwards is the old profile or the new one, and the next write succeeds. lib/profile/SPEC.md has the layout.
 *
 * The store keeps bytes and checks that they are the ones that were written; pf_profile_decode says whether they are a
 * profile. Call it before write, and after load. After PF_ERR_IO of any function open the store again: what was being
 * done has happened or not.
 */
#ifndef PIPEFISH_PROFILE_STORE_H
#define PIPEFISH_PROFILE_STORE_H

#include "pipefish/flash.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PF_PROFILE_STORE_BYTES 8192u /* most bytes of a profile */
#define PF_PROFILE_STORE_NONE  255u  /* no slot */

/* What the newest record says. */
typedef struct pf_profile_store_state {
    uint32_t sequence;       /* of the record; 0 = the store is empty */
    uint8_t active;          /* slot of the confirmed profile: 0, 1 or PF_PROFILE_STORE_NONE */
    uint8_t trial;           /* slot of the profile on trial, likewise */
    uint8_t previous;        /* slot of the profile that was active before, if nothing has been written over it */
    uint8_t starts_left;     /* starts that the trial may still have without being confirmed */
    uint32_t length[2];      /* of the profile in each slot; 0 = none */
    uint32_t crc[2];         /* its CRC-32C */
    uint32_t slot_erases[2]; /* wear; a power cut may leave one uncounted */
    uint32_t log_erases[2];
} pf_profile_store_state;

typedef struct pf_profile_store {
    pf_profile_store_state state; /* to read */
    /* private */
    const pf_flash *flash;
    uint8_t *scratch;
    uint32_t stride, per_sector, slot_sectors;
    uint32_t next[2];   /* first free record of each log */
    uint32_t newest[2]; /* sequence of the newest record of each log, 0 = none */
} pf_profile_store;

/* Most bytes of scratch that a flash memory needs; 0 = it cannot hold a store (sizes that do not fit, too few sectors:
 * it takes two for the logs and twice as many as 8192 bytes need). */
uint32_t pf_profile_store_scratch_size(const pf_flash *flash);

/* Reads the records; writes nothing. `flash` and scratch (of the size above) are borrowed for the store's life. A
 * memory without a record is an empty store, whatever it holds. Returns PF_OK; PF_ERR_ARGUMENT (geometry);
 * PF_ERR_VERSION (of a newer program; nothing may be written); PF_ERR_IO. */
pf_status pf_profile_store_open(pf_profile_store *store, const pf_flash *flash, uint8_t *scratch);

/* Counts a start of the device; call it once, before load. A profile whose trial is over, or that is damaged, is
 * dropped from it. Also writes the record again where one of its two copies is damaged. PF_OK, PF_ERR_IO. */
pf_status pf_profile_store_start(pf_profile_store *store);

/* Reads the profile that counts: the one on trial if there is one, else the active one.
 * Returns PF_OK, or with *n untouched and the bytes undefined: PF_ERR_END (there is none); PF_ERR_CHECKSUM (damaged:
 * the other slot is not taken for it, for it is another profile; see revert); PF_ERR_SPACE; PF_ERR_IO. A damaged trial
 * counts as none. *is_trial (may be NULL) says which it was. */
pf_status pf_profile_store_load(const pf_profile_store *store, uint8_t *bytes, size_t capacity, size_t *n,
                                bool *is_trial);

/* Writes a profile to the slot that is not active, reads it back, and puts it on trial for `starts` starts (0: the next
 * start drops it unless it is confirmed). Replaces a profile that is on trial.
 * Returns PF_OK; PF_ERR_ARGUMENT (n not within 1..8192); PF_ERR_IO (also: reads back otherwise). */
pf_status pf_profile_store_write(pf_profile_store *store, const uint8_t *bytes, size_t n, uint8_t starts);

/* The profile on trial becomes the active one. PF_OK; PF_ERR_END (none is on trial); PF_ERR_CHECKSUM (it is damaged);
 * PF_ERR_IO. */
pf_status pf_profile_store_confirm(pf_profile_store *store);

/* Drops the profile on trial; without one, goes back to the one that was active before. PF_OK; PF_ERR_END (there is
 * nothing to go back to); PF_ERR_CHECKSUM (it is damaged); PF_ERR_IO. */
pf_status pf_profile_store_revert(pf_profile_store *store);

#ifdef __cplusplus
}
#endif
#endif
