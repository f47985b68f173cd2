// Counts 512 down in a loop of two instructions: in flash, then at 2000_2000h in RAM, where it copies the
// loop. The cycles of both go to 2000_0000h and 2000_0004h.
.include "program.inc"

    ldr r0, =0xE000EDFC
    ldr r1, =0x01000000
    str r1, [r0]
    ldr r7, =DWT
    movs r1, #1
    str r1, [r7]
    mov r4, #RESULTS
    ldr r5, =0x20002000
    ldr r6, =loop
    ldr r1, [r6]
    str r1, [r5]
    ldr r1, [r6, #4]
    str r1, [r5, #4]
    mov r0, #512
    bl measured
    str r3, [r4]
    mov r0, #512
    adds r6, r5, #0
    bl measured
    str r3, [r4, #4]
1:  b 1b
measured:
    mov r8, lr
    adds r6, r6, #1
    ldr r2, [r7, #4]
    blx r6
    ldr r3, [r7, #4]
    subs r3, r3, r2
    bx r8
    .balign 16
loop:
    subs r0, r0, #1
    bne loop
    bx lr
    nop
    literals
