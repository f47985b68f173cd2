// Runs at 2000_1000h. The value at 2000_0100h goes to FLASH_ACR, and the word at 0800_4004h is loaded: before
// and after an erase of sector 1; after 1234_5678h is programmed at 0800_4000h, which is loaded, too; with the
// caches off; on again; and after the flush. 2000_0000h: the seven loads.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    ldr r1, =FLASH
    ldr r5, =ARGUMENT
    ldr r5, [r5]                // FLASH_ACR
    ldr r4, =0x08004000
    movs r2, #0
    str r5, [r1]
    b 4f                        // the cache is noticed from the next block on
4:
    ldr r0, [r4, #4]
    stmia r6!, {r0}
    erases_sector_1
1:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 1b
    ldr r0, [r4, #4]
    stmia r6!, {r0}
    movw r0, #0x201             // FLASH_CR: x32, PG
    str r0, [r1, #16]
    ldr r3, =0x12345678
    str r3, [r4]
2:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 2b
    ldr r0, [r4]
    stmia r6!, {r0}
    ldr r0, [r4, #4]
    stmia r6!, {r0}
    str r2, [r1]
    ldr r0, [r4, #4]
    stmia r6!, {r0}
    str r5, [r1]
    ldr r0, [r4, #4]
    stmia r6!, {r0}
    str r2, [r1]
    mov r0, #0x1800             // FLASH_ACR: DCRST, ICRST
    str r0, [r1]
    str r2, [r1]
    str r5, [r1]
    ldr r0, [r4, #4]
    stmia r6!, {r0}
3:
    wfi
    b 3b
    literals
