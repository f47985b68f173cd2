// Runs at 2000_1000h: loads the word at 0800_4000h, clears RDERR, calls 0800_4001h, loads the word once more.
// 2000_0000h: the first load, FLASH_SR; FLASH_SR without RDERR; what the call returns; the second load, FLASH_SR.
.include "program.inc"
.equ BASE, 0x20001000

    mov r6, #RESULTS
    ldr r1, =FLASH
    ldr r4, =0x08004000
    ldr r0, [r4]
    ldr r2, [r1, #12]
    stmia r6!, {r0, r2}
    mov r0, #0x100              // FLASH_SR: RDERR
    str r0, [r1, #12]
    ldr r0, [r1, #12]
    stmia r6!, {r0}
    adds r4, #1
    blx r4
    stmia r6!, {r0}
    subs r4, #1
    ldr r0, [r4]
    ldr r2, [r1, #12]
    stmia r6!, {r0, r2}
1:
    wfi
    b 1b
    literals
