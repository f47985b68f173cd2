// Logs RCC_CSR at 2000_0000h and PWR_CSR at 2000_0004h and clears their flags, enables the pin WKUP, and
// enters Standby. Where 2000_0100h has 1, SysTick counts and a watchdog of 512 ms runs meanwhile; where it
// has 2, an interrupt is pending, which PRIMASK keeps out.
.include "program.inc"

    mov r6, #RESULTS
    ldr r5, =RCC
    ldr r0, [r5, #0x74]
    str r0, [r6]
    mov r0, #0x01000000         // RMVF
    str r0, [r5, #0x74]
    mov r0, #0x10000000         // PWREN
    str r0, [r5, #0x40]
    ldr r4, =0x40007000         // PWR
    ldr r0, [r4, #4]
    str r0, [r6, #4]
    movs r0, #14                // CSBF, CWUF, PDDS
    str r0, [r4]
    mov r0, #0x100              // EWUP
    str r0, [r4, #4]
    ldr r1, =ARGUMENT
    ldr r1, [r1]
    cmp r1, #2
    beq 2f
    cmp r1, #1
    bne 1f
    ldr r1, =SYSTICK
    movw r0, #15999
    str r0, [r1, #4]
    movs r0, #7
    str r0, [r1]
    ldr r1, =IWDG
    movw r0, #0xCCCC
    str r0, [r1]
    b 1f
2:
    cpsid i
    ldr r1, =0xE000ED04         // ICSR: PENDSTSET
    mov r0, #0x04000000
    str r0, [r1]
1:
    ldr r1, =SCR
    movs r0, #4                 // SLEEPDEEP
    str r0, [r1]
    wfi
    b .
    literals
