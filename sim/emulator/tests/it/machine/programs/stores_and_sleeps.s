// Stores 42 and its stack pointer, then sleeps.
.include "program.inc"

    movs r0, #0x2A
    mov r1, #RESULTS
    str r0, [r1]
    mov r2, sp
    str r2, [r1, #4]
1:
    wfi
    b 1b
