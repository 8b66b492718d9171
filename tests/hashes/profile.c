/* Encoding with the integer self-test, decoding, checking, and encoding again. */
#include "cameras.h"
#include "hashes.h"
#include "pipefish/profile_integers.h"

#include <string.h>

static pf_profile profile, back;
static uint8_t bytes[2][PF_PROFILE_BINARY_MAX];
static _Alignas(16) uint8_t workspace[32768];

uint32_t hash_profile(size_t *ram)
{
    uint32_t crc = 0;
    *ram = sizeof profile + PF_PROFILE_BINARY_MAX + sizeof workspace;
    for (size_t c = 0; c < CAMERAS_COUNT; c++) {
        size_t n = 0, again = 0;
        memset(&profile, 0, sizeof profile);
        profile.camera = CAMERAS[c];
        memcpy(profile.name, "hash", 5);
        profile.source = PF_SOURCE_TARGET;
        profile.rms_px = 0.25;
        profile.free_count = 4;
        for (uint32_t i = 0; i < 4; i++) {
            profile.free_param[i] = (uint8_t)(i < 2 ? i : i + 1);
            profile.covariance[i * (i + 1) / 2 + i] = 0.125 * (i + 1);
        }
        if (pf_profile_integers_make(&profile, workspace, sizeof workspace) != PF_OK ||
            pf_profile_encode(&profile, bytes[0], sizeof bytes[0], &n, NULL) != PF_OK ||
            pf_profile_decode(bytes[0], n, &back, NULL) != PF_OK ||
            pf_profile_integers_check(&back, workspace, sizeof workspace, NULL) != PF_OK ||
            pf_profile_encode(&back, bytes[1], sizeof bytes[1], &again, NULL) != PF_OK || n != again ||
            memcmp(bytes[0], bytes[1], n) != 0)
            return 0;
        crc = pf_crc32c(crc, bytes[0], n);
        bytes[0][n / 2] ^= 1;
        crc = hash_u32(crc, (uint32_t)pf_profile_decode(bytes[0], n, &back, NULL));
    }
    return crc;
}
