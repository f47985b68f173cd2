// Unlocks the flash and erases sector 1 with x32, polling BSY from flash; then programs 1234_5678h
// at its start. 2000_0000h counts the polls, 2000_0004h SysTick's exceptions, 2000_0008h holds SR
// afterwards.
.include "program.inc"
vector 15, tick

    mov r6, #RESULTS
    movs r7, #0
    str r7, [r6, #4]
    ldr r1, =SYSTICK
    movw r2, #15999
    str r2, [r1, #4]
    str r7, [r1, #8]
    movs r2, #7
    str r2, [r1]
    ldr r1, =FLASH
    erases_sector_1
1:
    adds r7, #1
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 1b
    str r7, [r6]
    movw r0, #0x201             // FLASH_CR: x32, PG
    str r0, [r1, #16]
    ldr r2, =0x08004000
    ldr r3, =0x12345678
    str r3, [r2]
2:
    ldr r0, [r1, #12]
    lsls r0, r0, #15
    bmi 2b
    ldr r0, [r1, #12]
    str r0, [r6, #8]
3:
    wfi
    b 3b

handler tick
    ldr r1, =0x20000004
    ldr r0, [r1]
    adds r0, #1
    str r0, [r1]
    bx lr
    literals
