// Touches GPIOD without its clock, TIM2, and GPIOD with it.
.include "program.inc"

    mov r6, #RESULTS
    ldr r1, =GPIOD
    ldr r0, [r1]
    str r0, [r6]
    mov r2, #0x40000000
    movs r0, #1
again:
    str r0, [r2]
    ldr r3, =0x20000004
    ldr r5, [r3]
    subs r5, #1
    str r5, [r3]
    bne again
    ldr r2, =RCC_AHB1ENR
    movs r0, #8
    str r0, [r2]
    mov r0, #0x01000000
    str r0, [r1]
    mov.w r0, #0x1000
    str r0, [r1, #24]
    ldr r0, [r1, #16]
    str r0, [r6]
1:
    wfi
    b 1b
    literals
