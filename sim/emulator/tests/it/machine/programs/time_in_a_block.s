// One straight run of code. It reads CYCCNT, a hundred instructions later again, writes CYCCNT 0 and reads
// it ten instructions later; starts SysTick with 1000 and reads it after 20 and after 50 instructions
// more. The two distances, the count and the two values go to 2000_0000h and on. Then the same reads of
// CYCCNT, one by one with a branch between: what the counter says at the borders of blocks.
.include "program.inc"

    ldr r0, =0xE000EDFC
    ldr r1, =0x01000000
    str r1, [r0]
    ldr r0, =DWT
    movs r1, #1
    str r1, [r0]
    mov r4, #RESULTS
    ldr r5, =0xE000E010
    ldr r6, =1000
    movs r7, #0
    b block
block:
    ldr r2, [r0, #4]
    .rept 99
    nop
    .endr
    ldr r3, [r0, #4]
    subs r3, r3, r2
    str r3, [r4]
    str r7, [r0, #4]
    .rept 9
    nop
    .endr
    ldr r2, [r0, #4]
    str r2, [r4, #4]
    str r6, [r5, #4]
    str r7, [r5, #8]
    movs r1, #5
    str r1, [r5]
    .rept 19
    nop
    .endr
    ldr r2, [r5, #8]
    .rept 49
    nop
    .endr
    ldr r3, [r5, #8]
    str r2, [r4, #8]
    str r3, [r4, #12]
    b after
after:
    ldr r2, [r0, #4]
    b then
then:
    ldr r3, [r0, #4]
    subs r3, r3, r2
    str r3, [r4, #16]
1:  b 1b
    literals
