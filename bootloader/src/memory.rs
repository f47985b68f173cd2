//! Copy, move, fill and compare memory, in a tenth of the flash of the compiler's own versions.
//!
//! The linker prefers these functions to the weak symbols of `compiler_builtins`, which would not fit
//! into the 32 KiB of the compact map: 2.4 KiB in both parts. They go byte by byte, because the
//! bootloader moves little memory. They are in assembly because the compiler would turn a loop in
//! Rust into a call of the function itself.

use core::arch::global_asm;

// The base procedure call standard (AAPCS): r0 is the destination, r1 the source or value, r2 the
// length; r0–r3 and r12 may be changed. In the run-time ABI (RTABI 4.3.4) memset has its arguments
// in the other order, and no result.
global_asm!(
    ".section .text.memory, \"ax\"",
    ".syntax unified",
    ".macro function name",
    ".global \\name",
    ".type \\name,%function",
    ".thumb_func",
    "\\name:",
    ".endm",
    // It goes downwards if the source lies below the destination, so that the bytes in the overlap
    // are read before they are overwritten.
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
