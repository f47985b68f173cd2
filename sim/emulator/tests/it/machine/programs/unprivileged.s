// Pends line 0 (priority 80h) under BASEPRI 80h and drops its privilege; counts at 2000_0000h, up
// to 1 000, then SVC clears BASEPRI. The handlers log at 2000_0004h (line 0: the count) and
// 2000_0008h (CONTROL as SVC sees it).
.include "program.inc"
vector 11, call
vector 16, line0

    mov r6, #RESULTS
    movs r4, #0
    str r4, [r6, #4]
    ldr r5, =NVIC_ISER0
    movs r0, #1
    str r0, [r5]
    ldr r1, =NVIC_IPR0
    movs r0, #0x80
    strb r0, [r1]
    msr basepri, r0
    movs r2, #1
    ldr r1, =NVIC_ISPR0
    str r2, [r1]
    msr control, r2
    isb
1:
    adds r4, #1
    str r4, [r6]
    movs r0, #0
    msr basepri, r0
    cmp r4, #1000
    bne 1b
    svc #0
    b .

handler line0
    ldr r0, [r6]
    str r0, [r6, #4]
    bx lr

handler call
    movs r0, #0
    msr basepri, r0
    mrs r0, control
    str r0, [r6, #8]
    bx lr
    literals
