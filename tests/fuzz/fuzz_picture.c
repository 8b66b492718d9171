/* PNG, JPEG and PGM; a PNG as it is, and with the checksums of its chunks repaired, without which hardly a changed one
 * gets past its header. Invariants: a refused picture says why; the decoder writes exactly the pixels it promised
 * (AddressSanitizer watches). */
#include "replay.h"

#include <stdlib.h>
#include <string.h>
#include <zlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define PIXELS_MAX (1u << 20) /* larger ones only cost time */

static void require(bool holds)
{
    if (!holds)
        abort();
}

static uint32_t get_be(const uint8_t *b)
{
    return (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3];
}

/* Of every chunk that is whole: length, type, the data, checksum of type and data. */
static void repair_chunks(uint8_t *png, size_t size)
{
    for (size_t at = 8; at + 12 <= size;) {
        size_t n = get_be(png + at);
        if (n > size - at - 12)
            return;
        uLong crc = crc32(0, png + at + 4, (uInt)n + 4);
        for (int i = 0; i < 4; i++)
            png[at + 8 + n + (size_t)i] = (uint8_t)(crc >> (24 - 8 * i));
        at += 12 + n;
    }
}

static void try_picture(const uint8_t *data, size_t size)
{
    pf_picture picture = {"some.img", data, size, NULL, 0};
    pf_failure failure = {""};
    uint32_t width = 0, height = 0;
    if (pf_picture_size(&picture, &width, &height, &failure) != PF_OK) {
        require(strncmp(failure.text, "some.img: ", 10) == 0);
        return;
    }
    require(width > 0 && height > 0 && width <= PF_IMAGE_SIZE_MAX && height <= PF_IMAGE_SIZE_MAX);
    if ((uint64_t)width * height > PIXELS_MAX)
        return;
    uint8_t *pixels = malloc((size_t)width * height);
    require(pixels != NULL);
    if (pf_picture_decode(&picture, width, height, pixels, &failure) != PF_OK)
        require(strncmp(failure.text, "some.img: ", 10) == 0);
    free(pixels);
    free(picture.scratch);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    try_picture(data, size);
    if (size > 8 && data[0] == 0x89) {
        uint8_t *repaired = malloc(size);
        require(repaired != NULL);
        memcpy(repaired, data, size);
        repair_chunks(repaired, size);
        if (memcmp(repaired, data, size) != 0)
            try_picture(repaired, size);
        free(repaired);
    }
    return 0;
}
