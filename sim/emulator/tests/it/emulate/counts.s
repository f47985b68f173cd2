// Counts at 2000_0000h, and calls a function that adds to r2.
.syntax unified
.thumb
    movs r0, #0
    ldr r1, results
loop:
    adds r0, #1
    str r0, [r1]
    bl add
    b loop
add:
    adds r2, #3
    bx lr
.balign 4
results:
    .word 0x20000000
