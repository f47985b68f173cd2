// In 64 rounds the first load from a page of flash, within an IT block; after the block four
// additions of 1. Their sum at 2000_0000h.
.include "program.inc"

    ldr r2, =0x08010000
    movs r5, #0
    movs r6, #0x40
loop:
    cmp r2, r2
    ittee eq
    ldreq r1, [r2]
    moveq r3, #0
    movne r3, #1
    movne r3, #2
    b 1f
1:
    adds r5, #1
    adds r5, #1
    adds r5, #1
    adds r5, #1
    add r2, r2, #0x1000
    subs r6, #1
    bne loop
    mov r0, #RESULTS
    str r5, [r0]
2:
    wfi
    b 2b
    literals
