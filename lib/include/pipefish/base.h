/* Conventions and status codes of the Pipefish core. Every other header of lib includes this one.
 *
 * Conventions, everywhere unless a name says otherwise:
 *   pixels      centre of the top-left pixel is (0, 0); u right, v down
 *   camera      x right, y down, z along the optical axis; rays are unit vectors (180 degrees and beyond are ordinary)
 *   angles      radians; lengths metres
 *   time        nanoseconds of the device's monotonic clock; meaningful only together with the boot id
 *   bytes       little-endian on the wire and in stored files
 *   fixed point the Q format is in the name: x_q16 is Q16.16, ray_q30 is Q1.30
 *   memory      lib never allocates and keeps no global state; a room that needs memory has pf_X_workspace_size() and
 *               takes the caller's block, 16-byte aligned, at init
 */
#ifndef PIPEFISH_BASE_H
#define PIPEFISH_BASE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PF_VERSION_MAJOR 0
#define PF_VERSION_MINOR 1
#define PF_VERSION_PATCH 0

/* Result of every function that can fail: zero or negative. Results come through pointers. */
typedef enum pf_status {
    PF_OK = 0,
    PF_ERR_ARGUMENT = -1,  /* the call itself is wrong: null, out of range, sizes differ */
    PF_ERR_DOMAIN = -2,    /* the value lies outside what the model covers (behind, beyond theta_max, off the image) */
    PF_ERR_FORMAT = -3,    /* the bytes are not what they must be */
    PF_ERR_CHECKSUM = -4,  /* the bytes were damaged */
    PF_ERR_VERSION = -5,   /* written by a version that this one cannot read */
    PF_ERR_TRUNCATED = -6, /* the data end too early */
    PF_ERR_SPACE = -7,     /* the caller's buffer, or the medium, is too small */
    PF_ERR_UNSUPPORTED = -8, /* valid, but this build cannot do it */
    PF_ERR_IO = -9,          /* the operating system or the device failed */
    PF_ERR_AGAIN = -10,      /* nothing to do now; try again later */
    PF_ERR_END = -11,        /* the stream is complete */
    PF_ERR_CLOSED = -12,     /* the peer or the device has gone */
    PF_ERR_SELF_TEST = -13,  /* intact, but this device computes something else than the data say */
} pf_status;

typedef struct pf_point_q16 {
    int32_t x, y; /* Q16.16 pixels */
} pf_point_q16;

typedef struct pf_ray_q30 {
    int32_t x, y, z; /* Q1.30, a unit vector in the camera frame; (0, 0, 0) where there is none */
} pf_ray_q30;

/* One line of English for a status, never NULL. */
const char *pf_status_text(pf_status status);

/* CRC-32C (Castagnoli: polynomial 0x1EDC6F41 reflected, start and final xor 0xFFFFFFFF; RFC 3720 B.4) of n bytes,
 * continued from `crc` (0 to start). crc("123456789") = 0xE3069283. */
uint32_t pf_crc32c(uint32_t crc, const void *bytes, size_t n);

#ifdef __cplusplus
}
#endif
#endif
