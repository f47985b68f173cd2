@ A program with a hole inside a block, a hole over several blocks, initialised data that lies in flash and runs in
@ RAM, and an odd number of bytes. It is never run.
    .section .vectors, "a"
    .word 0x20001000, 0x08010009
    .section .text, "ax"
    .thumb
    b .
    .set i, 0
    .rept 700
    .byte (i * 7 + i / 256) & 0xFF
    .set i, i + 1
    .endr
    .section .far, "a"
    .ascii "far away"
    .section .data, "aw"
    .ascii "initialised data."
