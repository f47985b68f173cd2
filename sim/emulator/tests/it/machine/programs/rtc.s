// Sets up RTC as ST's HAL does: LSE, 1 Hz, Wednesday 28 February 2024, 23:59:50; keeps a word in RTC_BKP0R by which a
// later start knows that it is done. Then reads time and date. Logs PWR_CSR, the rounds of the waits for LSERDY, INITF
// and RSF at 2000_0000h to 2000_000Ch, RTC_TR and RTC_DR at 2000_0010h and 2000_0014h. 2000_0100h, bit 0: without DBP.
.include "program.inc"
.equ RTC, 0x40002800

.macro waits bit, register, base, log
    movs r3, #0
1:
    adds r3, #1
    ldr r0, [\base, #\register]
    tst r0, #\bit
    beq 1b
    str r3, [r6, #\log]
.endm

    mov r6, #RESULTS
    movs r0, #0
    str r0, [r6, #4]
    str r0, [r6, #8]
    ldr r1, =RCC
    mov r0, #0x10000000         // PWREN
    str r0, [r1, #0x40]
    ldr r4, =0x40007000         // PWR
    ldr r0, [r4, #4]
    str r0, [r6]
    ldr r7, =ARGUMENT
    ldr r7, [r7]
    cmp r7, #0
    bne open
    ldr r0, [r4]
    orr r0, r0, #0x100          // DBP
    str r0, [r4]
open:
    ldr r5, =RTC
    ldr r2, =0x32F2
    ldr r0, [r5, #0x50]
    cmp r0, r2
    beq ready
    movs r0, #1                 // LSEON
    str r0, [r1, #0x70]
    waits 2, 0x70, r1, 4        // LSERDY
    movw r0, #0x8101            // RTCEN, RTCSEL: LSE
    str r0, [r1, #0x70]
    movs r0, #0xCA
    str r0, [r5, #0x24]
    movs r0, #0x53
    str r0, [r5, #0x24]
    mov r0, #0xFFFFFFFF         // INIT
    str r0, [r5, #12]
    waits 0x40, 12, r5, 8       // INITF
    movs r0, #0xFF
    str r0, [r5, #16]
    ldr r0, =0x007F00FF
    str r0, [r5, #16]
    ldr r0, =0x00235950
    str r0, [r5]
    ldr r0, =0x00246228
    str r0, [r5, #4]
    ldr r0, [r5, #12]
    bic r0, r0, #0x80
    str r0, [r5, #12]
    str r2, [r5, #0x50]
    movs r0, #0xFF
    str r0, [r5, #0x24]
ready:
    waits 0x20, 12, r5, 12      // RSF
    ldr r0, [r5, #0x28]
    ldr r0, [r5]
    str r0, [r6, #16]
    ldr r0, [r5, #4]
    str r0, [r6, #20]
2:
    wfi
    b 2b
    literals
