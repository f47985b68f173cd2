// Runs at 2000_1000h: erases sector 1 from RAM, waits for its end in a loop that counts nothing, and stores 1 at 2000_0000h.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    ldr r1, =FLASH
    erases_sector_1
    movs r7, #1
1:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 1b
    str r7, [r6]
2:
    wfi
    b 2b
    literals
