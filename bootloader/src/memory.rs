//! Moving memory, in a tenth of the flash that the compiler's own versions take.
//!
//! The linker prefers these to the weak symbols of `compiler_builtins`. They go byte by byte: what
//! the bootloader moves is small, and the flash is the bottleneck. Written in assembly because a
//! loop in Rust would be compiled into a call of itself.

use core::arch::global_asm;

// The base procedure call standard (AAPCS): r0 destination, r1 source or value, r2 length; r0–r3
// and r12 may be used. The run-time ABI (RTABI 4.3.4) has memset's arguments the other way round,
// and no result.
global_asm!(
    ".section .text.memory, \"ax\"",
    ".syntax unified",
    ".macro function name",
    ".global \\name",
    ".type \\name,%function",
    ".thumb_func",
    "\\name:",
    ".endm",
    // Downwards if the source lies below the destination, so that an overlap is read before it is
    // overwritten.
    "function memmove",
    "function __aeabi_memmove",
    "function __aeabi_memmove4",
    "function __aeabi_memmove8",
    "cmp r1, r0",
    "bhs memcpy",
    "0: subs r2, #1",
    "bmi 1f",
    "ldrb r3, [r1, r2]",
    "strb r3, [r0, r2]",
    "b 0b",
    "1: bx lr",
    "function memcpy",
    "function __aeabi_memcpy",
    "function __aeabi_memcpy4",
    "function __aeabi_memcpy8",
    "mov r12, r0",
    "0: subs r2, #1",
    "bmi 1f",
    "ldrb r3, [r1], #1",
    "strb r3, [r12], #1",
    "b 0b",
    "1: bx lr",
    "function __aeabi_memclr",
    "function __aeabi_memclr4",
    "function __aeabi_memclr8",
    "movs r2, #0",
    "function __aeabi_memset",
    "function __aeabi_memset4",
    "function __aeabi_memset8",
    "mov r3, r1",
    "mov r1, r2",
    "mov r2, r3",
    "function memset",
    "mov r12, r0",
    "0: subs r2, #1",
    "bmi 1f",
    "strb r1, [r12], #1",
    "b 0b",
    "1: bx lr",
    "function memcmp",
    "function bcmp",
    "mov r12, r0",
    "movs r0, #0",
    "0: subs r2, #1",
    "bmi 1f",
    "ldrb r0, [r12], #1",
    "ldrb r3, [r1], #1",
    "subs r0, r0, r3",
    "beq 0b",
    "1: bx lr",
);
