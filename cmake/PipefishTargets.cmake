# The compile flags every target of ours gets, and the two kinds of target.

# Warnings are errors. -ffp-contract=off: floating point must give the same bits on every target (DESIGN, "Fixed point
# and determinism"), so the compiler may not fuse a multiply and an add.
add_library(pipefish_flags INTERFACE)
target_compile_options(pipefish_flags INTERFACE
  -Wall -Wextra -Wconversion -Wshadow -Werror -ffp-contract=off
  $<$<COMPILE_LANGUAGE:C>:-Wstrict-prototypes -Wmissing-prototypes -Wvla>)
if(PIPEFISH_SANITIZE)
  set(PIPEFISH_SANITIZERS -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer)
  target_compile_options(pipefish_flags INTERFACE ${PIPEFISH_SANITIZERS})
  target_link_options(pipefish_flags INTERFACE ${PIPEFISH_SANITIZERS})
endif()

# pipefish_room(NAME sources...): a static library pf_NAME with the project's flags. Add what it may know of with
# target_link_libraries afterwards; the arrows of DESIGN point one way only.
function(pipefish_room name)
  add_library(pf_${name} STATIC ${ARGN})
  target_link_libraries(pf_${name} PRIVATE $<BUILD_INTERFACE:pipefish_flags>)
endfunction()

# pipefish_vectors(NAME sources...): adds vector kernels to a room, where there are vectors (PF_SIMD). They are written in
# NEON intrinsics; on x86 SIMDe's headers map these. x86-64-v2 (SSE4.2, every x86-64 since 2009) is all they use: v3
# (AVX2) gains 2 to 5 %, by instructions with three operands, and would exclude machines.
function(pipefish_vectors name)
  if(PF_SIMD)
    target_sources(pf_${name} PRIVATE ${ARGN})
    target_compile_definitions(pf_${name} PUBLIC PF_SIMD=1)
    if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
      set_source_files_properties(${ARGN} PROPERTIES COMPILE_OPTIONS -march=x86-64-v2)
    endif()
  endif()
endfunction()

# pipefish_bare_metal(TARGET): the program gets the board's start-up code and memory map.
if(CMAKE_SYSTEM_NAME STREQUAL "Generic")
  set(PIPEFISH_BARE_METAL ON)
  set(PIPEFISH_BOARD ${CMAKE_CURRENT_SOURCE_DIR}/tests/unit/cortex_m)
  add_library(cortex_m_start OBJECT EXCLUDE_FROM_ALL ${PIPEFISH_BOARD}/start.c)
  target_link_libraries(cortex_m_start PRIVATE pipefish_flags)
  function(pipefish_bare_metal target)
    target_sources(${target} PRIVATE $<TARGET_OBJECTS:cortex_m_start>)
    target_link_options(${target} PRIVATE --specs=rdimon.specs -nostartfiles -T ${PIPEFISH_BOARD}/board.ld
      -Wl,--gc-sections)
    set_target_properties(${target} PROPERTIES LINK_DEPENDS ${PIPEFISH_BOARD}/board.ld)
  endfunction()
endif()
