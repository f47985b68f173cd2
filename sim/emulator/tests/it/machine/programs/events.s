// WFE ends by itself sooner or later; 2000_0000h counts.
.include "program.inc"

    mov r6, #RESULTS
    movs r0, #0
1:
    wfe
    adds r0, #1
    str r0, [r6]
    b 1b
    nop
