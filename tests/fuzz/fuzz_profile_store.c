/* The profile store on a flash memory with any content. The input's first byte chooses the geometry and whether the
 * checksums of the records are repaired; the rest lies in the logs and slots.
 * Invariants: whatever the content, opening, starting, loading and writing end, keep to the rules of flash memory and
 * stay in the buffers; what is written afterwards is loaded, unless the store belongs to a newer program. */
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

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static uint8_t workspace[256 * 1024], scratch[512], bytes[PF_PROFILE_STORE_BYTES], again[PF_PROFILE_STORE_BYTES];
    pf_sim_flash *sim;
    pf_flash flash;
    pf_profile_store store;
    size_t n = 0;
    bool is_trial;
    if (size < 2)
        return 0;
    const pf_sim_flash_config *config = &GEOMETRY[data[0] % 4];
    uint32_t stride = config->program_size > 64 ? config->program_size : 64;
    require(pf_sim_flash_init(&sim, &flash, config, workspace, sizeof workspace) == PF_OK);
    require(pf_profile_store_scratch_size(&flash) <= sizeof scratch);
    for (uint32_t i = 1; i < size && i - 1 < config->erase_size * config->sectors; i++)
        set_byte(sim, &flash, i - 1, data[i]);
    if (data[0] & 4)
        repair_records(sim, &flash, stride);
    for (uint32_t i = 0; i < 2; i++) /* and into the slots */
        set_byte(sim, &flash, (2 + i * (config->sectors - 2) / 2) * config->erase_size, data[1]);

    pf_status status = pf_profile_store_open(&store, &flash, scratch);
    require(status == PF_OK || status == PF_ERR_VERSION);
    if (status != PF_OK)
        return 0;
    status = pf_profile_store_load(&store, bytes, sizeof bytes, &n, &is_trial);
    require(status == PF_OK || status == PF_ERR_END || status == PF_ERR_CHECKSUM);
    require(pf_profile_store_start(&store) == PF_OK);
    status = pf_profile_store_revert(&store);
    require(status == PF_OK || status == PF_ERR_END || status == PF_ERR_CHECKSUM);
    size_t length = size < sizeof bytes ? size : sizeof bytes;
    for (uint8_t round = 0; round < 2; round++) {
        require(pf_profile_store_write(&store, data, length, round) == PF_OK);
        require(pf_profile_store_open(&store, &flash, scratch) == PF_OK);
        require(pf_profile_store_load(&store, again, sizeof again, &n, &is_trial) == PF_OK && is_trial);
        require(n == length && memcmp(again, data, n) == 0);
        require(pf_profile_store_confirm(&store) == PF_OK);
    }
    require(pf_sim_flash_get_stats(sim)->violations == 0);
    return 0;
}
