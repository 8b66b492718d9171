# Bare-metal Cortex-M, cross-compiled with Debian's gcc-arm-none-eabi and newlib; tests run on a board of
# qemu-system-arm and talk through semihosting. PIPEFISH_CPU: m0 (no FPU, no division; a micro:bit given more memory,
# for the tests' frames), m4 (single-precision FPU: doubles in software), m7 (double-precision FPU).
set(CMAKE_SYSTEM_NAME Generic)
set(PIPEFISH_CPU m7 CACHE STRING "m0, m4 or m7")
set(CMAKE_TRY_COMPILE_PLATFORM_VARIABLES PIPEFISH_CPU)
set(CMAKE_SYSTEM_PROCESSOR cortex-${PIPEFISH_CPU})
set(CMAKE_C_COMPILER arm-none-eabi-gcc)
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
set(fpu_m0 "-mfloat-abi=soft")
set(fpu_m4 "-mfpu=fpv4-sp-d16 -mfloat-abi=hard")
set(fpu_m7 "-mfpu=fpv5-d16 -mfloat-abi=hard")
set(board_m0 microbit -global nrf51-soc.flash-size=4194304 -global nrf51-soc.sram-size=4194304)
set(board_m4 mps2-an386)
set(board_m7 mps2-an500)
set(CMAKE_C_FLAGS_INIT
  "-mcpu=cortex-${PIPEFISH_CPU} -mthumb ${fpu_${PIPEFISH_CPU}} -ffunction-sections -fdata-sections")
set(CMAKE_CROSSCOMPILING_EMULATOR qemu-system-arm -M ${board_${PIPEFISH_CPU}} -nographic -monitor none -serial null
    -semihosting-config enable=on,target=native -kernel)
set(CMAKE_FIND_ROOT_PATH_MODE_PROGRAM NEVER)
