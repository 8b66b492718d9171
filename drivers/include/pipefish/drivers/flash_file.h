/* A file that behaves like a flash memory, for the profile store on Linux. Its program unit is a page of 4096 bytes, so
 * that a write which power cuts short can spoil nothing beside it, also on a disk with sectors of that size. A flush
 * returns when the medium says that it has the data. One process at a time: the file is locked. */
#ifndef PIPEFISH_DRIVERS_FLASH_FILE_H
#define PIPEFISH_DRIVERS_FLASH_FILE_H

#include "pipefish/flash.h"

#define PF_FLASH_FILE_SECTORS      4u
#define PF_FLASH_FILE_ERASE_SIZE   16384u
#define PF_FLASH_FILE_PROGRAM_SIZE 4096u

typedef struct pf_flash_file_config {
    const char *path;  /* made, erased, if it is not there; its folder must exist */
    bool is_read_only; /* only looks: does not make or lock it; PF_ERR_END if it is not there */
} pf_flash_file_config;

/* Returns PF_OK; PF_ERR_FORMAT (the file has another size: not a store); PF_ERR_AGAIN (another process has it);
 * PF_ERR_END; PF_ERR_SPACE (it is not there, and its medium, full or read-only, takes none); PF_ERR_IO. error[n] says
 * why. */
pf_status pf_flash_file_open(pf_flash *flash, const pf_flash_file_config *config, char *error, size_t n);
void pf_flash_file_close(pf_flash *flash);

#endif
