/* Start-up of a test program on bare metal (Cortex-M0 to M7): vectors, paint on the stack, memory, FPU, main, exit code
 * by semihosting. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

extern uint8_t image_data_from[], image_data_start[], image_data_end[], image_bss_start[], image_bss_end[];
extern uint8_t image_stack_top[];
extern void initialise_monitor_handles(void); /* newlib's semihosting: opens stdout */
extern int main(void);

void reset(void);
void fault(void);
uint32_t stack_used(void);
void _init(void);
void _fini(void);

/* newlib calls these two at start and end; C has nothing for them to do. */
void _init(void) {}
void _fini(void) {}

#define PAINT       0x5AFEC0DEu
#define STACK_BYTES 65536u /* looked after; the tests' deepest use is a sixth of it */

static volatile uint32_t *stack_bottom(void)
{
    return (volatile uint32_t *)(void *)(image_stack_top - STACK_BYTES);
}

/* Bytes of stack used so far. */
uint32_t stack_used(void)
{
    const volatile uint32_t *p = stack_bottom();
    while (*p == PAINT)
        p++;
    return (uint32_t)((uintptr_t)image_stack_top - (uintptr_t)p);
}

#define CPACR (*(volatile uint32_t *)0xE000ED88u) /* ARMv7-M B3.2.20: bits 20..23 give access to the FPU */

__attribute__((noreturn)) void reset(void)
{
#ifdef __ARM_FP
    CPACR |= 0xFu << 20;
    __asm volatile("dsb\n isb" ::: "memory");
#endif
    for (volatile uint32_t *p = stack_bottom(); (uintptr_t)p < (uintptr_t)__builtin_frame_address(0) - 64; p++)
        *p = PAINT;
    memcpy(image_data_start, image_data_from, (size_t)(image_data_end - image_data_start));
    memset(image_bss_start, 0, (size_t)(image_bss_end - image_bss_start));
    initialise_monitor_handles();
    exit(main());
}

/* Any fault ends the program with a failure instead of hanging until the timeout. */
void fault(void)
{
    _Exit(99);
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))image_stack_top,
    reset,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
    fault,
};
