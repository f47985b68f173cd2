// Falling edges at PC13 through EXTI line 13. The handler counts them at 2000_0000h and leaves the
// pending lines at 2000_0004h.
.include "program.inc"
vector 56, edge

    mov r4, #RESULTS
    movs r0, #0
    str r0, [r4]
    ldr r5, =RCC
    movs r0, #4
    str r0, [r5, #48]
    mov.w r0, #0x4000
    str r0, [r5, #68]
    ldr r6, =SYSCFG
    movs r0, #0x20
    str r0, [r6, #20]
    add r6, r6, #0x400
    mov.w r0, #0x2000
    str r0, [r6, #12]
    str r0, [r6]
    mov r1, #0xE000E000
    mov.w r0, #0x100
    str r0, [r1, #0x104]
1:
    wfi
    b 1b

handler edge
    ldr r1, =EXTI
    mov r2, #RESULTS
    ldr r3, [r1, #20]
    str r3, [r1, #20]
    str r3, [r2, #4]
    ldr r3, [r2]
    adds r3, #1
    str r3, [r2]
    bx lr
    literals
