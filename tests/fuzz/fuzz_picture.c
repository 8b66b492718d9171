/* PNG, JPEG and PGM. Invariants: a refused picture says why; the decoder
 * writes exactly the pixels it promised (AddressSanitizer watches), and promises the same size twice. */
#include "replay.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define PIXELS_MAX (1u << 20) /* larger ones only cost time */

static void require(bool holds)
{
    if (!holds)
        abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    pf_picture picture = {"some.img", data, size, NULL, 0};
    pf_failure failure = {""};
    uint32_t width = 0, height = 0;
    if (pf_picture_size(&picture, &width, &height, &failure) != PF_OK) {
        require(strncmp(failure.text, "some.img: ", 10) == 0);
        return 0;
    }
    require(width > 0 && height > 0 && width <= PF_IMAGE_SIZE_MAX && height <= PF_IMAGE_SIZE_MAX);
    if ((uint64_t)width * height > PIXELS_MAX)
        return 0;
    uint8_t *pixels = malloc((size_t)width * height);
    require(pixels != NULL);
    if (pf_picture_decode(&picture, width, height, pixels, &failure) != PF_OK)
        require(strncmp(failure.text, "some.img: ", 10) == 0);
    free(pixels);
    free(picture.scratch);
    return 0;
}
