// Writes a wrong key to FLASH_KEYR.
.include "program.inc"
vector 3, hard

    mov r6, #RESULTS
    movs r0, #0
    str r0, [r6]
    ldr r1, =FLASH_KEYR
    str r0, [r1]
1:
    adds r0, #1
    b 1b

handler hard
    mrs r0, ipsr
    str r0, [r6]
    b .
    literals
