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

/* The two nibbles of a byte at once: 128 bytes of tables fit any cache and any flash, and neither look-up waits for the
 * other. */
uint32_t pf_crc32c(uint32_t crc, const void *bytes, size_t n)
{
    static const uint32_t low[16] = {
        0x00000000u, 0xF26B8303u, 0xE13B70F7u, 0x1350F3F4u, 0xC79A971Fu, 0x35F1141Cu, 0x26A1E7E8u, 0xD4CA64EBu,
        0x8AD958CFu, 0x78B2DBCCu, 0x6BE22838u, 0x9989AB3Bu, 0x4D43CFD0u, 0xBF284CD3u, 0xAC78BF27u, 0x5E133C24u,
    };
    static const uint32_t high[16] = {
        0x00000000u, 0x105EC76Fu, 0x20BD8EDEu, 0x30E349B1u, 0x417B1DBCu, 0x5125DAD3u, 0x61C69362u, 0x7198540Du,
        0x82F63B78u, 0x92A8FC17u, 0xA24BB5A6u, 0xB21572C9u, 0xC38D26C4u, 0xD3D3E1ABu, 0xE330A81Au, 0xF36E6F75u,
    };
    const uint8_t *p = bytes;
    crc = ~crc;
    for (size_t i = 0; i < n; i++) {
        uint32_t byte = (crc ^ p[i]) & 0xFFu;
        crc = (crc >> 8) ^ low[byte & 15u] ^ high[byte >> 4];
    }
    return ~crc;
}
