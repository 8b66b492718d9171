/* golden_replay FRAMES: prints the hash of the sequence of golden.h, for the long tests. */
#include <stdio.h>
#include <stdlib.h>

#include "golden.h"

int main(int argc, char **argv)
{
    golden g;
    if (argc != 2 || !golden_replay((uint32_t)strtoul(argv[1], NULL, 10), &g)) {
        (void)fprintf(stderr, "usage: golden_replay FRAMES\n");
        return 2;
    }
    printf("%08x %u tracked %u keyframes\n", (unsigned)g.crc, (unsigned)g.tracked, (unsigned)g.keyframes);
    return 0;
}
