// Unlocks the flash (RM0090 section 3.6.1), sets PG with a width of a byte, and stores 0 at 0801_0000h.
.syntax unified
.thumb
    ldr r0, =0x40023C00         // FLASH
    ldr r1, =0x45670123
    ldr r2, =0xCDEF89AB
    str r1, [r0, #4]            // KEYR
    str r2, [r0, #4]
    movs r1, #1
    str r1, [r0, #16]           // CR
    ldr r3, =0x08010000
    movs r4, #0
    strb r4, [r3]
    b .
.balign 4
.ltorg
