// TIM2 has a period of 16 000 cycles, SysTick one of 160 000, and the core sleeps between them. The
// handlers count at 2000_0000h and 2000_0004h. RCC_APB1LPENR is what 2000_0100h has.
.include "program.inc"
vector 15, tick
vector 44, overflow

    mov r4, #RESULTS
    movs r0, #0
    str r0, [r4]
    str r0, [r4, #4]
    ldr r5, =RCC
    movs r0, #1
    str r0, [r5, #0x40]
    ldr r0, =ARGUMENT
    ldr r0, [r0]
    str r0, [r5, #0x60]
    overflows_of_tim2
    ldr r1, =SYSTICK
    ldr r0, =159999
    str r0, [r1, #4]
    str r0, [r1, #8]
    movs r0, #7
    str r0, [r1]
    movs r0, #1
    str r0, [r6]
1:
    wfi
    b 1b

handler overflow
    mov r1, #0x40000000
    movs r3, #0
    str r3, [r1, #16]
    mov r2, #RESULTS
    ldr r3, [r2]
    adds r3, #1
    str r3, [r2]
    bx lr

handler tick
    mov r2, #RESULTS
    ldr r3, [r2, #4]
    adds r3, #1
    str r3, [r2, #4]
    bx lr
    literals
