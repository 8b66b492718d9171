/* A small flash memory (NOR flash, EEPROM, a file that behaves like one) as the profile store needs it.
 *
 * It is divided into sectors of erase_size bytes. Erased bytes are 0xFF; a program unit may be programmed once after it
 * was erased. All calls take offsets from the start of the area.
 *
 * Power may fail at any moment. Then the bytes of the operation under way are undefined, and each operation since the
 * last flush may have happened or not, whatever came after it; what was flushed is there.
 */
#ifndef PIPEFISH_FLASH_H
#define PIPEFISH_FLASH_H

#include "pipefish/base.h"

#ifdef __cplusplus
extern "C" {
#endif

/* All return PF_OK or PF_ERR_IO, then with the bytes of the operation undefined. */
typedef struct pf_flash_ops {
    pf_status (*read)(void *self, uint32_t at, void *bytes, uint32_t n);
    /* `at` and n are multiples of program_size; the range lies in one sector. */
    pf_status (*program)(void *self, uint32_t at, const void *bytes, uint32_t n);
    pf_status (*erase)(void *self, uint32_t sector);
    /* Everything before is durable before anything after begins. A memory without a cache has nothing to do. */
    pf_status (*flush)(void *self);
} pf_flash_ops;

typedef struct pf_flash {
    void *self;
    const pf_flash_ops *ops;
    uint32_t erase_size;   /* bytes of a sector, a multiple of program_size */
    uint32_t program_size; /* bytes of a program unit, 1 or more */
    uint32_t sectors;
} pf_flash;

#ifdef __cplusplus
}
#endif
#endif
