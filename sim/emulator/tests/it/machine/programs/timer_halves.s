// TIM3 counts microseconds in its 16 bits. The handler counts the overflows at 2000_0000h and the
// matches of channel 1, in the middle of the range, at 2000_0004h.
.include "program.inc"
vector 45, tick

    mov r4, #RESULTS
    movs r0, #0
    str r0, [r4]
    str r0, [r4, #4]
    ldr r5, =RCC
    movs r0, #2
    str r0, [r5, #64]
    ldr r6, =TIM3
    movs r0, #15
    str r0, [r6, #40]
    movs r0, #4
    str r0, [r6]
    movs r0, #1
    str r0, [r6, #20]
    mov.w r0, #0x8000
    str r0, [r6, #52]
    movs r0, #3
    str r0, [r6, #12]
    mov r1, #0xE000E000
    mov r0, #RESULTS
    str r0, [r1, #0x100]
    movs r0, #1
    str r0, [r6]
1:
    wfi
    b 1b

handler tick
    ldr r1, =TIM3
    mov r2, #RESULTS
    ldr r0, [r1, #16]
    mvns r3, r0
    str r3, [r1, #16]
    lsls r3, r0, #31
    bpl 2f
    ldr r3, [r2]
    adds r3, #1
    str r3, [r2]
2:
    lsls r3, r0, #30
    bpl 3f
    ldr r3, [r2, #4]
    adds r3, #1
    str r3, [r2, #4]
3:
    bx lr
    literals
