// Line 0's handler sets FAULTMASK and returns; the thread logs FAULTMASK.
.include "program.inc"
vector 16, line0

    mov r6, #RESULTS
    ldr r5, =NVIC_ISER0
    movs r0, #1
    str r0, [r5]
    ldr r1, =STIR
    movs r0, #0
    str r0, [r1]
    dsb
    isb
    mrs r0, faultmask
    str r0, [r6]
1:
    wfi
    b 1b

handler line0
    cpsid f
    mrs r0, faultmask
    str r0, [r6, #4]
    bx lr
    literals
