// Jumps to 2000_1000h once 2000_0200h holds 1.
.include "program.inc"

    ldr r0, =0x20000200
1:
    ldr r1, [r0]
    cmp r1, #1
    bne 1b
    ldr r0, =0x20001001
    bx r0
    literals
