// Line 0 pends line 1 from its handler. What happens is logged from 2000_0000h on: 1 line 0
// starts, its LR; 2 line 1, its LR and its SP; 3 line 0 ends; 4 back in the thread. The priority
// of line 1 is taken from 2000_0100h.
.include "program.inc"
vector 16, line0
vector 17, line1

    mov r6, #RESULTS
    ldr r5, =NVIC_ISER0
    movs r0, #3
    str r0, [r5]
    ldr r1, =NVIC_IPR0
    ldr r2, =ARGUMENT
    ldr r0, [r2]
    lsls r0, r0, #8
    adds r0, #128
    strh r0, [r1]
    ldr r1, =STIR
    movs r0, #0
    str r0, [r1]
    dsb
    isb
    movs r0, #4
    str r0, [r6]
    adds r6, #4
1:
    wfi
    b 1b

handler line0
    movs r0, #1
    str r0, [r6]
    str lr, [r6, #4]
    adds r6, #8
    movs r0, #2
    ldr r1, =NVIC_ISPR0
    str r0, [r1]
    dsb
    isb
    movs r0, #3
    str r0, [r6]
    adds r6, #4
    bx lr

handler line1
    movs r0, #2
    str r0, [r6]
    str lr, [r6, #4]
    mov r0, sp
    str r0, [r6, #8]
    adds r6, #12
    bx lr
    literals
