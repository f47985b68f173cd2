@ A program with a hole inside a block, a hole over several blocks, initialised data that lies in flash and runs in
@ RAM, and an odd number of bytes. It is never run: counting bytes are in the place of all vectors but the first two.
    .section .vectors, "a"
    .word 0x20001000, reset
    .section .text, "ax"
    .thumb
    .set i, 0
    .macro count number
    .rept \number
    .byte (i * 7 + i / 256) & 0xFF
    .set i, i + 1
    .endr
    .endm
    count 504
    .global reset
    .thumb_func
reset:
    b .
    count 196
    .section .far, "a"
    .ascii "far away"
    .section .data, "aw"
    .ascii "initialised data."
