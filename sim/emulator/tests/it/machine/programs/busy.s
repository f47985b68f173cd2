// Works and is interrupted by SysTick every 1 000 cycles, for the comparison of two runs; keeps a
// checksum of what it saw.
.include "program.inc"
vector 15, tick

    mov r6, #RESULTS
    movs r0, #0
    str r0, [r6]
    str r0, [r6, #4]
    ldr r1, =SYSTICK
    movw r2, #999
    str r2, [r1, #4]
    str r0, [r1, #8]
    movs r2, #7
    str r2, [r1]
    movs r3, #1
1:
    ldr r2, [r1, #8]
    eors r3, r2
    lsls r4, r3, #5
    adds r3, r3, r4
    ldr r2, [r6]
    adds r3, r3, r2
    str r3, [r6, #4]
    tst r3, #0x40
    beq 1b
    push {r0, r1, r2, r3, r4, r5}
    pop {r0, r1, r2, r3, r4, r5}
    b 1b

handler tick
    mov r1, #RESULTS
    ldr r0, [r1]
    adds r0, #1
    str r0, [r1]
    bx lr
    literals
