/* Y4M, tried as it is and as what follows a valid beginning of the header. Invariants: a refused file says why; every
 * frame that an accepted one promises can be read. */
#include "replay.h"

#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void require(bool holds)
{
    if (!holds)
        abort();
}

static void try_file(const char *beginning, const uint8_t *data, size_t size)
{
    pf_y4m y4m;
    pf_failure failure = {""};
    int fd = memfd_create("y4m", MFD_CLOEXEC);
    require(fd >= 0);
    require(write(fd, beginning, strlen(beginning)) == (ssize_t)strlen(beginning));
    require(write(fd, data, size) == (ssize_t)size);
    if (pf_y4m_open_fd(&y4m, fd, "some.y4m", &failure) != PF_OK) {
        require(strncmp(failure.text, "some.y4m: ", 10) == 0);
        return;
    }
    size_t pixels = (size_t)y4m.width * y4m.height;
    require(pixels > 0 && pixels <= size && y4m.frames > 0 && y4m.frames <= size);
    uint8_t *frame = malloc(pixels);
    require(frame != NULL);
    for (uint64_t i = 0; i < y4m.frames; i++)
        require(pf_y4m_read(&y4m, i, frame, &failure) == PF_OK);
    free(frame);
    pf_y4m_close(&y4m);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    try_file("", data, size);
    try_file("YUV4MPEG2 W4 H2 ", data, size);
    return 0;
}
