// Sets a breakpoint, comes to it, and then to a BKPT. What DEMCR is given is taken from
// 2000_0100h, the comparator from 2000_0104h (0: neither it nor the unit is touched), whether
// PRIMASK is set from 2000_0108h. Each DebugMonitor logs the PC that was stacked and DFSR, from
// 2000_0200h on, turns the breakpoint off, skips a BKPT, and asks for as many steps as 2000_010Ch
// says. A HardFault logs the PC, HFSR and DFSR there, and stays.
.include "program.inc"
vector 3, fault
vector 12, monitor

    mov r4, #RESULTS
    add r7, r4, #0x200
    ldr r5, =DEMCR
    ldr r6, =FPB
    ldr r0, [r4, #0x100]
    str r0, [r5]
    ldr r0, [r4, #0x104]
    cbz r0, 1f
    str r0, [r6, #8]
    movs r0, #3
    str r0, [r6]
1:
    ldr r0, [r4, #0x108]
    cbz r0, 2f
    cpsid i
2:
    movs r1, #0
    isb
target:
    adds r1, #1
    b 3f
    adds r1, #32
3:
    str r1, [r4]
    adds r1, #16
    str r1, [r4, #4]
    bkpt #7
    str r1, [r4, #8]
4:
    wfi
    b 4b

handler monitor
    ldr r0, [sp, #24]
    str r0, [r7]
    ldr r2, =DFSR
    ldr r0, [r2]
    str r0, [r7, #4]
    str r0, [r2]
    adds r7, #8
    movs r0, #2
    str r0, [r6]
    ldr r0, [sp, #24]
    ldrh r0, [r0]
    lsrs r0, r0, #8
    cmp r0, #0xBE               // a BKPT
    bne 5f
    ldr r0, [sp, #24]
    adds r0, #2
    str r0, [sp, #24]
5:
    ldr r0, =0x01010000
    ldr r3, [r4, #0x10C]
    cbz r3, 6f
    subs r3, #1
    str r3, [r4, #0x10C]
    orr r0, r0, #0x00040000
6:
    str r0, [r5]
    bx lr

handler fault
    ldr r0, [sp, #24]
    str r0, [r7]
    ldr r2, =HFSR
    ldr r0, [r2]
    str r0, [r7, #4]
    ldr r0, [r2, #4]
    str r0, [r7, #8]
    b .
    literals
