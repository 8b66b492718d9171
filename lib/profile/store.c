/* The A/B store of profiles; SPEC.md describes its bytes.
 *
 * All that is to be known is in one record, so every change of state is one record more in a log, and the newest intact
 * one counts. The log exists twice, in two sectors: while one is erased the other holds the record, and a flipped bit
 * in the newest record does not bring an older state, and with it another profile, back. */
#include "pipefish/profile_store.h"

#include "bytes.h"

#define NONE PF_PROFILE_STORE_NONE

#define RECORD_BYTES   64u
#define RECORD_VERSION 1u
#define RECORD_CRC     60u

/* Bytes programmed at once, if units are not larger: bounds the time of a call. */
#define CHUNK 256u

static const uint8_t MAGIC[4] = {'P', 'F', 'S', 'T'};

static uint32_t round_up(uint32_t n, uint32_t to)
{
    return (n + to - 1) / to * to;
}

uint32_t pf_profile_store_scratch_size(const pf_flash *flash)
{
    uint32_t unit = flash->program_size, sector = flash->erase_size;
    if (unit < 1 || sector < unit || sector % unit != 0 || sector > 1u << 24 || round_up(RECORD_BYTES, unit) > sector)
        return 0;
    uint32_t sectors = 2 + 2 * (round_up(PF_PROFILE_STORE_BYTES, sector) / sector);
    if (flash->sectors < sectors || flash->sectors > UINT32_MAX / sector)
        return 0;
    return round_up(RECORD_BYTES, unit) > CHUNK ? round_up(RECORD_BYTES, unit) : CHUNK;
}

static pf_status read_at(const pf_profile_store *store, uint32_t at, void *bytes, uint32_t n)
{
    return store->flash->ops->read(store->flash->self, at, bytes, n);
}

static pf_status flush(const pf_profile_store *store)
{
    return store->flash->ops->flush(store->flash->self);
}

/* ------------------------------------------------------------------------------------------------- records */

static void put_record(const pf_profile_store_state *state, uint8_t *p)
{
    memset(p, 0, RECORD_BYTES);
    memcpy(p, MAGIC, sizeof MAGIC);
    put_u32(p + 4, RECORD_VERSION);
    put_u32(p + 8, state->sequence);
    p[12] = state->active;
    p[13] = state->trial;
    p[14] = state->previous;
    p[15] = state->starts_left;
    for (uint32_t i = 0; i < 2; i++) {
        put_u32(p + 16 + 4 * i, state->length[i]);
        put_u32(p + 24 + 4 * i, state->crc[i]);
        put_u32(p + 32 + 4 * i, state->slot_erases[i]);
        put_u32(p + 40 + 4 * i, state->log_erases[i]);
    }
    put_u32(p + RECORD_CRC, pf_crc32c(0, p, RECORD_CRC));
}

static bool is_slot(const pf_profile_store_state *state, uint8_t slot)
{
    return slot == NONE || (slot < 2 && state->length[slot] > 0);
}

/* PF_ERR_FORMAT: no intact record; PF_ERR_VERSION: one of a newer program. */
static pf_status get_record(const uint8_t *p, pf_profile_store_state *state)
{
    if (memcmp(p, MAGIC, sizeof MAGIC) != 0 || get_u32(p + RECORD_CRC) != pf_crc32c(0, p, RECORD_CRC))
        return PF_ERR_FORMAT;
    if (get_u32(p + 4) != RECORD_VERSION)
        return PF_ERR_VERSION;
    state->sequence = get_u32(p + 8);
    state->active = p[12];
    state->trial = p[13];
    state->previous = p[14];
    state->starts_left = p[15];
    for (uint32_t i = 0; i < 2; i++) {
        state->length[i] = get_u32(p + 16 + 4 * i);
        state->crc[i] = get_u32(p + 24 + 4 * i);
        state->slot_erases[i] = get_u32(p + 32 + 4 * i);
        state->log_erases[i] = get_u32(p + 40 + 4 * i);
        if (state->length[i] > PF_PROFILE_STORE_BYTES)
            return PF_ERR_FORMAT;
    }
    bool is_good = is_slot(state, state->active) && is_slot(state, state->trial) && is_slot(state, state->previous) &&
                   state->sequence > 0 && state->sequence <= INT32_MAX &&
                   (state->trial == NONE || state->trial != state->active);
    return is_good ? PF_OK : PF_ERR_FORMAT;
}

/* The first byte, and each like the one before it. */
static bool is_erased(const uint8_t *bytes, uint32_t n)
{
    return bytes[0] == 0xFF && memcmp(bytes, bytes + 1, n - 1) == 0;
}

/* Finds the first free record of a log: behind all that is not erased, for a power cut may have left anything in the
 * last one; and the newest intact one, the last, for they are written in order. */
static pf_status scan_log(pf_profile_store *store, uint32_t log)
{
    for (uint32_t i = store->per_sector; i-- > 0 && store->newest[log] == 0;) {
        pf_profile_store_state found;
        uint32_t at = log * store->flash->erase_size + i * store->stride;
        pf_status status = read_at(store, at, store->scratch, store->stride);
        if (status != PF_OK)
            return status;
        if (store->next[log] == 0) {
            if (is_erased(store->scratch, store->stride))
                continue;
            store->next[log] = i + 1;
        }
        status = get_record(store->scratch, &found);
        if (status == PF_ERR_VERSION)
            return status;
        if (status != PF_OK)
            continue;
        store->newest[log] = found.sequence;
        if (found.sequence > store->state.sequence)
            store->state = found;
    }
    return PF_OK;
}

pf_status pf_profile_store_open(pf_profile_store *store, const pf_flash *flash, uint8_t *scratch)
{
    if (!store || !flash || !scratch || pf_profile_store_scratch_size(flash) == 0)
        return PF_ERR_ARGUMENT;
    memset(store, 0, sizeof *store);
    store->flash = flash;
    store->scratch = scratch;
    store->stride = round_up(RECORD_BYTES, flash->program_size);
    store->per_sector = flash->erase_size / store->stride;
    store->slot_sectors = round_up(PF_PROFILE_STORE_BYTES, flash->erase_size) / flash->erase_size;
    store->state.active = store->state.trial = store->state.previous = NONE;
    pf_status status = scan_log(store, 0);
    return status == PF_OK ? scan_log(store, 1) : status;
}

static pf_status append_to(pf_profile_store *store, uint32_t log, const uint8_t record[RECORD_BYTES], uint32_t sequence)
{
    const pf_flash *flash = store->flash;
    pf_status status;
    if (store->next[log] == store->per_sector) {
        store->newest[log] = 0;
        status = flash->ops->erase(flash->self, log);
        if (status != PF_OK)
            return status;
        store->next[log] = 0;
    }
    uint32_t at = log * flash->erase_size + store->next[log]++ * store->stride;
    memset(store->scratch, 0xFF, store->stride);
    memcpy(store->scratch, record, RECORD_BYTES);
    status = flash->ops->program(flash->self, at, store->scratch, store->stride);
    if (status == PF_OK)
        status = flush(store);
    if (status == PF_OK)
        status = read_at(store, at, store->scratch, store->stride);
    if (status != PF_OK)
        return status;
    if (memcmp(store->scratch, record, RECORD_BYTES) != 0)
        return PF_ERR_IO;
    store->newest[log] = sequence;
    return PF_OK;
}

/* Makes `state` the one that counts. The log with the older record goes first: the other one, which may be the only one
 * that is intact, is erased only when this one has the new record. */
static pf_status append(pf_profile_store *store, pf_profile_store_state *state)
{
    uint32_t first = store->newest[1] < store->newest[0];
    bool is_last = store->state.sequence == INT32_MAX;
    state->sequence = is_last ? 1 : store->state.sequence + 1;
    for (uint32_t log = 0; log < 2; log++) {
        if (is_last) /* the numbers begin anew, with both logs */
            store->next[log] = store->per_sector;
        if (store->next[log] == store->per_sector)
            state->log_erases[log]++;
    }
    uint8_t record[RECORD_BYTES];
    put_record(state, record);
    pf_status status = append_to(store, first, record, state->sequence);
    if (status == PF_OK)
        status = append_to(store, 1 - first, record, state->sequence);
    if (status == PF_OK)
        store->state = *state;
    return status;
}

/* --------------------------------------------------------------------------------------------------- slots */

static uint32_t slot_at(const pf_profile_store *store, uint32_t slot)
{
    return (2 + slot * store->slot_sectors) * store->flash->erase_size;
}

/* Whether the slot holds what the record says. PF_OK, PF_ERR_CHECKSUM, PF_ERR_IO. */
static pf_status check_slot(const pf_profile_store *store, uint8_t slot)
{
    uint32_t left = store->state.length[slot], at = slot_at(store, slot), crc = 0;
    while (left > 0) {
        uint32_t n = left < CHUNK ? left : CHUNK;
        pf_status status = read_at(store, at, store->scratch, n);
        if (status != PF_OK)
            return status;
        crc = pf_crc32c(crc, store->scratch, n);
        at += n;
        left -= n;
    }
    return crc == store->state.crc[slot] ? PF_OK : PF_ERR_CHECKSUM;
}

pf_status pf_profile_store_load(const pf_profile_store *store, uint8_t *bytes, size_t capacity, size_t *n,
                                bool *is_trial)
{
    const pf_profile_store_state *state = &store->state;
    const uint8_t order[2] = {state->trial, state->active};
    pf_status status = PF_ERR_END;
    for (int i = 0; i < 2; i++) {
        uint8_t slot = order[i];
        if (slot == NONE)
            continue;
        uint32_t length = state->length[slot];
        if (capacity < length)
            return PF_ERR_SPACE;
        status = read_at(store, slot_at(store, slot), bytes, length);
        if (status != PF_OK)
            return status;
        status = pf_crc32c(0, bytes, length) == state->crc[slot] ? PF_OK : PF_ERR_CHECKSUM;
        if (status == PF_OK) {
            *n = length;
            if (is_trial)
                *is_trial = i == 0;
            return PF_OK;
        }
    }
    return status;
}

static pf_status erase_slot(pf_profile_store *store, uint8_t slot)
{
    const pf_flash *flash = store->flash;
    pf_status status = PF_OK;
    for (uint32_t i = 0; i < store->slot_sectors && status == PF_OK; i++)
        status = flash->ops->erase(flash->self, slot_at(store, slot) / flash->erase_size + i);
    return status;
}

static pf_status program_slot(pf_profile_store *store, uint8_t slot, const uint8_t *bytes, uint32_t n)
{
    const pf_flash *flash = store->flash;
    uint32_t unit = flash->program_size, at = slot_at(store, slot);
    uint32_t chunk = unit > CHUNK ? unit : CHUNK / unit * unit;
    for (uint32_t done = 0; done < n;) {
        uint32_t sector_left = flash->erase_size - done % flash->erase_size, count = n - done;
        count = count < chunk ? count : chunk;
        count = count < sector_left ? count : sector_left;
        uint32_t whole = round_up(count, unit);
        memset(store->scratch, 0xFF, whole);
        memcpy(store->scratch, bytes + done, count);
        pf_status status = flash->ops->program(flash->self, at + done, store->scratch, whole);
        if (status != PF_OK)
            return status;
        done += count;
    }
    return flush(store);
}

pf_status pf_profile_store_write(pf_profile_store *store, const uint8_t *bytes, size_t n, uint8_t starts)
{
    if (!bytes || n < 1 || n > PF_PROFILE_STORE_BYTES)
        return PF_ERR_ARGUMENT;
    pf_profile_store_state state = store->state;
    uint8_t slot = state.active != NONE ? (uint8_t)(1 - state.active) : (uint8_t)(state.trial == 0);
    pf_status status = PF_OK;
    if (state.trial == slot || state.previous == slot) { /* no record may name what is being erased */
        state.trial = state.trial == slot ? NONE : state.trial;
        state.previous = state.previous == slot ? NONE : state.previous;
        status = append(store, &state);
    }
    if (status == PF_OK)
        status = erase_slot(store, slot);
    if (status == PF_OK)
        status = program_slot(store, slot, bytes, (uint32_t)n);
    if (status != PF_OK)
        return status;
    store->state.slot_erases[slot] = ++state.slot_erases[slot];
    store->state.length[slot] = state.length[slot] = (uint32_t)n;
    store->state.crc[slot] = state.crc[slot] = pf_crc32c(0, bytes, n);
    status = check_slot(store, slot);
    if (status != PF_OK)
        return status == PF_ERR_CHECKSUM ? PF_ERR_IO : status;
    state.trial = slot;
    state.starts_left = starts;
    return append(store, &state);
}

/* ----------------------------------------------------------------------------------------- trial and start */

pf_status pf_profile_store_start(pf_profile_store *store)
{
    pf_profile_store_state state = store->state;
    bool changes = store->newest[0] != store->newest[1];
    if (state.trial != NONE) {
        pf_status status = check_slot(store, state.trial);
        if (status != PF_OK && status != PF_ERR_CHECKSUM)
            return status;
        changes = true;
        if (status != PF_OK || state.starts_left == 0)
            state.trial = NONE;
        else
            state.starts_left--;
    }
    return changes ? append(store, &state) : PF_OK;
}

pf_status pf_profile_store_confirm(pf_profile_store *store)
{
    pf_profile_store_state state = store->state;
    if (state.trial == NONE)
        return PF_ERR_END;
    pf_status status = check_slot(store, state.trial);
    if (status != PF_OK)
        return status;
    state.previous = state.active;
    state.active = state.trial;
    state.trial = NONE;
    state.starts_left = 0;
    return append(store, &state);
}

pf_status pf_profile_store_revert(pf_profile_store *store)
{
    pf_profile_store_state state = store->state;
    if (state.trial != NONE) {
        state.trial = NONE;
        state.starts_left = 0;
        return append(store, &state);
    }
    if (state.previous == NONE)
        return PF_ERR_END;
    pf_status status = check_slot(store, state.previous);
    if (status != PF_OK)
        return status;
    uint8_t previous = state.previous;
    state.previous = state.active;
    state.active = previous;
    return append(store, &state);
}
