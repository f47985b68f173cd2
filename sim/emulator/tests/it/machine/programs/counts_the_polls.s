// Runs at 2000_1000h: erases sector 1 from RAM and waits for its end in a loop that counts its rounds at 2000_0004h, as
// compilers without optimization do: the registers are the same in each round.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    ldr r1, =FLASH
    erases_sector_1
    movs r7, #1
1:
    ldr r2, [r6, #4]
    adds r2, #1
    str r2, [r6, #4]
    movs r2, #0
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 1b
    str r7, [r6]
2:
    wfi
    b 2b
    literals
