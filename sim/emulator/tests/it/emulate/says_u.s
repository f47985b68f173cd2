// Sends U out of USART2 at PA2 for ever, with 16 MHz / 139 = 115 200 bit/s (RM0090 sections 7.3, 8.4 and 30.6).
.syntax unified
.thumb
    ldr r0, =0x40023800         // RCC
    movs r1, #1
    str r1, [r0, #0x30]         // AHB1ENR: GPIOA
    ldr r1, =0x20000
    str r1, [r0, #0x40]         // APB1ENR: USART2
    ldr r0, =0x40020000         // GPIOA
    ldr r1, =0xA8000020
    str r1, [r0, #0x00]         // MODER: PA2 by its alternate function
    ldr r1, =0x700
    str r1, [r0, #0x20]         // AFRL: 7
    ldr r0, =0x40004400         // USART2
    movs r1, #139
    str r1, [r0, #0x08]         // BRR
    ldr r1, =0x2008
    str r1, [r0, #0x0C]         // CR1: UE, TE
    movs r2, #'U'
1:  ldr r1, [r0, #0x00]         // SR: TXE
    lsls r1, r1, #24
    bpl 1b
    str r2, [r0, #0x04]         // DR
    b 1b
.balign 4
.ltorg
