// Bits through their aliases: RCC_AHB1ENR bit 3 (GPIOD), GPIOD_MODER, a bit of RAM; results from
// 2000_0000h on.
.include "program.inc"

    mov r6, #RESULTS
    ldr r0, =0x80000001
    str r0, [r6]
    ldr r1, =0x4247060C         // bit 3 of RCC_AHB1ENR
    movs r0, #1
    str r0, [r1]
    ldr r0, [r1]
    str r0, [r6, #4]
    ldr r1, =RCC_AHB1ENR
    ldr r0, [r1]
    str r0, [r6, #8]
    ldr r1, =0x2200007C         // bit 31 of the word at 2000_0000h
    ldr r0, [r1]
    str r0, [r6, #12]
    movs r0, #0
    str r0, [r1]
    ldr r1, =0x22000004         // bit 1 of it
    movs r0, #0xFF
    str r0, [r1]
1:
    wfi
    b 1b
    literals
