// Copies a vector table to 2000_1000h, moves VTOR there and calls SVC.
.include "program.inc"

    mov r6, #RESULTS
    ldr r1, =0x20001000
    ldr r0, =handler
    str r0, [r1, #44]
    ldr r2, =VTOR
    str r1, [r2]
    dsb
    isb
    svc #0
1:
    wfi
    b 1b

handler handler
    movs r0, #77
    str r0, [r6]
    bx lr
    literals
