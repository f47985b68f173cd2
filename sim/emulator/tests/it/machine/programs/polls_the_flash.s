// Waits for the flash in a loop that counts nothing.
.macro round
.endm
.include "polls.inc"
