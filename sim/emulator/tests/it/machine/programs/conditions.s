// 100 000 rounds of an IT block that lies across a page border, interrupted every 67 cycles by a
// handler that changes the flags. Every second round adds 7, 1, 3 and 5 to the words at
// 2000_0000h.
.include "program.inc"
.equ BASE, 0x08000FDC
vector 15, tick

    movs r0, #0
    movs r4, #0
    movs r5, #0
    movs r6, #0
    movs r7, #0
    movs r3, #0
    ldr r1, =SYSTICK
    movs r2, #66
    str r2, [r1, #4]
    str r0, [r1, #8]
    movs r2, #7
    str r2, [r1]
    ldr r2, =100000
loop:
    adds r4, #1
    lsls r0, r4, #31
    itttt ne
    addne r5, #1
    addne r6, #3
    addne r7, #5
    addne r3, #7
    cmp r4, r2
    bne loop
    mov r0, #RESULTS
    stmia r0!, {r3, r5, r6, r7}
1:
    wfi
    b 1b

handler tick
    ldr r0, =0x20000010
    ldr r1, [r0]
    adds r1, #1
    str r1, [r0]
    cmp r1, r1
    bx lr
    literals
