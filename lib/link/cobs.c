/* Consistent overhead byte stuffing (Cheshire and Baker 1999): no zero inside a frame, at most one byte in 254 more. */
#include "pipefish/link.h"

size_t pf_cobs_encode(const uint8_t *bytes, size_t n, uint8_t *out)
{
    size_t code_at = 0, written = 1;
    uint8_t code = 1;
    for (size_t i = 0; i < n; i++) {
        if (bytes[i] != 0) {
            out[written++] = bytes[i];
            code++;
        }
        /* A full block of 254 is closed only if something follows: the last block's end is the frame's end. */
        if (bytes[i] == 0 || (code == 0xFF && i + 1 < n)) {
            out[code_at] = code;
            code_at = written++;
            code = 1;
        }
    }
    out[code_at] = code;
    return written;
}

pf_status pf_cobs_decode(const uint8_t *bytes, size_t n, uint8_t *out, size_t *n_out)
{
    size_t read = 0, written = 0;
    if (n == 0)
        return PF_ERR_FORMAT;
    while (read < n) {
        size_t code = bytes[read++];
        if (code == 0 || code - 1 > n - read)
            return PF_ERR_FORMAT;
        for (size_t i = 1; i < code; i++) {
            if (bytes[read] == 0)
                return PF_ERR_FORMAT;
            out[written++] = bytes[read++];
        }
        if (code != 0xFF && read < n)
            out[written++] = 0;
    }
    *n_out = written;
    return PF_OK;
}
