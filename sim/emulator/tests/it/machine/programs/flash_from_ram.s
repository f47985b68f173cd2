// Runs at 2000_1000h: calls 0800_4001h, erases sector 1 from RAM, reads a word of flash once
// meanwhile if 2000_0100h says so, programs `movs r0, #2; bx lr` and calls again. 2000_0000h:
// polls; +4, +8: the two results.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    movs r7, #0
    ldr r4, =0x08004001
    blx r4
    str r0, [r6, #4]
    ldr r1, =FLASH
    erases_sector_1
    ldr r0, =ARGUMENT
    ldr r0, [r0]
    cmp r0, #0
    beq 1f
    mov r0, #0x08000000
    ldr r0, [r0]
1:
    adds r7, #1
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 1b
    str r7, [r6]
    movw r0, #0x201             // FLASH_CR: x32, PG
    str r0, [r1, #16]
    ldr r2, =0x08004000
    ldr r3, =0x47702002         // movs r0, #2; bx lr
    str r3, [r2]
2:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 2b
    blx r4
    str r0, [r6, #8]
3:
    wfi
    b 3b
    literals
