// Functions that are worth compiling for wider vectors too; the one that the processor can run is chosen when the
// program is loaded. Without contraction (cmake) every width gives the same bits.
#pragma once

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define PIPEFISH_WIDE __attribute__((target_clones("default", "avx2")))
#else
#define PIPEFISH_WIDE
#endif
