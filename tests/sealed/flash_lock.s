// Logs from 2000_0004h on the values of ACTLR, CCR, SHCSR, CFSR, ICSR, FAULTMASK and PRIMASK;
// confirms itself by the callgate (the answer goes to 2000_002Ch); writes the right keys to
// FLASH_KEYR and FLASH_OPTKEYR; logs FLASH_CR and FLASH_OPTCR, and then 1. The handler of HardFault
// counts at 2000_0000h.
.syntax unified
.thumb

.macro write_key offset, key
    ldr r0, =\key
    str r0, [r5, #\offset]
    dsb
    isb
.endm

.macro log_register offset, at
    ldr r0, [r1, #\offset]
    str r0, [r6, #\at]
.endm

.thumb_func
start:
    mov.w r6, #0x20000000
    movs r0, #0
    str r0, [r6]
    str r0, [r6, #40]
    mov.w r1, #0xE000E000
    log_register 0x008, 4       // ACTLR
    log_register 0xD14, 8       // CCR
    log_register 0xD24, 12      // SHCSR
    log_register 0xD28, 16      // CFSR
    log_register 0xD04, 20      // ICSR
    mrs r0, FAULTMASK
    str r0, [r6, #24]
    mrs r0, PRIMASK
    str r0, [r6, #28]
    movs r0, #1
    str r0, [r6, #64]
    ldr r4, =0x08000040         // the callgate
    ldr r4, [r4, #12]
    movs r0, #5
    add.w r1, r6, #64
    blx r4
    str r0, [r6, #44]
    ldr r5, =0x40023C00         // the registers of the flash
    write_key 4, 0x45670123
    write_key 4, 0xCDEF89AB
    write_key 8, 0x08192A3B
    write_key 8, 0x4C5D6E7F
    ldr r0, [r5, #16]
    str r0, [r6, #32]
    ldr r0, [r5, #20]
    str r0, [r6, #36]
    movs r0, #1
    str r0, [r6, #40]
    b .
.thumb_func
fault:
    ldr r0, [r6]
    adds r0, #1
    str r0, [r6]
    bx lr
.balign 4
.ltorg

.section .vectors, "a"
    .word 0x20004000, start, 0, fault
    .space 512 - 16
