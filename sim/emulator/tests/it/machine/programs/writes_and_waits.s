// Runs at 2000_1000h. Carries out the stores at 2000_0100h: pairs of address and value, ended by
// an address of 0 with any value. The next three words are an address, a mask and a value. The
// program writes to port D all the time, until the word at the address, masked, has the value, or
// an interrupt comes (its vector is 2000_1027h). It keeps CYCCNT at 2000_0000h when it starts to
// wait and at 2000_0004h when it has seen the event.
.include "program.inc"
.equ BASE, 0x20001000

    mov r4, #RESULTS
    ldr r3, =DWT
    ldr r7, =GPIOD
    add r5, r4, #0x100
next:
    ldmia r5!, {r0, r1}
    cbz r0, wait
    str r1, [r0]
    b next
wait:
    ldmia r5, {r0, r1, r2}
    ldr r6, [r3, #4]
    str r6, [r4]
poll:
    str r6, [r7, #20]
    ldr r6, [r0]
    ands r6, r1
    cmp r6, r2
    bne poll
seen:
    ldr r6, [r3, #4]
    str r6, [r4, #4]
    b .
    literals
