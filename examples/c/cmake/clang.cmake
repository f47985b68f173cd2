# The compiler for the chip: clang, with the linker of GNU binutils (arm-none-eabi-ld). Any other linker that clang takes:
# cmake -DCOBOOT_LD=...
set(CMAKE_SYSTEM_NAME Generic)
set(CMAKE_SYSTEM_PROCESSOR cortex-m4)
set(CMAKE_C_COMPILER clang)
# Another one for C: CLANG=clang-19 cmake ...
if(DEFINED ENV{CLANG})
    set(CMAKE_C_COMPILER "$ENV{CLANG}")
endif()
set(CMAKE_CXX_COMPILER clang++)
set(CMAKE_C_COMPILER_TARGET thumbv7em-none-eabi)
set(CMAKE_CXX_COMPILER_TARGET thumbv7em-none-eabi)
# What is compiled to try the compiler is not linked: it has no linker script.
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
find_program(COBOOT_LD NAMES arm-none-eabi-ld ld.lld)
set(CMAKE_EXE_LINKER_FLAGS_INIT "--ld-path=${COBOOT_LD}")
# Soft float: the programs here keep the FPU off.
set(CMAKE_C_FLAGS_INIT "-mcpu=cortex-m4 -mfloat-abi=soft")
set(CMAKE_CXX_FLAGS_INIT "${CMAKE_C_FLAGS_INIT}")
