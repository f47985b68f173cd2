// The thread goes to the process stack and calls SVC; logged: LR and MSP in the handler, the
// stacked PC, CONTROL and SP back in the thread.
.include "program.inc"
vector 11, call

    mov r6, #RESULTS
    ldr r0, =0x20008004
    msr psp, r0
    movs r0, #2
    msr control, r0
    isb
    svc #7
after:
    mrs r0, control
    str r0, [r6]
    mov r0, sp
    str r0, [r6, #4]
1:
    wfi
    b 1b

handler call
    str lr, [r6]
    mov r0, sp
    str r0, [r6, #4]
    mrs r0, psp
    str r0, [r6, #8]
    ldr r1, [r0, #24]
    str r1, [r6, #12]
    ldr r1, [r0, #28]
    str r1, [r6, #16]
    mrs r1, control
    str r1, [r6, #20]
    mrs r1, ipsr
    str r1, [r6, #24]
    adds r6, #28
    bx lr
    literals
