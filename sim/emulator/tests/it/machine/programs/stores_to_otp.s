// Stores to the one-time programmable bytes at 1FFF_7820h. 2000_0000h: what they read as afterwards.
.include "program.inc"

    movw r0, #0x7820
    movt r0, #0x1FFF
    str r0, [r0]
    ldr r1, [r0]
    movs r2, #1
    lsls r2, r2, #29
    str r1, [r2]
    b .
