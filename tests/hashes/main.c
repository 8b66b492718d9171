/* Runs one room's hash or all (HASH_ROOMS) and prints, a line a room: name, hash, bytes lent, bytes of stack (bare
 * metal only, from the paint that start.c left). Exit code 1 if a hash is not the constant. */
#include "hashes.h"

#include <inttypes.h>
#include <stdio.h>

#ifdef HASH_STACK
uint32_t stack_used(void);
#else
static uint32_t stack_used(void)
{
    return 0;
}
#endif

static const struct room {
    const char *name;
    uint32_t (*run)(size_t *ram);
    uint32_t expected;
} ROOMS[] = {HASH_ROOMS};

int main(void)
{
    int wrong = 0;
    for (size_t i = 0; i < sizeof ROOMS / sizeof ROOMS[0]; i++) {
        size_t ram;
        const uint32_t hash = ROOMS[i].run(&ram), stack = stack_used();
        printf("%s 0x%08" PRIX32 " %u %u%s\n", ROOMS[i].name, hash, (unsigned)ram, (unsigned)stack,
               hash == ROOMS[i].expected ? "" : " WRONG");
        wrong |= hash != ROOMS[i].expected;
    }
    return wrong;
}
