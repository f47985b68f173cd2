// Reads the word at 0801_0000h, then calls the function there again and again, and keeps its
// result at 2000_0000h.
.include "program.inc"

    ldr r4, =0x08010000
    mov r5, #RESULTS
    ldr r1, [r4]
    adds r4, #1
loop:
    blx r4
    str r0, [r5]
    b loop
    literals
