/* One picture file as grey pixels: PNG, JPEG or PGM. */
#ifndef PIPEFISH_DRIVERS_PICTURE_H
#define PIPEFISH_DRIVERS_PICTURE_H

#include "pipefish/base.h"

/* Reads `path`; *pixels is width x height bytes, the caller's to free().
 * On failure nothing is written but error[n]: what and where. PF_ERR_IO, PF_ERR_FORMAT, PF_ERR_TRUNCATED,
 * PF_ERR_UNSUPPORTED, PF_ERR_SPACE. */
pf_status pf_picture_load(const char *path, uint32_t *width, uint32_t *height, uint8_t **pixels, char *error, size_t n);

#endif
