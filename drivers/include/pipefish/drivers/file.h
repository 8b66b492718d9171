/* Files that are there whole or not at all. */
#ifndef PIPEFISH_DRIVERS_FILE_H
#define PIPEFISH_DRIVERS_FILE_H

#include "pipefish/base.h"

/* Replaces or makes a file of mode 0600: on the disk when it returns, whatever power does in between. PF_OK; PF_ERR_IO:
 * error[n] says what. */
pf_status pf_file_replace(const char *path, const void *bytes, size_t size, char *error, size_t n);

/* Puts the folder of `path` on the disk, and with it the renames in it. False: errno says why. */
bool pf_file_sync_folder(const char *path);

#endif
