// Waits for the flash in a loop that counts its rounds at 2000_0004h, as compilers without optimization do: the registers
// are the same in each round.
.macro round
    ldr r2, [r6, #4]
    adds r2, #1
    str r2, [r6, #4]
    movs r2, #0
.endm
.include "polls.inc"
