// Follows a script at 2000_0100h, of pairs of words: address and value of a store; 1 or 2 and a
// value for FAULTMASK; 0 for the end. Logs then from 2000_0004h on: FLASH_CR, FLASH_OPTCR, CFSR,
// HFSR, BFAR. The handler of BusFault and HardFault counts at 2000_0000h, logs IPSR and the
// stacked PC at 2000_0018h, and goes on after the store if that is what the PC points to.
.include "program.inc"
vector 3, fault
vector 5, fault

start:
    mov r6, #RESULTS
    movs r0, #0
    str r0, [r6]
    ldr r5, =ARGUMENT
next:
    ldr r1, [r5]
    ldr r0, [r5, #4]
    adds r5, #8
    cbz r1, done
    cmp r1, #2
    bls mask
    str r0, [r1]
behind:
    dsb
    isb
    b next
mask:
    msr faultmask, r0
    isb
    b next
done:
    ldr r1, =FLASH
    ldr r0, [r1, #16]
    str r0, [r6, #4]
    ldr r0, [r1, #20]
    str r0, [r6, #8]
    ldr r1, =CFSR
    ldr r0, [r1]
    str r0, [r6, #12]
    ldr r0, [r1, #4]
    str r0, [r6, #16]
    ldr r0, [r1, #16]
    str r0, [r6, #20]
1:
    wfi
    b 1b

handler fault
    ldr r0, [r6]
    adds r0, #1
    str r0, [r6]
    mrs r0, ipsr
    str r0, [r6, #24]
    ldr r0, [sp, #24]
    str r0, [r6, #28]
    ldr r1, =CFSR
    ldr r2, [r1]
    lsls r2, r2, #22
    bpl back
    adds r0, #2
    str r0, [sp, #24]
back:
    bx lr
    nop
    literals
