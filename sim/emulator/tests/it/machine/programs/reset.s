// Logs RCC_CSR at 2000_0010h, counts its starts at 2000_0000h, and asks for a system reset the
// first time.
.include "program.inc"

    mov r6, #RESULTS
    ldr r1, =RCC_CSR
    ldr r0, [r1]
    str r0, [r6, #16]
    mov r0, #0x01000000
    str r0, [r1]
    ldr r0, [r6]
    adds r0, #1
    str r0, [r6]
    cmp r0, #1
    bne 1f
    ldr r1, =AIRCR
    ldr r0, =0x05FA0004         // SYSRESETREQ
    str r0, [r1]
    dsb
    b .
1:
    wfi
    b 1b
    literals
