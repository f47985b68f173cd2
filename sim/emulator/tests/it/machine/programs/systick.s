// SysTick every 16 000 cycles; its handler counts at 2000_0000h. The loop counts its wake-ups at
// 2000_0004h.
.include "program.inc"
vector 15, tick

    mov r4, #RESULTS
    movs r0, #0
    str r0, [r4]
    str r0, [r4, #4]
    ldr r1, =SYSTICK
    movw r2, #15999
    str r2, [r1, #4]
    str r0, [r1, #8]
    movs r2, #7
    str r2, [r1]
1:
    wfi
    ldr r0, [r4, #4]
    adds r0, #1
    str r0, [r4, #4]
    b 1b

handler tick
    mov r1, #RESULTS
    ldr r0, [r1]
    adds r0, #1
    str r0, [r1]
    bx lr
    literals
