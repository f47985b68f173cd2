// Copies `movs r0, #1; bx lr` to 2000_1000h, calls it, overwrites it with `movs r0, #2; bx lr`,
// calls it again.
.include "program.inc"

    mov r6, #RESULTS
    ldr r4, =0x20001000
    ldr r0, =0x47702001         // movs r0, #1; bx lr
    str r0, [r4]
    dsb
    isb
    adds r4, #1
    blx r4
    str r0, [r6]
    subs r4, #1
    ldr r0, =0x47702002         // movs r0, #2; bx lr
    str r0, [r4]
    dsb
    isb
    adds r4, #1
    blx r4
    str r0, [r6, #4]
1:
    wfi
    b 1b
    literals
