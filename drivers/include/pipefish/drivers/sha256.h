/* SHA-256 (FIPS 180-4) of bytes and of images, by OpenSSL's libcrypto. */
#ifndef PIPEFISH_DRIVERS_SHA256_H
#define PIPEFISH_DRIVERS_SHA256_H

#include "pipefish/image.h"

/* PF_OK; PF_ERR_IO (libcrypto failed; out is undefined). */
pf_status pf_sha256(const void *bytes, size_t n, uint8_t out[32]);

/* Of the width x height pixels row by row, without the padding of the stride: the hash that recordings state.
 * PF_OK; PF_ERR_ARGUMENT (no pixels, stride < width); PF_ERR_IO. */
pf_status pf_sha256_image(const pf_image *image, uint8_t out[32]);

#endif
