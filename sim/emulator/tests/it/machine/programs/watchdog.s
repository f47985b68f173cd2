// Starts the IWDG with the reload value 0 at /32: 1 ms, in the order of the manual. Reloads it as often
// as 2000_0100h says, every 800 µs or so.
.include "program.inc"

    mov r6, #RESULTS
    ldr r1, =IWDG
    movw r0, #0xCCCC            // starts the watchdog, with FFFh at /4
    str r0, [r1]
    movw r0, #0x5555            // unlocks PR and RLR
    str r0, [r1]
    movs r0, #3
    str r0, [r1, #4]
    movs r0, #0
    str r0, [r1, #8]
4:
    ldr r0, [r1, #12]           // PVU, RVU
    cmp r0, #0
    bne 4b
    movw r0, #0xAAAA            // reloads it, now with the values
    str r0, [r1]
    ldr r2, =ARGUMENT
    ldr r2, [r2]
1:
    cmp r2, #0
    beq 3f
    mov.w r3, #6400
2:
    subs r3, #1
    bne 2b
    str r0, [r1]
    subs r2, #1
    b 1b
3:
    b .
    literals
