#include "pipefish/base.h"

const char *pf_status_text(pf_status status)
{
    switch (status) {
    case PF_OK:
        return "ok";
    case PF_ERR_ARGUMENT:
        return "invalid argument";
    case PF_ERR_DOMAIN:
        return "outside the domain";
    case PF_ERR_FORMAT:
        return "malformed data";
    case PF_ERR_CHECKSUM:
        return "damaged data (checksum)";
    case PF_ERR_VERSION:
        return "unknown version";
    case PF_ERR_TRUNCATED:
        return "data end too early";
    case PF_ERR_SPACE:
        return "not enough space";
    case PF_ERR_UNSUPPORTED:
        return "not supported";
    case PF_ERR_IO:
        return "input/output error";
    case PF_ERR_AGAIN:
        return "try again later";
    case PF_ERR_END:
        return "end of stream";
    case PF_ERR_CLOSED:
        return "closed by the other side";
    case PF_ERR_SELF_TEST:
        return "self-test failed";
    }
    return "unknown status";
}

/* One nibble at a time: a 64-byte table fits any cache and any flash, and at 3 Mbaud the checksum is not what costs. */
uint32_t pf_crc32c(uint32_t crc, const void *bytes, size_t n)
{
    static const uint32_t nibble[16] = {
        0x00000000u, 0x105EC76Fu, 0x20BD8EDEu, 0x30E349B1u, 0x417B1DBCu, 0x5125DAD3u, 0x61C69362u, 0x7198540Du,
        0x82F63B78u, 0x92A8FC17u, 0xA24BB5A6u, 0xB21572C9u, 0xC38D26C4u, 0xD3D3E1ABu, 0xE330A81Au, 0xF36E6F75u,
    };
    const uint8_t *p = bytes;
    crc = ~crc;
    for (size_t i = 0; i < n; i++) {
        crc ^= p[i];
        crc = (crc >> 4) ^ nibble[crc & 15u];
        crc = (crc >> 4) ^ nibble[crc & 15u];
    }
    return ~crc;
}
