// Runs at 2000_1000h. The value at 2000_0100h goes to FLASH_ACR. Calls 0800_4001h, erases sector 1, programs
// `movs r0, #2; bx lr` there, flushes the caches if 2000_0104h says so, and calls again. 2000_0000h: the two
// results.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    ldr r1, =FLASH
    ldr r7, =ARGUMENT
    ldr r5, [r7]                // FLASH_ACR
    str r5, [r1]
    ldr r4, =0x08004001
    blx r4
    stmia r6!, {r0}
    erases_sector_1
1:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 1b
    movw r0, #0x201             // FLASH_CR: x32, PG
    str r0, [r1, #16]
    ldr r3, =0x47702002         // movs r0, #2; bx lr
    str r3, [r4, #-1]
2:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 2b
    ldr r0, [r7, #4]
    cbz r0, 3f
    movs r2, #0
    str r2, [r1]
    mov r0, #0x1800             // FLASH_ACR: DCRST, ICRST
    str r0, [r1]
    str r2, [r1]
    str r5, [r1]
3:
    blx r4
    stmia r6!, {r0}
4:
    wfi
    b 4b
    literals
