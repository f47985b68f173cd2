// TIM2 has a period of 16 000 cycles; the handler counts at 2000_0000h and leaves the counter at
// 2000_0004h. The program writes to port D all the time and never sleeps.
.include "program.inc"
vector 44, tick

    mov r4, #RESULTS
    movs r0, #0
    str r0, [r4]
    ldr r5, =RCC
    movs r0, #8
    str r0, [r5, #48]
    movs r0, #1
    str r0, [r5, #64]
    overflows_of_tim2
    movs r0, #1
    str r0, [r6]
    ldr r7, =GPIOD
1:
    str r0, [r7, #20]
    str r0, [r7, #20]
    str r0, [r7, #20]
    b 1b

handler tick
    mov r1, #0x40000000
    mov r2, #RESULTS
    movs r3, #0
    str r3, [r1, #16]
    ldr r3, [r2]
    adds r3, #1
    str r3, [r2]
    ldr r3, [r1, #36]
    str r3, [r2, #4]
    bx lr
    literals
