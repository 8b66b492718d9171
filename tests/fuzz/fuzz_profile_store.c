/* The profile store on a flash memory with any content, and then through any story with power cuts. The input's first
 * byte chooses the geometry, whether the checksums of the records are repaired, how long the story is, and whether its
 * last profile is; the rest lies in the logs and slots, and its last bytes are the story. Invariants: whatever the
 * content, opening, starting, loading and writing end, keep to the rules of flash memory and stay in the buffers; what
 * is written afterwards is loaded, unless the store belongs to a newer program. From then on: wherever power fails,
 * what is loaded is what was loaded before or what would be without the cut (or, where one on trial is replaced, the
 * confirmed one), and always one that was written, whole; one with a flipped bit is not confirmed. */
#include "pipefish/drivers/sim_flash.h"
#include "pipefish/profile_store.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void require(bool holds)
{
    if (!holds)
        abort();
}

static const pf_sim_flash_config GEOMETRY[] = {
    {.erase_size = 4096, .program_size = 256, .sectors = 6},
    {.erase_size = 512, .program_size = 1, .sectors = 34},
    {.erase_size = 8192, .program_size = 8, .sectors = 4},
    {.erase_size = 64, .program_size = 64, .sectors = 258},
};

typedef struct device {
    pf_sim_flash *sim;
    pf_flash flash;
    pf_profile_store store;
    uint8_t scratch[512];
    _Alignas(16) uint8_t workspace[80 * 1024];
} device;

/* What is loaded: a profile's number, or NONE. */
enum { NONE = -1, STORY_END = 9 };

static bool has_longest; /* this input's last profile is as long as one can be */

/* Most of them short: their bytes cost time, and decide nothing. */
static uint32_t length_of(int number)
{
    return number == STORY_END - 1 && has_longest ? PF_PROFILE_STORE_BYTES
           : number % 4 == 3                      ? 300
                                                  : 1 + (uint32_t)number * 37 % 60;
}

static void make_profile(int number, uint8_t *bytes)
{
    memset(bytes, number ^ 0x5A, length_of(number));
    bytes[0] = (uint8_t)number;
}

static void set_byte(pf_sim_flash *sim, const pf_flash *flash, uint32_t at, uint8_t value)
{
    uint8_t now;
    require(flash->ops->read(flash->self, at, &now, 1) == PF_OK);
    for (uint32_t bit = 0; bit < 8; bit++)
        if ((now ^ value) >> bit & 1)
            pf_sim_flash_flip(sim, 8u * at + bit);
}

/* Records whose magic and checksum are right, on what the input says of the rest. */
static void repair_records(pf_sim_flash *sim, const pf_flash *flash, uint32_t stride)
{
    static const uint8_t start[8] = {'P', 'F', 'S', 'T', 1, 0, 0, 0};
    for (uint32_t log = 0; log < 2; log++)
        for (uint32_t i = 0; i < 2 && (i + 1) * stride <= flash->erase_size; i++) {
            uint32_t at = log * flash->erase_size + i * stride;
            uint8_t record[60];
            for (uint32_t j = 0; j < sizeof start; j++)
                set_byte(sim, flash, at + j, start[j]);
            require(flash->ops->read(flash->self, at, record, sizeof record) == PF_OK);
            uint32_t crc = pf_crc32c(0, record, sizeof record);
            for (uint32_t j = 0; j < 4; j++)
                set_byte(sim, flash, at + 60 + j, (uint8_t)(crc >> (8 * j)));
        }
}

static void start(device *d, const pf_sim_flash_config *config)
{
    require(pf_sim_flash_init(&d->sim, &d->flash, config, d->workspace, sizeof d->workspace) == PF_OK);
    require(pf_profile_store_scratch_size(&d->flash) <= sizeof d->scratch);
}

static void reopen(device *d)
{
    require(pf_profile_store_open(&d->store, &d->flash, d->scratch) == PF_OK);
}

/* Whole, as it was written, or nothing. */
static int load(const pf_profile_store *store)
{
    static uint8_t bytes[PF_PROFILE_STORE_BYTES], written[PF_PROFILE_STORE_BYTES];
    size_t n = 0;
    pf_status status = pf_profile_store_load(store, bytes, sizeof bytes, &n, NULL);
    if (status != PF_OK) {
        require(status == PF_ERR_END || status == PF_ERR_CHECKSUM);
        return NONE;
    }
    make_profile(bytes[0], written);
    require(n == length_of(bytes[0]) && memcmp(bytes, written, n) == 0);
    return bytes[0];
}

static int load_confirmed(const device *d)
{
    pf_profile_store store = d->store;
    store.state.trial = PF_PROFILE_STORE_NONE;
    return load(&store);
}

static pf_status write(device *d, int number, uint8_t starts)
{
    static uint8_t bytes[PF_PROFILE_STORE_BYTES];
    make_profile(number, bytes);
    return pf_profile_store_write(&d->store, bytes, length_of(number), starts);
}

static pf_status do_step(device *d, uint8_t step, int number)
{
    switch (step & 3) {
    case 0:
        return write(d, number, step >> 2 & 3);
    case 1:
        reopen(d);
        return pf_profile_store_start(&d->store);
    case 2:
        return pf_profile_store_confirm(&d->store);
    default:
        return pf_profile_store_revert(&d->store);
    }
}

/* A bit of the trial's bytes: it is loaded no more, and not confirmed. */
static void flip_trial(device *d, uint8_t where)
{
    const pf_profile_store_state *state = &d->store.state;
    if (state->trial == PF_PROFILE_STORE_NONE)
        return;
    uint32_t at = (2 + state->trial * d->store.slot_sectors) * d->flash.erase_size;
    uint32_t bit = 8 * at + where * 7u % (8 * state->length[state->trial]);
    int confirmed = load_confirmed(d);
    pf_sim_flash_flip(d->sim, bit);
    require(pf_profile_store_confirm(&d->store) == PF_ERR_CHECKSUM);
    require(load(&d->store) == confirmed);
    pf_sim_flash_flip(d->sim, bit);
}

/* A step of two bytes on the device whose power fails on the way, if it does, and on one where it does not. */
static void go_on(device *d, device *twin, const uint8_t *step, int number)
{
    int before = load(&d->store), confirmed = load_confirmed(d);
    bool is_replaced = (step[0] & 3) == 0 && d->store.state.trial != PF_PROFILE_STORE_NONE;
    if (step[0] & 0x80)
        flip_trial(d, step[1]);
    device *whole = step[0] & 0x40 ? twin : d;
    if (whole == twin) {
        pf_sim_flash_copy(twin->sim, d->sim);
        reopen(twin);
    }
    pf_status status = do_step(whole, step[0], number);
    require(status == PF_OK || status == PF_ERR_END || status == PF_ERR_CHECKSUM);
    int after = load(&whole->store);
    require((step[0] & 3) != 0 || after == number);
    if (whole == twin) {
        pf_sim_flash_seed(d->sim, step[1]);
        pf_sim_flash_cut_after(d->sim, step[1] < 128 ? step[1] / 4 : step[1], (pf_sim_cut)(step[0] >> 4 & 3));
        (void)do_step(d, step[0], number);
    }
    bool is_cut = pf_sim_flash_is_off(d->sim);
    pf_sim_flash_power_on(d->sim);
    reopen(d);
    int now = load(&d->store);
    require(now == after || (is_cut && (now == before || (is_replaced && now == confirmed))));
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static device one, two;
    static uint8_t bytes[PF_PROFILE_STORE_BYTES];
    size_t n = 0;
    bool is_trial;
    if (size < 2)
        return 0;
    const pf_sim_flash_config *config = &GEOMETRY[data[0] % 4];
    uint32_t stride = config->program_size > 64 ? config->program_size : 64;
    has_longest = data[0] >> 7;
    start(&one, config);
    for (uint32_t i = 1; i < size && i - 1 < config->erase_size * config->sectors; i++)
        set_byte(one.sim, &one.flash, i - 1, data[i]);
    if (data[0] & 4)
        repair_records(one.sim, &one.flash, stride);
    for (uint32_t i = 0; i < 2; i++) /* and into the slots */
        set_byte(one.sim, &one.flash, (2 + i * (config->sectors - 2) / 2) * config->erase_size, data[1]);

    pf_status status = pf_profile_store_open(&one.store, &one.flash, one.scratch);
    require(status == PF_OK || status == PF_ERR_VERSION);
    if (status != PF_OK)
        return 0;
    status = pf_profile_store_load(&one.store, bytes, sizeof bytes, &n, &is_trial);
    require(status == PF_OK || status == PF_ERR_END || status == PF_ERR_CHECKSUM);
    require(pf_profile_store_start(&one.store) == PF_OK);
    status = pf_profile_store_revert(&one.store);
    require(status == PF_OK || status == PF_ERR_END || status == PF_ERR_CHECKSUM);
    for (uint8_t number = 0; number < 2; number++) {
        require(write(&one, number, number) == PF_OK);
        reopen(&one);
        require(load(&one.store) == number && one.store.state.trial != PF_PROFILE_STORE_NONE);
        require(pf_profile_store_confirm(&one.store) == PF_OK);
    }
    int end = data[0] & 8 ? 2 + (data[0] >> 4 & 7) : 2;
    if (end > 2)
        start(&two, config);
    for (int number = 2; number < end && 2 * (size_t)number - 2 <= size; number++)
        go_on(&one, &two, data + size + 2 - 2 * number, number);
    require(pf_sim_flash_get_stats(one.sim)->violations == 0);
    return 0;
}
