// SCR.SLEEPONEXIT: the thread never runs again; the handler counts.
.include "program.inc"
vector 15, tick

    mov r6, #RESULTS
    movs r0, #0
    str r0, [r6]
    str r0, [r6, #4]
    ldr r1, =SCR
    movs r0, #2
    str r0, [r1]
    movs r0, #0
    ldr r1, =SYSTICK
    movw r2, #15999
    str r2, [r1, #4]
    str r0, [r1, #8]
    movs r2, #7
    str r2, [r1]
    wfi
1:
    ldr r0, [r6, #4]
    adds r0, #1
    str r0, [r6, #4]
    b 1b

handler tick
    ldr r0, [r6]
    adds r0, #1
    str r0, [r6]
    bx lr
    literals
