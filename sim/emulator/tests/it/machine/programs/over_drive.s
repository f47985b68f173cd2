// Goes to 180 MHz with over-drive (RM0090 section 5.1.4): 8 MHz crystal, M 8, N 360, P 2, APB1 /4, APB2 /2, 5 wait
// states. 2000_0100h leaves steps out: bit 0 over-drive, bit 1 the wait for ODRDY; with bit 2 over-drive is switched
// off at 180 MHz. Logs the rounds of both waits at 2000_0000h and 2000_0004h, PWR_CSR at 2000_0008h, and at
// 2000_000Ch the bit-band alias of ODSWEN.
.include "program.inc"
.equ PWR, 0x40007000
.equ ODEN, 0x420E0040           // bit-band aliases: bits 16 and 17 of PWR_CR
.equ ODSWEN, 0x420E0044

    mov r6, #RESULTS
    ldr r0, =ARGUMENT
    ldr r7, [r0]
    ldr r1, =FLASH
    movs r0, #5
    str r0, [r1]
    ldr r1, =RCC
    mov r0, #0x10000000         // PWREN
    str r0, [r1, #0x40]
    ldr r0, =0x00010083         // RCC_CR: HSEON
    str r0, [r1]
1:
    ldr r0, [r1]
    lsls r0, r0, #14
    bpl 1b
    ldr r0, =0x00405A08         // PLL from the crystal: M 8, N 360, P 2
    str r0, [r1, #4]
    ldr r0, =0x01010083         // RCC_CR: PLLON
    str r0, [r1]
    ldr r4, =PWR
    movs r5, #1
    lsls r0, r7, #31
    bmi clock
    ldr r2, =ODEN
    str r5, [r2]
    movs r3, #0
    lsls r0, r7, #30
    bmi switch
2:
    adds r3, #1
    ldr r0, [r4, #4]
    lsls r0, r0, #15            // ODRDY
    bpl 2b
switch:
    str r3, [r6]
    ldr r2, =ODSWEN
    str r5, [r2]
    movs r3, #0
3:
    adds r3, #1
    ldr r0, [r4, #4]
    lsls r0, r0, #14            // ODSWRDY
    bpl 3b
    str r3, [r6, #4]
    ldr r0, [r2]
    str r0, [r6, #12]
clock:
    ldr r0, [r1]
    lsls r0, r0, #6             // PLLRDY
    bpl clock
    movw r0, #0x9402            // the PLL; APB1 /4, APB2 /2
    str r0, [r1, #8]
4:
    ldr r0, [r1, #8]
    and r0, r0, #12
    cmp r0, #8
    bne 4b
    ldr r0, [r4, #4]
    str r0, [r6, #8]
    lsls r0, r7, #29
    bpl 5f
    movs r0, #0
    ldr r2, =ODEN
    str r0, [r2]
5:
    wfi
    b 5b
    literals
