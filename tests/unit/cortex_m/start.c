/* Start-up of a test program on the MPS2 AN500 (Cortex-M7): vectors, memory, FPU, main, exit code by semihosting. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

extern uint8_t image_data_from[], image_data_start[], image_data_end[], image_bss_start[], image_bss_end[];
extern uint8_t image_stack_top[];
extern void initialise_monitor_handles(void); /* newlib's semihosting: opens stdout */
extern int main(void);

void reset(void);
void fault(void);
void _init(void);
void _fini(void);

/* newlib calls these two at start and end; C has nothing for them to do. */
void _init(void) {}
void _fini(void) {}

#define CPACR (*(volatile uint32_t *)0xE000ED88u) /* ARMv7-M B3.2.20: bits 20..23 give access to the FPU */

__attribute__((noreturn)) void reset(void)
{
    CPACR |= 0xFu << 20;
    __asm volatile("dsb\n isb" ::: "memory");
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
