// Line 0 at priority 80h is pended under BASEPRI 80h and under PRIMASK; the log at 2000_0000h
// shows when its handler (9) comes.
.include "program.inc"
vector 16, line0

    mov r6, #RESULTS
    ldr r5, =NVIC_ISER0
    movs r0, #1
    str r0, [r5]
    ldr r1, =NVIC_IPR0
    movs r0, #0x80
    strb r0, [r1]
    movs r0, #0x80
    msr basepri, r0
    movs r2, #1
    ldr r1, =NVIC_ISPR0
    str r2, [r1]
    dsb
    isb
    movs r0, #1
    str r0, [r6]
    adds r6, #4
    movs r0, #0
    msr basepri, r0
    isb
    movs r0, #2
    str r0, [r6]
    adds r6, #4
    cpsid i
    str r2, [r1]
    dsb
    wfi
    movs r0, #3
    str r0, [r6]
    adds r6, #4
    cpsie i
    isb
    movs r0, #4
    str r0, [r6]
    adds r6, #4
1:
    wfi
    b 1b

handler line0
    movs r0, #9
    str r0, [r6]
    adds r6, #4
    bx lr
    literals
